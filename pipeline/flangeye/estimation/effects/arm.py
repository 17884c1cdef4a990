r"""Errors of an arm's geometry: joint zeros, encoders, sag, link lengths and twists, and the rest.

An arm's controller reports f(q) by nominal parameters; the flange really is at the twist
:math:`D(q)\,\delta` from there. Each kind's typical size is a ratio to that of the joint zeros
(``Carrier.accuracy``), since a maker's tolerances go together: all kinds of one arm share its
quality, and each varies a little around it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.graph import Carrier, Linear, Problem
from flangeye.maths.arm_correction import effects as field_effects
from flangeye.maths.arm_correction import field_over
from flangeye.maths.kinematics import Arm
from flangeye.types import Floats, SmoothField
from flangeye.types.geometry import hat, skew_parts

ARM_ERRORS = {
    "zeros": ("joint zeros", 1.0),
    "encoders": ("encoder eccentricity", 0.2),
    "sag": ("sag", 1.0),
    "lengths": ("link lengths", 0.15),
    "twists": ("link twists", 0.3),
}
"""Typical size of each kind for zeros of 1 rad: encoders once a turn [rad], a joint's deflection
for a metre of lever [rad/m], lengths [m], twists [rad]. Ratios seen in published calibrations of
industrial arms (Nubiola & Bonev 2013; the zeros and lengths of ``refine.arm``), rounded."""
ANEW = {
    "base": (1.0, 0.5),
    "flange": (1.2, 0.15),
    "rotation": (1.7, 0.5),
    "translation": (1.0, 0.17),
    "each": (0.4, 0.1),
}
"""Typical rotation [rad] and translation [m] of the arm's error if the joints are unknown: at the
base and at the flange, common to all poses. Then by how much its rotation changes with position
[rad/m] and orientation [rad/rad], and its translation with both [m/m, m/rad]. Values of a UR5e and
a Panda with errors of all these kinds (``tests/estimation/foreign.py``), over 240 mm and 20 to 35
deg. Last, the rotation and translation of each pose alone, of an arm that repeats to 0.03 mm."""
COMMON = "common"
"""Kind of the errors common to all poses, which do not matter in reported coordinates."""
ACCURACY = 0.3e-3
"""Typical deviation of a joint's zero where no file states it [rad]: the catalogue arms'."""
QUALITY = 4.0
"""Factor by which an arm may be better or worse than its file, one sigma. No data sheet states the
accuracy of joints, and arms of one maker differ tenfold."""
QUALITY_SPREAD = 1.8
"""Factor by which each kind may differ from the arm's common quality, one sigma."""


def arm_effects(problem: Problem, arm: str) -> list[Effect]:
    """Return the effects of one arm or rail; the arm's quality scales all their sizes."""
    carriers = [c for c in problem.carriers if c.arm == arm]
    accuracy = carriers[0].accuracy or ACCURACY
    poses = np.asarray(problem.frames[carriers[0].frame].place)
    effects = []
    if all(map(joints_known, carriers)):
        for kind, (name, ratio) in ARM_ERRORS.items():
            block = partial(_moved, arm, partial(_displaced, kind))
            effects.append(Effect(name, block, ratio * accuracy, QUALITY_SPREAD, arm, True, kind))
        # Half the play is lost on either side. No command contains it: at the work a joint comes
        # from either side
        lag, block = 0.05 * accuracy, partial(_moved, arm, partial(_displaced, "backlash"))
        effects.append(Effect("backlash", block, lag, QUALITY_SPREAD, arm))
    else:
        for at in ("base", "flange"):
            for rows, ratio in zip((slice(3), slice(3, 6)), ANEW[at], strict=True):
                block = partial(_moved, arm, partial(_in_common, at == "base", rows))
                name, size = f"place of the {at}", ratio * accuracy
                effects.append(Effect(name, block, size, QUALITY_SPREAD, arm, True, COMMON))
        block = partial(_moved, arm, partial(_linear_in_pose, poses))
        name = "error linear in the pose"
        effects.append(Effect(name, block, accuracy, QUALITY_SPREAD, arm, True))
    # What no kind explains, smooth over the workspace [m]; of it nothing is known beforehand: four
    # times as much or as little, one sigma
    block = partial(_by_place, arm, field_over(poses[:, :3, 3]))
    return [*effects, Effect("smooth error", block, 0.1 * accuracy, 4.0, arm, True, "field")]


@dataclass(frozen=True, eq=False)
class Scatter:
    """Noise that a cause adds to each sighting, independent from pose to pose.

    Attributes:
        covariances: Function that returns the (N, 6, 6) covariances at size 1.
        size: Prior median of the size.
        factor: Uncertainty of the size as a factor, one sigma.
    """

    covariances: Callable[[Problem, Linear], Floats]
    size: float
    factor: float


def arm_scatters(problem: Problem) -> list[Scatter]:
    """Return the arms' noise from pose to pose.

    A joint does not stop at the same angle each time. With unknown joint angles, what is not linear
    in the pose counts as noise too. An arm's repeatability says nothing of its accuracy: this noise
    has a quality of its own.
    """
    out = []
    for arm, accuracy in {c.arm: c.accuracy or ACCURACY for c in problem.carriers}.items():
        if all(joints_known(c) for c in problem.carriers if c.arm == arm):
            # Of a joint's angle from pose to pose [rad]: an arm that repeats to 0.03
            # mm by ISO 9283 at a reach of a metre has 0.03 mrad
            out.append(Scatter(partial(_joint_noise, arm), 0.1 * accuracy, QUALITY))
        else:
            for rows, ratio in zip((slice(3), slice(3, 6)), ANEW["each"], strict=True):
                out.append(Scatter(partial(_pose_noise, arm, rows), ratio * accuracy, QUALITY))
    return out


def joints_known(carrier: Carrier) -> bool:
    """Whether kinematics and joints of a carrier are known."""
    return carrier.joints is not None and carrier.kinematics is not None


def _joint_noise(arm: str, problem: Problem, linear: Linear) -> Floats:
    moves = _moved(arm, partial(_displaced, "zeros"), problem, linear)
    return np.asarray(moves @ np.swapaxes(moves, 1, 2))


def _pose_noise(arm: str, rows: slice, problem: Problem, linear: Linear) -> Floats:
    """Return the covariances of sightings for unit noise of an arm's poses in ``rows``."""
    moved = [linear.blocks[c.frame][:, :, rows] for c in problem.carriers if c.arm == arm]
    return np.asarray(sum(moves @ np.swapaxes(moves, 1, 2) for moves in moved))


def _moved(
    arm: str, twists: Callable[[Problem, Carrier], Floats], problem: Problem, linear: Linear
) -> Floats:
    """Return the design block of the ``twists`` (N, 6, K) of an arm's carriers."""
    moved = [c for c in problem.carriers if c.arm == arm]
    return np.asarray(sum(linear.blocks[c.frame] @ twists(problem, c) for c in moved))


def _displaced(kind: str, problem: Problem, carrier: Carrier) -> Floats:
    return np.asarray(displacements(carrier)[kind][problem.seen.times])


def _in_common(at_base: bool, rows: slice, problem: Problem, carrier: Carrier) -> Floats:
    """Return twists of a turn or shift common to all poses, at the base or the flange."""
    poses = np.asarray(problem.frames[carrier.frame].place)[problem.seen.times]
    motions = np.tile(np.eye(6), (len(poses), 1, 1))
    if at_base:
        motions[:, 3:, :3] = -hat(poses[:, :3, 3])
    else:
        motions[:, :3, :3] = motions[:, 3:, 3:] = poses[:, :3, :3]
    return motions[:, :, rows]


def _linear_in_pose(session: Floats, problem: Problem, carrier: Carrier) -> Floats:
    """Return twists (N, 6, 36) that are linear in the pose, about a session's mean."""
    middle, turned = session[:, :3, 3].mean(axis=0), session[:, :3, :3].mean(axis=0)
    poses = np.asarray(problem.frames[carrier.frame].place)[problem.seen.times]
    by = np.stack([poses[:, :3, 3] - middle, skew_parts(poses[:, :3, :3] @ turned.T)], axis=1)
    # Each of the twist's six numbers by the six of the pose
    changes = np.repeat([ANEW["rotation"], ANEW["translation"]], 3, axis=0)
    sizes = changes[:, :, None] * by[:, None]
    rows = np.eye(6)[:, :, None] * sizes.reshape(len(by), 1, 6, 6)
    return np.asarray(rows.reshape(len(by), 6, 36))


def _by_place(arm: str, field: SmoothField, problem: Problem, linear: Linear) -> Floats:
    """Return the design block of a displacement that is smooth in the reported position."""
    parts = []
    for frame in (c.frame for c in problem.carriers if c.arm == arm):
        places = np.asarray(problem.frames[frame].place)[problem.seen.times, :3, 3]
        parts.append(linear.blocks[frame][:, :, 3:] @ field_effects(field, places))
    return np.asarray(sum(parts))


@lru_cache(maxsize=16)
def displacements(carrier: Carrier) -> dict[str, Floats]:
    """Return (T, 6, K) twists of the carried frame, in the arm's base about its origin, by kind."""
    arm, joints = kinematics_and_joints(carrier)
    link = carrier.link
    columns = arm.jacobian(joints, link)
    waves = np.stack([np.sin(joints), np.cos(joints)], axis=1)
    links = arm.link_twists(joints, link)
    # An eccentric encoder disc errs once a turn, e sin q + f cos q; a joint sags by the torque
    return {
        "zeros": columns,
        "backlash": columns * _directions(joints)[:, None],
        "encoders": (columns[:, :, None, :] * waves[:, None]).reshape(len(joints), 6, -1),
        "sag": columns * _levers(arm, joints)[:, None],
        "lengths": links[..., :2].reshape(len(joints), 6, -1),
        "twists": links[..., 2],
    }


def _directions(joints: Floats) -> Floats:
    """Return (T, n) the sign of each joint's last move before a pose; 0 before it first moves."""
    steps = np.diff(joints, axis=0, prepend=joints[:1])
    # A joint at rest reports changes, but none of a tenth of a milliradian
    moves = np.where(np.abs(steps) > 1e-4, np.arange(len(steps))[:, None], 0)
    return np.take_along_axis(np.sign(steps), np.maximum.accumulate(moves, axis=0), axis=0)


def _levers(arm: Arm, joints: Floats) -> Floats:
    """Return (T, n) the horizontal lever of the load about each joint [m].

    The load is spread evenly over the origins of the links beyond the joint.
    """
    origins, (axes, places) = arm.frames(joints)[..., :3, 3], arm.axes(joints)
    beyond = [origins[:, i + 1 :].mean(axis=1) - places[:, i] for i in range(arm.n)]
    # Gravity's torque about an axis a at lever r is a . (r x z) = (a x r) . z per unit of weight;
    # the base is taken to be level
    return np.asarray(np.cross(axes, np.stack(beyond, axis=1)) @ np.array([0.0, 0.0, 1.0]))


def kinematics_and_joints(carrier: Carrier) -> tuple[Arm, Floats]:
    """Return kinematics and joints of a carrier that has both.

    Raises:
        ValueError: The carrier lacks one of them.
    """
    if carrier.kinematics is None or carrier.joints is None:
        raise ValueError(f"the joints or the kinematics of {carrier.arm} are not known")
    return carrier.kinematics, carrier.joints
