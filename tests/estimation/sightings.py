"""Sightings of known truth, as certificates take them."""

from typing import Any

import numpy as np

from flangeye.estimation.certify.lifted import Factors, LiftedSightings
from flangeye.types import Floats
from flangeye.types.geometry import invert, rigid, rotation_exp, rotation_log


def anywhere(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return rigid(turn, rng.uniform(-1, 1, 3))


def moved(rng: np.random.Generator, n: int, turn: float) -> Floats:
    """Return n places near one another."""
    turns = rotation_exp(rng.uniform(-turn, turn, (n, 3)))
    shifts = rng.uniform(-0.4, 0.4, (n, 3))
    return np.array([rigid(r, t) for r, t in zip(turns, shifts, strict=True)])


def sighted(noise: tuple[float, float], seed: int) -> tuple[LiftedSightings, Floats, Floats]:
    """Fifteen sightings of A X M = Y with noise [rad, m], X and Y."""
    rng = np.random.default_rng(seed)
    x, y, seen = anywhere(rng), anywhere(rng), []
    a = np.array([rigid(rotation_exp(rng.uniform(-0.8, 0.8, 3)), rng.uniform(-0.4, 0.4, 3))
                  for _ in range(15)])  # fmt: skip
    for exact in invert(a @ x) @ y:
        turn = exact[:3, :3] @ rotation_exp(noise[0] * rng.standard_normal(3))
        seen.append(rigid(turn, exact[:3, 3] + noise[1] * rng.standard_normal(3)))
    still = np.broadcast_to(np.eye(4), a.shape)
    return (
        of_two((a, np.array(seen), still, still), *(np.full(15, each**-2.0) for each in noise)),
        x,
        y,
    )


def of_two(sides: Any, turning: Floats, shifting: Floats) -> LiftedSightings:
    """Return sightings of ``A X M = B Y D`` with errors alike in all directions."""
    a, m, b, d = sides
    each = np.repeat(np.stack([turning, shifting], axis=1), 3, axis=1)
    first, still = np.zeros(len(a), dtype=np.intp), np.tile(np.eye(4), (len(a), 1, 1))
    camera, target = (
        Factors(still, first + 2, a, first, m),
        Factors(still, first + 2, b, first + 1, d),
    )
    return LiftedSightings(camera, target, each[:, :, None] * np.eye(6), np.full(len(a), 6.0))


def of_three(noise: tuple[float, float], seed: int, n: int = 15) -> tuple[LiftedSightings, Floats]:
    """Return sightings of ``A X M = Y B Z`` with noise [rad, m], and X, Y and Z."""
    rng = np.random.default_rng(seed)
    x, y, z = places = np.array([anywhere(rng) for _ in range(3)])
    a, b = (anywhere(rng) @ moved(rng, n, 0.4) for _ in range(2))
    m = invert(a @ x) @ y @ b @ z
    m[:, :3, :3] = rotation_exp(noise[0] * rng.standard_normal((n, 3))) @ m[:, :3, :3]
    m[:, :3, 3] += noise[1] * rng.standard_normal((n, 3))
    still, none = np.tile(np.eye(4), (n, 1, 1)), np.full(n, 3)
    camera, target = (
        Factors(still, none, a, none - 3, m),
        Factors(still, none - 2, b, none - 1, still),
    )
    each = np.repeat(np.power(noise, -2.0), 3)
    weights = np.tile(np.diag(each), (n, 1, 1))
    return LiftedSightings(camera, target, weights, np.full(n, 6.0)), places


def errors_of(s: LiftedSightings, places: Floats) -> float:
    """Return the weighed squares of one side less the other, half of the rotation matrices'."""
    off = s.camera.at(places) - s.target.at(places)
    turned, shifted = (off[:, :3, :3] ** 2).sum(axis=(1, 2)), (off[:, :3, 3] ** 2).sum(axis=1)
    return float(s.weights[:, 0, 0] @ turned / 2 + s.weights[:, 3, 3] @ shifted)


def any_sightings(seed: int) -> LiftedSightings:
    """Return sightings in which nothing rests, of different weights."""
    rng = np.random.default_rng(seed)
    a, m, b, d = (np.array([anywhere(rng) for _ in range(6)]) for _ in range(4))
    return of_two((a, m, b, d), rng.uniform(1, 3, 6), rng.uniform(1, 3, 6))


def squared(s: LiftedSightings, places: Floats) -> float:
    """Return the weighed squares of the turns and shifts that take one side to the other."""
    left, right = s.camera.at(places), s.target.at(places)
    turns = rotation_log(left[:, :3, :3] @ np.swapaxes(right[:, :3, :3], 1, 2))
    off = np.concatenate([turns, left[:, :3, 3] - right[:, :3, 3]], axis=1)
    return float(np.einsum("ni,nij,nj->", off, s.weights, off))
