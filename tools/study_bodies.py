"""How often a body is found without a guess, how often wrongly, and how far off, by simulation.

    python -m tools.study_bodies SCANS [BODY…] [--first SEED] [--alone]

Simulated scans of a PhoXi M at 0.35 of its resolution: the body on a UR5e's flange, turned at random,
before a table with six other things; in three of ten another body is there, or the mesh is mirrored, of
another scale, or has other jaws. Each body is off its
CAD, and each scanner distorted, by a field of its own, as large as stated. Beside it Open3D's FPFH,
RANSAC and ICP on the same scans, which have no way to say that a body is absent: each pose of theirs
that is not the body's counts as wrong.
"""

import argparse
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from flangeye.estimation.start.ambiguity import disambiguated
from flangeye.models.bodies import TargetBody, load_body
from flangeye.models.cell import cell_of
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.loading import load_model
from flangeye.models.targets import plate_of
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Capture,
    Earlier,
    Observation,
    PointCloud,
    PoseFeature,
    Rejected,
    Transform,
)
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy, rotation_log
from flangeye_emulators.world.mesh import (
    MATERIALS,
    Mesh,
    box,
    capsule,
    flange_mesh,
    wrist_mesh,
)
from flangeye_emulators.world.raycast import RaycastScene, SolidBody
from flangeye_emulators.world.scanner import scanner_of
from flangeye_plugins.body.looks import prepared
from flangeye_plugins.body.search import FINE_ACROSS, judged
from flangeye_plugins.body.shape import Shape
from flangeye_plugins.body.view import view_of
from flangeye_plugins.fit.body import FitBodyParams, fit_body
from flangeye_plugins.segment.body import SegmentBodyParams, segment_body

BODIES = ("gripper", "torch", "ring-plate")

VISIBLE = 0.3
"""Share of the body's view that the scan shows where finding it is asked for."""


SCANNER = load_model("scanners", "phoxi-m", Path())
MODEL_ERROR, ALIKE = 0.1e-3, 1 / 4
"""How far bodies are off their CAD along each axis [m], and over what share of their size alike."""

SESSION = 8
"""Scans of one session: where several poses explain a scan, those of its session decide."""


def eye(rng):
    """Return a scanner with a random distortion."""
    return scanner_of(SCANNER, 0.35, 1.0, rng)


def as_made(body, rng):
    """Return a manufactured body, which differs from its CAD by a sum of random smooth waves."""
    whole = trimesh.Trimesh(body.vertices, body.triangles)
    points, triangles = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, body.size / 8)
    waves = rng.normal(0, 1 / (ALIKE * body.size), (200, 3))
    share = np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, 200)) * np.sqrt(2 / 200)
    return Shape(points + MODEL_ERROR * share @ rng.standard_normal((200, 3)), triangles)


@cache
def wrist():
    plate = plate_of(load_model("robots", "ur5e", Path()))
    arm = [([0, 0, -0.06], [0, 0.12, -0.07], 0.04), ([0, 0.12, -0.07], [-0.35, 0.15, -0.15], 0.045)]
    links = [
        SolidBody(capsule(np.array(a), np.array(b), r), MATERIALS["painted"]) for a, b, r in arm
    ]
    finish = MATERIALS[plate.details.finish]
    return [
        SolidBody(flange_mesh(plate), finish),
        SolidBody(wrist_mesh(plate), MATERIALS["painted"]),
        *links,
    ]


def turned(rng):
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def scene(rng, body):
    rotation = turned(rng)
    while rotation[2, 2] >= 0.3:
        rotation = turned(rng)
    depth = rng.uniform(0.55, 0.85)
    centre = np.array([rng.uniform(-0.15, 0.15) * depth, rng.uniform(-0.12, 0.12) * depth, depth])
    pose = rigid(rotation, centre - rotation @ body.centre)
    own = SolidBody(Mesh(body.vertices, body.triangles), MATERIALS["metal"])
    bodies = [one.moved(pose) for one in [*wrist(), own]]
    tilt = rotation_from_rpy(rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.0)
    table = box([-1, -1, 0], [1, 1, 0.05]).moved(rigid(tilt, [0, 0, rng.uniform(0.95, 1.1)]))
    bodies.append(SolidBody(table, MATERIALS["table"]))
    for k in range(6):
        z = rng.uniform(0.6, 1.0)
        at = np.array([rng.uniform(-0.4, 0.4) * z, rng.uniform(-0.3, 0.3) * z, z])
        half, length, radius = (
            rng.uniform(0.02, 0.09, 3),
            rng.uniform(0.03, 0.2),
            rng.uniform(0.01, 0.05),
        )
        mesh = (
            box(-half, half)
            if k % 2
            else capsule(np.zeros(3), np.array([0, 0, length]), radius, 32)
        )
        if np.linalg.norm(at - centre) > 0.6 * body.size:
            bodies.append(SolidBody(mesh.moved(rigid(turned(rng), at)), MATERIALS["painted"]))
    return bodies, pose


class Trial(NamedTuple):
    """One scan: the poses found (or the reason for none), the true pose, and CPU time [s].

    ``there`` is whether the body is in the scan, with a correct or a mirrored mesh.
    """

    there: bool
    visible: bool
    found: list[PoseFeature]
    why: str
    pose: np.ndarray
    seconds: float
    peer_off: np.ndarray | None
    peer_seconds: float


def wrong(body, turn):
    """A mesh that is not the body's: mirrored, too large, in inches taken for millimetres, jaws moved."""
    points = body.vertices.copy()
    if turn % 4 == 0:
        points *= [-1, 1, 1]
    elif turn % 4 == 3 and body.name == "gripper":
        jaw = points[:, 2] > 0.107
        points[jaw, 0] += 0.01 * np.sign(points[jaw, 0])
    else:
        points *= (1.1, 1 / 1.1, 1 / 25.4)[turn % 4 % 3]
    return TargetBody(body.name, points, body.triangles)


def trial(name, seed, alone=True):
    """Search one scan for a body; in three of ten another is in its place, or its mesh is wrong."""
    rng = np.random.default_rng(seed)
    body, there = load_body(name, None, Path()), seed % 10 >= 3
    others = [other for other in BODIES if other != name]
    shown = load_body(others[seed // 10 % 2], None, Path()) if seed % 10 == 0 else body
    bodies, pose = scene(rng, as_made(shown, rng))
    capture = Capture(
        f"{seed:04d}", PointCloud(CAMERA, eye(rng).scan(RaycastScene(bodies), rng)), {}
    )
    turn = seed // 10 * 2 + seed % 10 - 1
    if seed % 10 in (1, 2):
        body = wrong(body, turn)
    points, shape = capture.cloud.points(), prepared(body)
    view = view_of(points, body.size / FINE_ACROSS)
    tolerance = max(0.003 * body.size, 3.5 * view.noise)
    visible = there and judged(shape, view, pose, tolerance).shown > VISIBLE
    there |= seed % 10 in (1, 2) and turn % 4 == 0
    start = time.process_time()
    found = segment_body(capture, body, Configuration(), Earlier([]), SegmentBodyParams())
    fits = [found]
    if not isinstance(found, Rejected):
        fits = [fit_body(each, body, FitBodyParams(), SCANNER) for each in found.alone]
    taken = time.process_time() - start
    features = [each for each in fits if isinstance(each, PoseFeature)]
    why = "" if features else fits[0].reason
    start = time.process_time()
    peer_off = None if alone else error(peer(points, body), pose)
    return Trial(there, visible, features, why, pose, taken, peer_off, time.process_time() - start)


def session(trials, rng):
    """Return the pose found in each scan, or None; the arm's motion decides between several."""
    arm = [
        rigid(rotation_exp(rng.normal(0, 3e-4, 3)), rng.normal(0, 2e-4, 3)) @ one.pose
        for one in trials
    ]
    held = [
        [
            Observation(str(k), feature, {FLANGE: Transform(BASE, FLANGE, arm[k])})
            for feature in one.found
        ]
        for k, one in enumerate(trials)
    ]
    sure = [poses[0] for poses in held if len(poses) == 1]
    open_ = [poses for poses in held if len(poses) > 1]
    told = disambiguated(cell_of(Configuration(stands=ORIGIN), None), sure, open_, True)
    by = {one.id: one.feature for one in [*sure, *told] if one}
    return [by.get(str(k)) for k in range(len(trials))]


def peer(points, body):
    """Return the pose by Open3D: FPFH, RANSAC, and point-to-plane ICP."""
    import open3d as o3d

    registration: Any = o3d.pipelines.registration  # its stubs ask for what is optional
    o3d.utility.random.seed(0)
    step = body.size / 50

    def prepare(cloud):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * step, 30))
        cloud.orient_normals_towards_camera_location()
        near = o3d.geometry.KDTreeSearchParamHybrid(5 * step, 100)
        return cloud, registration.compute_fpfh_feature(cloud, near)

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(float)))
    scan, of_scan = prepare(cloud.voxel_down_sample(step))
    outside, normals = prepared(body).outside
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(outside))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    model = cloud.voxel_down_sample(step)
    near = o3d.geometry.KDTreeSearchParamHybrid(5 * step, 100)
    of_model = registration.compute_fpfh_feature(model, near)
    rough = registration.registration_ransac_based_on_feature_matching(
        model, scan, of_model, of_scan, False, 1.5 * step,
        registration.TransformationEstimationPointToPoint(False), 3,
        [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
         registration.CorrespondenceCheckerBasedOnDistance(1.5 * step)],
        registration.RANSACConvergenceCriteria(400_000, 0.999),
    )  # fmt: skip
    fine = registration.registration_icp(
        model, scan, step, rough.transformation,
        registration.TransformationEstimationPointToPlane(),
    )  # fmt: skip
    return fine.transformation


def error(found, pose):
    """Turn [rad] and shift [m] of a pose from the true one."""
    turn = found[:3, :3] @ pose[:3, :3].T
    return np.r_[rotation_log(turn[None])[0], found[:3, 3] - pose[:3, 3]]


def right(off, size):
    """Whether a pose is the body's: within five hundredths of its size."""
    return np.linalg.norm(off[:3]) * size + np.linalg.norm(off[3:]) < 0.05 * size


def summary(name, trials):
    """How many were found, refused and wrong, and stated over true errors; what went wrong before."""
    size, rng = load_body(name, None, Path()).size, np.random.default_rng(len(trials))
    parts = [trials[k : k + SESSION] for k in range(0, len(trials), SESSION)]
    told = [one for part in parts for one in session(part, rng)]
    seen = [k for k, one in enumerate(trials) if one.visible]
    offs = {
        k: error(one.camera_T_target.matrix, trials[k].pose) for k, one in enumerate(told) if one
    }
    good = [k for k in offs if trials[k].there and right(offs[k], size)]
    alone = [k for k in good if len(trials[k].found) == 1]
    chi = [offs[k] @ np.linalg.solve(told[k].covariance, offs[k]) / 6 for k in good]
    lost = [k for k in range(len(trials)) if k not in good and (k in seen or k in offs)]
    lines = [f"  scan {k}: {_what(trials[k], k in offs)}\n" for k in lost]
    text = (
        f"{''.join(lines)}{name}, {len(trials)} scans, {len(seen)} with {VISIBLE:.0%} of its view seen, "
        f"{sum(not one.there for one in trials)} without it\n"
        f"  flangeye  right {len(good)}, of these visible {sum(k in good for k in seen)}, by their "
        f"scan alone {sum(k in alone for k in seen)}, "
        f"wrong {len(offs) - len(good)}, off {_median([1e3 * _length(offs[k][3:]) for k in good])} mm, "
        f"normalised error squared {np.mean(chi) if chi else np.nan:.2f} of 1, "
        f"{np.mean([one.seconds for one in trials]):.2f} s CPU"
    )
    if trials[0].peer_off is None:
        return text
    peers = [one for one in trials if one.there and right(one.peer_off, size)]
    peer_off = [1e3 * _length(one.peer_off[3:]) for one in peers]
    return text + (
        f"\n  FPFH+ICP  right {len(peers)}, of these visible {sum(one.visible for one in peers)}, "
        f"wrong {len(trials) - len(peers)}, off {_median(peer_off)} mm, "
        f"{np.mean([one.peer_seconds for one in trials]):.2f} s CPU"
    )


def _what(one, taken):
    """Return a text on a failure: the chosen pose or the reason for none, and the smallest error."""
    offs = [error(each.camera_T_target.matrix, one.pose) for each in one.found]
    why = "WRONG" if taken else one.why or f"{len(offs)} poses"
    why = why if one.there else f"{why}, without it"
    if not offs:
        return why
    off = min(offs, key=_length)
    return f"{why}, {1e3 * _length(off[3:]):.1f} mm, {np.degrees(_length(off[:3])):.1f} deg off"


def _length(vector):
    return float(np.linalg.norm(vector))


def _median(values):
    return f"{np.median(values):.2f}" if values else "-"


def main(scans, names, first, alone):
    for name in names:
        trials = []
        for k in range(scans):
            trials.append(trial(name, first + k, alone))
            print(f"  {name} {first + k}: {_what(trials[-1], False)}", flush=True)
        print(summary(name, trials), flush=True)


if __name__ == "__main__":
    words = argparse.ArgumentParser()
    words.add_argument("scans", type=int)
    words.add_argument("bodies", nargs="*", default=BODIES)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--alone", action="store_true", help="without Open3D beside it")
    asked = words.parse_args()
    main(asked.scans, asked.bodies, asked.first, asked.alone)
