"""Whether something wandered during a session that should have rested. Arrays only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from flangeye.handeye.candidates import Model, rms
from flangeye.handeye.components import SHIFT, TURN
from flangeye.handeye.likelihood import log_likelihood, with_noise
from flangeye.handeye.walk import Of, StepSize, Walk
from flangeye.maths.geometry import invert, nearest_rotation
from flangeye.maths.statistics import chi2_quantile

FEWEST = 24
"""Poses below which no walk is looked for."""
SIGNIFICANT = 0.9999
"""Probability with which poses that rest are not taken for a walk."""


def with_walk(model: Model, grows: bool = False) -> tuple[Model, float]:
    """Estimate how camera and target walk against each other in time, if the poses speak for it.

    Only where one of them rests and the target's place is unknown. Poses are in order of time. What
    speaks for it is the likelihood of every pose by those before it, all that is fitted taken out:
    twice by how much its logarithm is larger than chance may make it is the second of what is
    returned, 0 without a walk.

    Args:
        model: What was found without.
        grows: Whether the camera's scale may walk as well, for a target of unknown size.
    """
    loop, kept = model.problem.loop, model.found.inliers
    if loop.y or not loop.z or kept.sum() < FEWEST or loop.camera_moves == loop.target_moves:
        return model, 0.0
    found = [(name, model_of) for name, model_of in _walking(model, grows) if model_of is not None]
    if not found:
        return model, 0.0
    gains = [_gain(model, each) for _, each in found]
    (name, best), gain = found[int(np.argmax(gains))], max(gains)
    beyond_chance = gain - chi2_quantile(SIGNIFICANT, 3 if grows else 2)
    if beyond_chance < 0:
        return model, 0.0
    best = _about_the_mean(best)
    size = rms((best.residuals(as_reported=True) - best.residuals())[kept]) * 1e3
    return best.noted(
        f"the {name} wandered during the session, by {size:.3f} mm rms"
    ), beyond_chance


def _walking(model: Model, grows: bool) -> Iterator[tuple[str, Model | None]]:
    """Give what may wander and the model with it: in the base, and in the hand what it carries.

    Steps in the base turn about what rests there, about what moves there, as an odometry's, or
    about its origin: the likeliest of these by the steps of the first is tried.
    """
    loop, s, at = model.problem.loop, model.problem.measurements, model.found.at
    camera, target = (s.a @ at.x)[:, :3, 3], (s.b @ at.z)[:, :3, 3]
    resting, moving = ("target", camera) if loop.camera_moves else ("camera", target)
    held: Of = "camera" if loop.camera_moves else "target"
    places = {resting: target if loop.camera_moves else camera, "world": moving}
    walks = {name: Walk(p, grows) for name, p in (places | {"base": np.zeros_like(camera)}).items()}
    name, found = resting, _with(model, walks[resting])
    if found is not None and (likelier := _likeliest(found, walks)) != name:
        name, found = likelier, _with(model, walks[likelier])
    yield name, found
    in_hand = (at.x if loop.camera_moves else at.z)[:3, 3]
    yield held, _with(model, Walk(np.tile(in_hand, (len(s), 1)), grows, held))


def _with(model: Model, walk: Walk) -> Model | None:
    """Return the model with a walk; it begins as large as to leave the residuals there are."""
    found = model.found
    turn, shift = (rms(found.linear.residuals[found.inliers][:, at]) for at in (TURN, SHIFT))
    step = np.sqrt(2.0 / len(found.inliers))
    size = StepSize(step * turn, step * shift, step * turn)
    started = replace(found, noise=replace(found.noise, walk=size))
    consensus = replace(model.consensus, found=started)
    return replace(model, consensus=consensus).with_problem(replace(model.problem, walk=walk))


def _likeliest(model: Model, walks: Mapping[str, Walk]) -> str:
    """Return about what the steps most likely turn that led where the model has it."""
    found, course, before = model.found, model.found.at.course, model.problem.walk
    if course is None or before is None:
        return ""

    def likelihood(walk: Walk) -> float:
        now, then = (rms(course.steps(each)[1:, 3:6]) for each in (walk, before))
        size = found.noise.walk._replace(shift=found.noise.walk.shift * now / then)
        noise = replace(found.noise, walk=size)
        return log_likelihood(replace(model.problem, walk=walk), replace(found, noise=noise))

    return max(walks, key=lambda name: likelihood(walks[name]))


def _about_the_mean(model: Model) -> Model:
    """Return the model with what wandered where it was in the mean, not where it began."""
    found, course = model.found, model.found.at.course
    if course is None:
        return model
    mean = course.motions[found.inliers].mean(axis=0)
    mean[:3, :3] = nearest_rotation(mean[:3, :3])
    if model.problem.loop.camera_moves and course.of == "base":
        which, moved, motions = 2, mean, course.motions @ invert(mean)
    else:
        which, moved = (2 if course.of == "target" else 0), invert(mean)
        motions = moved @ course.motions
    places = found.at.places.copy()
    places[which] = moved @ places[which]
    at = replace(found.at, places=places, course=replace(course, motions=motions))
    return replace(model, consensus=replace(model.consensus, found=replace(found, at=at)))


def _gain(model: Model, candidate: Model) -> float:
    """Return twice by how much the log likelihood of the same poses is larger with a walk."""
    same = replace(model.found, inliers=candidate.found.inliers)
    rested = with_noise(model.problem, same)
    return log_likelihood(candidate.problem, candidate.found) - log_likelihood(
        model.problem, rested
    )
