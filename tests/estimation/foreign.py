"""Sessions of arms by a generator that shares no code with the project: NumPy and SciPy alone.

Arms by the makers' Denavit-Hartenberg tables, with joint zeros, lengths, twists, backlash, encoders
once and twice a turn, sag and a drift over the session, the last three of which no effect of the
estimator describes as they are made here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

UR5E = dict(
    name="ur5e",
    a=np.array([0, -0.425, -0.3922, 0, 0, 0]),
    d=np.array([0.1625, 0, 0, 0.1333, 0.0997, 0.0996]),
    alpha=np.array([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]),
    modified=False,
    home=np.radians([0, -95, -105, -70, 90, 0]),
    flange=0.0,
)
PANDA = dict(
    name="franka-panda",
    a=np.array([0, 0, 0, 0.0825, -0.0825, 0, 0.088]),
    d=np.array([0.333, 0, 0.316, 0, 0.384, 0, 0]),
    alpha=np.array([0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2]),
    modified=True,
    home=np.radians([0, -20, 0, -120, 0, 100, 45]),
    flange=0.107,
)


@dataclass
class Errors:
    """What is wrong with one arm."""

    zeros: np.ndarray
    a: np.ndarray
    d: np.ndarray
    alpha: np.ndarray
    once: np.ndarray
    twice: np.ndarray
    sag: np.ndarray
    backlash: np.ndarray
    drift: np.ndarray


def draw_errors(arm: dict, s: float, rng: np.random.Generator) -> Errors:
    """Draw errors of an arm whose zeros are s [rad]; kinds differ a little from session to session."""
    n = len(arm["a"])

    def kind(size: float, shape=None) -> np.ndarray:
        return size * s * np.exp(0.3 * rng.standard_normal()) * rng.standard_normal(shape or n)

    return Errors(
        zeros=s * rng.standard_normal(n),
        a=kind(0.15),
        d=kind(0.15),
        alpha=kind(0.3),
        once=kind(0.2, (2, n)),
        twice=kind(0.07, (2, n)),
        sag=kind(0.7),
        backlash=np.abs(kind(0.1)),
        drift=kind(0.05),
    )


def pose(arm: dict, q: np.ndarray, e: Errors | None = None) -> np.ndarray:
    """Return (N, 4, 4) of the flange, with errors of lengths if there are any."""
    a, d, alpha = arm["a"], arm["d"], arm["alpha"]
    if e is not None:
        a, d, alpha = a + e.a, d + e.d, alpha + e.alpha
    out = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for i in range(q.shape[1]):
        turn = np.zeros((len(q), 4, 4))
        c, s = np.cos(q[:, i]), np.sin(q[:, i])
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
        turn[:, 2, 2] = turn[:, 3, 3] = 1
        turn[:, 2, 3] = d[i]
        tilt = np.eye(4)
        ca, sa = np.cos(alpha[i]), np.sin(alpha[i])
        tilt[1:3, 1:3] = [[ca, -sa], [sa, ca]]
        tilt[0, 3] = a[i]
        out = out @ tilt @ turn if arm["modified"] else out @ turn @ tilt
    end = np.eye(4)
    end[2, 3] = arm["flange"]
    return out @ end


def true_joints(arm: dict, q: np.ndarray, e: Errors, session: bool) -> np.ndarray:
    """Return the joints that an arm really has where it reports q."""
    moved = q + e.zeros
    moved = moved + e.once[0] * np.sin(q) + e.once[1] * np.cos(q)
    moved = moved + e.twice[0] * np.sin(2 * q) + e.twice[1] * np.cos(2 * q)
    # Weight: a joint about a level axis gives way by the lever of all that hangs on it.
    reach = np.linalg.norm(pose(arm, q)[:, :2, 3], axis=1)
    moved = moved + e.sag * np.array([0, 1, 0.5, 0.2, 0.1, 0, 0])[: q.shape[1]] * reach[:, None]
    if session:
        direction = np.sign(np.diff(q, axis=0, prepend=q[:1]))
        moved = moved + 0.5 * e.backlash * direction
        moved = moved + e.drift * np.linspace(-0.5, 0.5, len(q))[:, None]
    return moved


def joints_at(arm: dict, targets: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return joints (N, n) of (N, 4, 4) poses by Gauss-Newton from a start; NaN where it fails."""
    q = np.broadcast_to(start, (len(targets), len(arm["a"]))).copy()
    left = np.arange(len(q))
    for _ in range(60):
        now = pose(arm, q[left])
        error = _twist(targets[left], now)
        left, now, error = (each[np.abs(error).max(axis=1) > 1e-12] for each in (left, now, error))
        if not len(left):
            break
        jac = np.empty((len(left), 6, q.shape[1]))
        for i in range(q.shape[1]):
            step = np.zeros(q.shape[1])
            step[i] = 1e-6
            jac[:, :, i] = _twist(pose(arm, q[left] + step), now) / 1e-6
        jt = np.swapaxes(jac, 1, 2)
        change = (jt @ np.linalg.solve(jac @ jt + 1e-9 * np.eye(6), error[..., None]))[..., 0]
        q[left] += np.clip(change, -0.3, 0.3)
    bad = np.abs(_twist(targets, pose(arm, q))).max(axis=1) > 1e-8
    q[bad] = np.nan
    return q


def _twist(to: np.ndarray, frm: np.ndarray) -> np.ndarray:
    turned = Rotation.from_matrix(to[:, :3, :3] @ np.swapaxes(frm[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([turned, to[:, :3, 3] - frm[:, :3, 3]], axis=1)


@dataclass
class Session:
    """One session: what controller and camera report, and what is true."""

    arm: dict
    errors: Errors
    joints: np.ndarray
    reported: np.ndarray
    seen: np.ndarray
    camera: np.ndarray
    target: np.ndarray
    in_hand: bool
    box: np.ndarray
    middle: np.ndarray
    turns: np.ndarray


BOX = 0.24
"""Edge of the box of the work [m]."""


def session(kind: str, arm: dict, s: float, n: int, seed: int) -> Session:
    """Draw a session: kind is marker, hand, flange or centres.

    Flange positions are drawn in a box, orientations within 35 degrees of one (for a marker and in
    hand) or 20 (for a flange, which has to face the scanner).
    """
    rng = np.random.default_rng([seed, n, int(s * 1e6), len(kind)])
    errors = draw_errors(arm, s, rng)
    middle = pose(arm, arm["home"][None])[0]
    spread = np.radians(20 if kind in ("flange", "centres") else 35)
    reported, joints, turns = _poses(arm, middle, spread, n, rng)
    real = pose(arm, true_joints(arm, joints, errors, True), errors)
    camera, target = _places(kind, middle, rng)
    if kind == "hand":
        exact = np.linalg.inv(real @ camera) @ target
    else:
        exact = np.linalg.inv(camera) @ real @ target
    seen = _noisy(kind, exact, rng)
    return Session(arm, errors, joints, reported, seen, camera, target, kind == "hand",
                   middle[:3, 3] + BOX * np.array([[-0.5] * 3, [0.5] * 3]), middle, turns)  # fmt: skip


def _poses(arm, middle, spread, n, rng):
    out: list[np.ndarray] = []
    joints: list[np.ndarray] = []
    while len(out) < n:
        shift = rng.uniform(-0.5, 0.5, (2 * n, 3)) * BOX
        axis = rng.standard_normal((2 * n, 3))
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        turn = Rotation.from_rotvec(axis * spread * rng.uniform(0.3, 1, (2 * n, 1))).as_matrix()
        targets = np.tile(middle, (2 * n, 1, 1))
        targets[:, :3, 3] += shift
        targets[:, :3, :3] = middle[:3, :3] @ turn
        q = joints_at(arm, targets, arm["home"])
        good = np.isfinite(q).all(axis=1)
        out += list(targets[good])
        joints += list(q[good])
    reported, q = np.array(out[:n]), np.array(joints[:n])
    return reported, q, reported[:, :3, :3]


def _places(kind, middle, rng):
    wobble = Rotation.from_rotvec(0.1 * rng.standard_normal(3)).as_matrix()
    if kind == "hand":
        camera = np.eye(4)
        camera[:3, :3] = wobble
        camera[:3, 3] = rng.uniform(-0.05, 0.05, 3) + [0.06, 0, 0.04]
        target = np.eye(4)
        # What the camera looks at stands half a metre before it.
        view = middle @ camera
        target[:3, :3] = view[:3, :3] @ np.diag([1.0, -1.0, -1.0]) @ wobble
        target[:3, 3] = view[:3, 3] + 0.5 * view[:3, 2]
        return camera, target
    camera = np.eye(4)
    z = -middle[:3, 2]  # it looks at the flange's face
    x = np.cross([0.3, 0.7, 0.2], z)
    x /= np.linalg.norm(x)
    camera[:3, :3] = np.column_stack([x, np.cross(z, x), z]) @ wobble
    camera[:3, 3] = middle[:3, 3] - 0.8 * camera[:3, 2]
    target = np.eye(4)
    if kind == "marker":
        target[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
        target[:3, 3] = rng.uniform(-0.05, 0.05, 3) + [0, 0, 0.05]
    return camera, target


NOISE = {
    "marker": (0.5e-3, 0.1e-3),
    "hand": (0.5e-3, 0.1e-3),
    "flange": (1.0e-3, 0.06e-3),
    "centres": (1.0e-3, 0.06e-3),
}
"""Stated deviations: rotation [rad] and position [m] per axis."""


def _noisy(kind, exact, rng):
    """Return poses with noise 0.7 to 1.4 times as large as it is stated."""
    times = np.exp(rng.uniform(np.log(0.7), np.log(1.4), 2))
    rotation, position = np.array(NOISE[kind]) * times
    out = exact.copy()
    turn = Rotation.from_rotvec(rotation * rng.standard_normal((len(exact), 3))).as_matrix()
    out[:, :3, :3] = turn @ out[:, :3, :3]
    out[:, :3, 3] += position * rng.standard_normal((len(exact), 3))
    if kind in ("flange", "centres"):
        # The plate's face and the fit's rim are off alike in all scans.
        tilt = Rotation.from_rotvec(np.append(0.5e-3 * rng.standard_normal(2), 0)).as_matrix()
        out[:, :3, 3] += (out[:, :3, :3] @ (0.03e-3 * rng.standard_normal(3))[:, None])[..., 0]
        out[:, :3, :3] = out[:, :3, :3] @ tilt
    return out


# --- the truth of both answers ------------------------------------------------------------------


def work(s: Session, count: int = 4096) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flange poses of the work, reported and real (N, 4, 4), spread evenly over the box."""
    evenly = qmc.Sobol(4, rng=12345).random(count)
    targets = np.tile(np.eye(4), (count, 1, 1))
    targets[:, :3, :3] = s.turns[(evenly[:, 3] * len(s.turns)).astype(int)]
    targets[:, :3, 3] = s.box[0] + (s.box[1] - s.box[0]) * evenly[:, :3]
    q = joints_at(s.arm, targets, s.arm["home"])
    good = np.isfinite(q).all(axis=1)
    q = q[good]
    return targets[good], pose(s.arm, true_joints(s.arm, q, s.errors, False), s.errors), q


def best_rigid(frm: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return (4, 4) the rigid map of points (N, 3) onto others, least squares."""
    a, b = frm - frm.mean(0), to - to.mean(0)
    turn, _ = Rotation.align_vectors(b, a)
    out = np.eye(4)
    out[:3, :3] = turn.as_matrix()
    out[:3, 3] = to.mean(0) - out[:3, :3] @ frm.mean(0)
    return out


def reported_camera(s: Session, reported: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Return the camera's pose that maps what it sees onto reported coordinates best.

    Over poses of the work (N, 4, 4), reported and real.
    """
    onto = best_rigid(real[:, :3, 3], reported[:, :3, 3])
    if not s.in_hand:
        return onto @ s.camera
    # A camera in hand: everything it sees from poses of the work, where reported coordinates have
    # it; the points lie on the table about the target. Eight have the means of a cube of 100 mm.
    about = s.target[:3, 3] + 0.05 / np.sqrt(3) * np.array(list(product((-1, 1), repeat=3)))
    seen = _from(real @ s.camera, about)
    wanted = about @ onto[:3, :3].T + onto[:3, 3]
    return best_rigid(seen, _from(reported, wanted))


def _from(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N M, 3) points (M, 3) as each of (N, 4, 4) poses has them."""
    apart = points - poses[:, None, :3, 3]
    return np.einsum("nji,nmj->nmi", poses[:, :3, :3], apart).reshape(-1, 3)
