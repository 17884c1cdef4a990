"""``segment.body``: find a body of known shape in a scan of the whole cell."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from flangeye import Params, stage
from flangeye.errors import StageError
from flangeye.models.bodies import LARGEST, SMALLEST, TargetBody
from flangeye.models.configuration import Configuration
from flangeye.models.targets import Sphere
from flangeye.types import (
    BASE,
    Capture,
    Earlier,
    FlangeCloud,
    Floats,
    PointCloud,
    PoseFeature,
    Rejected,
    Singles,
)
from flangeye.types.geometry import invert, rigid
from flangeye.units import Length, param

if TYPE_CHECKING:
    from flangeye_plugins.body.looks import Looks
    from flangeye_plugins.body.search import BodySearch, FoundPose

FIRM = 0.004
"""Largest standard deviation of the least certain direction of a body's pose and scale, in sizes of
the body or radians. A chance fit is seldom certain in all of them, and a corner fits any size."""


class SegmentBodyParams(Params):
    """Parameters of ``segment.body``."""

    near: Length = param("100 mm", ge=0)
    """Points nearer to the scanner are left out."""
    far: Length = param("3 m", gt=0)
    """Points farther from the scanner are left out."""
    min_coverage: float = param(0.3, gt=0, le=1)
    """Smallest share of the body's expected view that must be visible."""
    min_trust: float = param(0.99, gt=0, le=1)
    """Smallest share of the rays at the body and right beside it that agree with it."""

    def passed_by(self, found: FoundPose) -> bool:
        """Return whether a candidate pose satisfies these parameters."""
        if _passes(found, self.min_coverage, self.min_trust):
            return True
        # Through a body at a wrong pose something is seen, or its surface goes on beyond its end.
        # Another thing that touches it is seen outside it; the rest must then determine the pose
        # better.
        apart = found.verdict.trusted_but_for_touching >= self.min_trust
        return apart and _passes(found, self.min_coverage, 0.9, goes_on=0.1, weakest=FIRM / 2)


@stage("segment.body")
def segment_body(
    capture: Capture,
    body: TargetBody,
    configuration: Configuration,
    earlier: Earlier,
    params: SegmentBodyParams,
) -> FlangeCloud | Rejected:
    """Find a body by its shape, without an initial guess, and cut out the points around it.

    Edges of the body are matched to edges of the scan. The poses that the scan does not contradict
    are refined and then checked ray by ray: the body's surface must be seen, nothing may be seen
    behind it, and nothing may continue beyond its ends. The scan must also determine the body's
    size.

    If no pose passes, the scan is rejected. If several pass, the arm's motion between captures
    decides later. If the arm's motion since earlier captures predicts a pose that passes, that pose
    is taken without a search.

    Raises:
        StageError: The cloud's unit is wrong (for example millimetres), or a body of revolution is
            drawn in its carrier's frame with its axis along another one than z.
    """
    from flangeye_plugins.body.dense import FEWEST_ON_BODY
    from flangeye_plugins.body.looks import prepared
    from flangeye_plugins.body.search import BodySearch, alike, around
    from flangeye_plugins.segment.scale import check_scale

    body = body.at(capture.joints)
    points = capture.cloud.points()
    if len(points):
        check_scale(points, capture.id)
    points = _between(points, params.near, params.far)
    if len(points) < FEWEST_ON_BODY:
        return Rejected("no point between near and far")
    looks = prepared(body)
    if looks.symmetry.freedoms == 3:
        return _ball(capture, looks, params)
    _require_axis(body, looks, configuration)
    search = BodySearch(points, looks, params.passed_by)
    predicted = _predicted(capture, configuration, earlier)
    carried = list(filter(params.passed_by, search.near(predicted)))[:1]
    # What slid away from where the arm has carried the body may be another thing
    if carried and alike(carried[0].pose[None], predicted, looks).any():
        found: list[FoundPose] | Rejected = carried
    else:
        # Of the first captures only: a body that was seen before is as its mesh says.
        found = _searched(search, body, points, params, not earlier.observations)
    if isinstance(found, Rejected):
        return found
    pose, *others = (one.pose for one in found)
    centre = pose[:3, :3] @ looks.centre + pose[:3, 3]
    cloud = PointCloud(capture.cloud.frame, around(points, looks, pose, *others))
    towards = -centre / np.linalg.norm(centre)
    return FlangeCloud(cloud, centre, towards, pose, others=np.array(others))


def _require_axis(body: TargetBody, looks: Looks, configuration: Configuration) -> None:
    """Refuse a body of revolution whose axis is not z of the frame in which it is drawn.

    The solver compares z axes only. A body whose place is to be found gets a frame along its axis.
    """
    freedoms, _, axis = looks.symmetry
    if freedoms == 5 and configuration.place is not None and axis[2] < 1.0 - 1e-6:
        raise StageError(
            f"{body.name}: a body of revolution whose axis is along ({axis[0]:.2f}, {axis[1]:.2f}, "
            f"{axis[2]:.2f}) of its mesh; draw it with the axis along z of the "
            f"{configuration.target}, or write target: {{body: {body.name}, at: unknown}}"
        )


def _ball(capture: Capture, looks: Looks, params: SegmentBodyParams) -> FlangeCloud | Rejected:
    """Return the points of a ball, which has no edges to be found by."""
    from flangeye_plugins.segment.sphere import SegmentSphereParams, segment_sphere

    x, y, z = centre = looks.symmetry.centre
    radius = float(np.linalg.norm(looks.surface.points - centre, axis=1).mean())
    sphere = Sphere(size=radius, centre_in_flange=(x, y, z))
    limits = SegmentSphereParams.model_construct(near=params.near, far=params.far)
    found: FlangeCloud | Rejected = segment_sphere(capture, sphere, limits)
    if isinstance(found, Rejected):
        return found
    return replace(found, camera_T_target=rigid(np.eye(3), found.centre - centre))


def _searched(
    search: BodySearch,
    body: TargetBody,
    points: Singles,
    params: SegmentBodyParams,
    doubtful: bool,
) -> list[FoundPose] | Rejected:
    """Return all poses consistent with a scan, best first, or the reason for rejecting the scan.

    Args:
        search: Search of the scan for the body.
        body: The body.
        points: (N, 3) points of the scan [m].
        params: Limits that a pose must satisfy.
        doubtful: Whether the mesh may be wrong, so that mirrored and rescaled versions are tried
            too.
    """
    every, passes = search.everywhere(), params.passed_by
    passing = list(filter(passes, every))
    found = search.unrivalled(passing, passing)
    if not found:
        for one in every:
            # A mirrored mesh may pass as narrowly as this one fails
            if _passes(one._replace(weakest=0.0), params.min_coverage, params.min_trust):
                return _unsure(one, body)
        return (doubtful and _misdrawn(points, body, every, params)) or _why_none(every, body)
    if doubtful:
        images = [one for pose in found for one in search.images(pose) if passes(one)]
        if not (found := search.unrivalled(found, images)):
            what, fix, _ = _otherwise(body)[0]
            return Rejected(
                f"{body.name} is {what}: its mirror image fits the scan better", fix=fix
            )
    # One that fails narrowly and explains as much leaves it open which of them is right
    near = [o for o in every if not passes(o) and o.verdict.trusted >= params.min_trust]
    return found + search.twins_among(near, found)


def _between(points: Singles, near: float, far: float) -> Singles:
    z = points[:, 2]
    # Tangent of 60 degrees: no scanner sees farther to the side, stray points do
    inside = (z > near) & (z < far) & (np.abs(points[:, :2]) < 1.75 * z[:, None]).all(axis=1)
    return points[inside]


def _predicted(capture: Capture, configuration: Configuration, earlier: Earlier) -> Floats:
    """Return poses (K, 4, 4) predicted from earlier captures and the arm's motion since."""
    place = configuration.place
    # Earlier sightings from which the pose is predicted
    recent = earlier.observations[-3:]
    # A link's pose is computed only when the whole session is solved
    if place is None or configuration.camera != BASE or configuration.target not in capture.poses:
        return np.zeros((0, 4, 4))
    now = capture.poses[configuration.target].matrix @ place
    return np.array([
        one.feature.camera_T_target.matrix
        @ invert(one.poses[configuration.target].matrix @ place) @ now
        for one in recent if isinstance(one.feature, PoseFeature)
    ]).reshape(-1, 4, 4)  # fmt: skip


def _misdrawn(
    points: Singles, body: TargetBody, every: list[FoundPose], params: SegmentBodyParams
) -> Rejected | None:
    """Return a rejection if a corrected version of the mesh is found instead; None if not."""
    from flangeye_plugins.body.looks import Looks, prepared
    from flangeye_plugins.body.search import FINE_ACROSS, BodySearch, contradicted_facets
    from flangeye_plugins.body.view import view_of

    passes, trust = params.passed_by, params.min_trust
    for what, fix, other in _otherwise(body):
        tried = BodySearch(points, prepared(other), passes).quickly(trust)
        # Of several guesses one fits by chance sooner than the mesh itself
        if found := next((one for one in tried if passes(one.half_as_certain())), None):
            return Rejected(
                f"{body.name} is {what}: with a corrected mesh it would be found",
                f"{found.verdict.shown:.0%} of the rays that should hit the corrected mesh do",
                fix,
            )
    shape = prepared(body)
    vertices, facets = shape.facets
    # Parts that stand elsewhere hide some of the rest, and a rest is found in clutter sooner.
    holds = partial(_passes, coverage=0.0, trust=0.93, goes_on=0.1, weakest=FIRM / 2)
    rests = dict[bytes, BodySearch]()
    view, held = view_of(points, shape.size / FINE_ACROSS), list[tuple[float, Floats]]()
    for pose in (one.pose for one in every):
        gone = contradicted_facets(shape, view, pose)
        if gone is not None:
            if gone.tobytes() not in rests:  # a mesh is prepared once, though many poses lack it
                rest = Looks(vertices, facets[~gone].astype(np.int32), mounted=True)
                rests[gone.tobytes()] = BodySearch(points, rest, holds)
            near = filter(holds, rests[gone.tobytes()].near(pose[None], trust=0.93))
            held += [(one.verdict.score, vertices[facets[gone]]) for one in near]
    if not held:
        return None
    corners = 1e3 * max(held, key=lambda one: one[0])[1].reshape(-1, 3)
    spans = zip("xyz", corners.min(axis=0), corners.max(axis=0), strict=True)
    box = ", ".join(f"{axis} {low:.0f} to {high:.0f}" for axis, low, high in spans)
    return Rejected(
        f"{body.name} is found, but a part of it is not where its mesh has it",
        f"the moved part lies at {box} mm in the mesh's frame",
        "draw the part that moves, such as a gripper's jaws, as it was in the session, or leave it "
        "out of the mesh",
    )


@lru_cache(maxsize=1)
def _otherwise(body: TargetBody) -> list[tuple[str, str, TargetBody]]:
    """Return typical errors of a mesh: what is wrong, the remedy, and the corrected body."""
    out = [
        (
            "drawn mirrored",
            "mirror the mesh, or export it from CAD with right-handed axes",
            replace(body, vertices=body.vertices * [-1.0, 1.0, 1.0]),
        )
    ]
    for scale, units in ((25.4, "millimetres for inches"), (10.0, "millimetres for centimetres")):
        for times, size in ((scale, "small"), (1 / scale, "large")):
            if SMALLEST <= times * body.size <= LARGEST:
                what = f"{scale:g} times too {size}, {units} or the reverse"
                fix = f"state the unit: of the target, or scale the mesh by {times:.4g}"
                out.append((what, fix, replace(body, vertices=body.vertices * times)))
    return out


def _passes(
    found: FoundPose, coverage: float, trust: float, goes_on: float = 1.0, weakest: float = FIRM
) -> bool:
    verdict = found.verdict
    # Fewer rays, a hundredth of the body's size apart, fit other things by chance
    fewest = 150
    # So may a small share of its broadest view, as a torch's end, and what is seen through a gap
    little = found.seen < 0.07 or not verdict.bounded
    # And so may a face of another thing fit half of the body, if no end of it is seen
    half = not verdict.ends_seen and verdict.shown < 2 * coverage
    return (
        verdict.shown >= coverage
        and verdict.trusted >= trust
        and verdict.agree >= fewest
        and (verdict.bounded or verdict.framed)
        and verdict.goes_on <= goes_on * verdict.beside
        and found.weakest <= weakest * (0.5 if half else 0.75 if little else 1.0)
    )


def _unsure(found: FoundPose, body: TargetBody) -> Rejected:
    """Return the rejection of a scan that shows a body, but not exactly enough where it is."""
    return Rejected(
        f"{body.name} may be in view, but the scan leaves its pose or size too uncertain: show "
        "more of it, scan from nearer or with less noise, or use a larger body",
        f"standard deviation {found.weakest * body.size * 1e3:.1f} mm, limit "
        f"{FIRM * body.size * 1e3:.1f} mm",
    )


def _why_none(every: list[FoundPose], body: TargetBody) -> Rejected:
    """Return the rejection with the reason why no pose passed."""
    if not every:
        return Rejected(f"nothing of the size of {body.name} is there")
    best = every[0].verdict
    ends = "" if best.bounded or best.framed else ", and it is not seen to end there"
    return Rejected(
        f"no pose of {body.name} ({body.size * 1e3:.0f} mm across) explains the scan: is it in "
        "view, and are the mesh's unit and handedness right?",
        f"best candidate: {best.shown:.0%} of the rays that should hit it do ({best.agree} rays), "
        f"{best.trusted:.1%} of the rays at and beside it agree, standard deviation of its pose "
        f"{every[0].weakest * body.size * 1e3:.1f} mm{ends}",
    )
