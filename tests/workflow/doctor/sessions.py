"""Sessions drawn quickly, with known truth: poses, and what an ideal scanner with noise saw."""

from dataclasses import replace

import numpy as np

from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy
from flangeye.workflow.doctor.diagnosis import RecordedSession

KINDS = ("flange", "centres", "marker", "point")
"""Circles with normals; ready-made centres; markers at an unknown place; points at one."""


CARRIED = ("target", "camera", "arm-1", "arm-2", "both")
"""What the arm carries; eye-on-arm, case 1 and 2; two arms."""


def clean(rng, n=20, kind="flange", carried="target", noise=0.1e-3, turn=0.3, box=(0.3, 0.3, 0.2)):
    """Return a session without a mistake."""
    poses = np.array([_pose(rng, turn, box) for _ in range(n)])
    known = kind in ("flange", "centres")
    # A marker that stands is before the camera, which looks up, and not inside the arm's base
    about = [0.55, -0.1, 0.9] if carried == "camera" else [0.0, 0.0, 0.0]
    target = rigid(rotation_exp(rng.normal(0, 0.5, 3)), rng.normal(about, 0.06))
    target = np.eye(4) if known else target
    camera = _camera(rng, carried)
    carriers, mounts, arms = _carriers(rng, carried, poses, lambda: _pose(rng, turn, box))
    seen = np.linalg.inv(carriers @ camera) @ mounts @ target
    turned = np.array([m[:3, :3] @ rotation_exp(rng.normal(0, 1e-3, 3)) for m in seen])
    nothing = np.full((n, 3), np.nan)
    return RecordedSession(
        ids=tuple(f"{i:03}" for i in range(n)),
        poses=poses,
        centres=seen[:, :3, 3] + rng.normal(0, noise, (n, 3)),
        normals=turned[:, :, 2] if kind == "flange" else nothing,
        rotations=turned if kind == "marker" else np.full((n, 3, 3), np.nan),
        places=np.zeros((n, 3)) if known else nothing,
        times=np.arange(n) * 5.0,
        carried={"arm-1": "target", "arm-2": "camera"}.get(carried, carried),
        **arms,
    )  # fmt: skip


def _carriers(rng, carried, poses, drawn):
    """Return what carries the camera and the target, and what else is reported of the arms."""
    eye = np.tile(np.eye(4), (len(poses), 1, 1))
    if carried in ("target", "camera"):
        return (eye, poses, {}) if carried == "target" else (poses, eye, {})
    others = np.array([drawn() for _ in poses])
    if carried == "both":
        base = rigid(rotation_exp(np.array([0.0, 0.1, 2.0])), np.array([1.2, 0.3, 0.0]))
        return poses, base @ others, {"seconds": others}
    if carried == "arm-1":
        return others, poses, {"links": others}
    return others, eye, {"links": others}


def in_motion(rng, n=40, **changes):
    """Return a session recorded while the arm moved on, ten times a second."""
    session = clean(rng, n, **changes)
    t = np.arange(n) * 0.1
    waves = np.sin(t[:, None] * rng.uniform(1, 3, 6) + rng.uniform(0, 6, 6))
    poses = np.array([
        rigid(rotation_exp(0.3 * w[:3]), np.array([0.5, 0.0, 0.4]) + 0.1 * w[3:]) for w in waves
    ])  # fmt: skip
    camera = _camera(rng, "target")
    seen = np.linalg.inv(camera) @ poses
    return replace(
        session,
        poses=poses,
        centres=seen[:, :3, 3] + rng.normal(0, 1e-4, (n, 3)),
        normals=seen[:, :3, 2],
        times=t,
    )


def bent(session, rng, by=0.3e-3):
    """Return the session with the smooth errors that an arm's kinematics have [m]."""
    poses = np.array(session.poses)
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    slope = rng.normal(0, 1, (3, 3)) * by / 0.3
    poses[:, :3, 3] += centred @ slope.T
    return session.with_poses(poses)


def _pose(rng, turn, box):
    position = np.array([0.55, -0.1, 0.3]) + (rng.random(3) - 0.5) * box
    return rigid(rotation_exp(rng.normal(0, turn, 3)), position)


def _camera(rng, carried):
    if carried != "target":
        return rigid(rotation_exp(rng.normal(0, 0.5, 3)), np.array([0.05, -0.03, 0.1]))
    return rigid(rotation_from_rpy(np.pi, 0.1, rng.uniform(-3, 3)), np.array([0.6, -0.1, 1.0]))
