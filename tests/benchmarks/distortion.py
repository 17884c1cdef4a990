"""Whether stated regions hold the truth before a scanner that bends: python -m tests.benchmarks.distortion [SEEDS]

Prints, for each configuration with a circle, how often the stated 95 % region of the camera's pose
held the truth, and the error over what was seen, stated and true (rms over the seeds, mm). The
sessions are those of recipes/configurations, without images: the poses that are planned there, a
distortion as the simulated scanner has one, and fits of usual noise.
"""

import sys
from typing import Any

import numpy as np

from flangeye.maths.statistics import chi2_quantile
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, CircleFeature, Floats, HandEye, Observation, TransformEstimate
from flangeye.types.geometry import covariance_at, kabsch, rotation_exp, rotation_log
from flangeye_emulators.acquire.moments import MOST_OBLIQUE, CameraView, Moments
from flangeye_emulators.acquire.planned_session import plan_session
from flangeye_emulators.acquire.simulated_scans import ScanParams
from flangeye_emulators.world.raycast import pixels_of
from flangeye_emulators.world.scanner import Distortion
from flangeye_plugins.solve.robust import RobustParams, solve_cell

ROBOT, SCANNER = load_model("robots", "ur5"), load_model("scanners", "phoxi-m")
PIXELS = pixels_of(SCANNER, 0.05)
BEFORE_IT = (-0.5, 0.0, 0.0), (0.0, 0.0, 0.0)
IN_HAND = {"position": ["60 mm", "0 mm", "40 mm"], "rpy": ["0 deg", "0 deg", "90 deg"]}
CONFIGURATIONS: dict[str, tuple[Configuration, dict[str, Any]]] = {
    "eye-in-hand, base-circle": (
        Configuration("eye-in-hand", "flange", "base", BEFORE_IT),
        {"poses": 10},
    ),
    "eye-in-hand, circle-anywhere": (
        Configuration("eye-in-hand", "flange", "base"),
        {"poses": 12, "camera": IN_HAND},
    ),
    "eye-on-arm 1, flange": (Configuration("eye-on-arm", "link2", "flange", ORIGIN),
                             {"poses": 12}),
    "eye-on-arm 2, base-circle": (Configuration("eye-on-arm", "link3", "base", BEFORE_IT),
                                  {"poses": 12}),
}  # fmt: skip
RING = 30e-3 * np.array([(np.cos(a), np.sin(a), 0) for a in np.arange(6) * np.pi / 3])
CENTRE, NORMAL = 0.04e-3, 0.3e-3
"""Noise of a fit's centre along each axis [m], and of its normal [rad]."""


def bent(distortion: Distortion, points: Floats) -> Floats:
    """Return where a scanner has points (N, 3)."""
    out = []
    directions = PIXELS.directions
    for point in points:
        away = np.linalg.norm(directions[..., :2] - point[:2] / point[2], axis=-1)
        at = np.unravel_index(np.argmin(away), away.shape)
        depth = np.full(directions.shape[:2], point[2], dtype=np.float32)
        seen = distortion.points(depth + distortion.depth_error(depth))[at]
        out.append(point + seen - point[2] * directions[at])
    return np.array(out)


def session(name: str, seed: int, scale: float = 1.0) -> tuple[Moments, list[Observation]]:
    """Return a session, and what a scanner sees that bends by ``scale`` times its file's size."""
    configuration, given = CONFIGURATIONS[name]
    rng, params = np.random.default_rng(seed), ScanParams.model_validate(given)
    view = CameraView(
        params.distance, SCANNER.near, SCANNER.far, SCANNER.field_of_view, MOST_OBLIQUE
    )
    planned = plan_session(ROBOT, None, configuration, (params, view), rng)
    size = max(scale * SCANNER.calibration_error, 1e-12)
    distortion, found = Distortion(SCANNER, PIXELS, size, rng), []
    for i, seen in enumerate(planned.seen()):
        turn, shift = kabsch(RING, bent(distortion, RING @ seen[:3, :3].T + seen[:3, 3]))
        normal = rotation_exp(NORMAL * rng.standard_normal(3)) @ turn[:, 2]
        spread = NORMAL**2 * (np.eye(3) - np.outer(normal, normal))
        centre = shift + CENTRE * rng.standard_normal(3)
        circle = CircleFeature(centre, normal, {}, CENTRE**2 * np.eye(3), spread, 0.0)
        found.append(Observation(f"{i:02d}", circle, **planned.recorded(i)))
    return planned, found


def judged(name: str, seed: int, scale: float = 1.0, **params: str) -> tuple[float, float, float]:
    """Return the squared distance of the truth from a calibration, and stated and true error."""
    planned, seen = session(name, seed, scale)
    found: HandEye = solve_cell(seen, planned.cell, RobustParams.model_validate(params), SCANNER)
    centres = np.array([o.feature.centre for o in seen])
    return compared(found.camera, np.asarray(planned.actual[CAMERA].place), centres)


def compared(known: TransformEstimate, truth: Floats, seen: Floats) -> tuple[float, float, float]:
    """Return the squared distance of the truth, and the stated and true error where was seen."""
    matrix = known.transform.matrix
    turn = rotation_log((matrix[:3, :3] @ truth[:3, :3].T)[None])[0]
    mapped, real = (seen @ m[:3, :3].T + m[:3, 3] for m in (matrix, truth))
    about = matrix[:3, :3].T @ (known.about - matrix[:3, 3])
    shift = known.about - truth[:3, :3] @ about - truth[:3, 3]
    error = np.concatenate([turn, shift])
    stated = covariance_at(known.covariance, known.about, mapped)
    return (
        float(error @ np.linalg.solve(known.covariance, error)),
        float(np.trace(stated, axis1=1, axis2=2).mean()),
        float(((mapped - real) ** 2).sum(axis=1).mean()),
    )


def shares(name: str, seeds: int, scale: float = 1.0, **params: str) -> tuple[float, float, float]:
    """Return the share of regions that hold the truth, and stated and true error, rms [mm]."""
    each = np.array([judged(name, seed, scale, **params) for seed in range(seeds)])
    held = float((each[:, 0] <= chi2_quantile(0.95, 6)).mean())
    stated, true = np.sqrt(each[:, 1:].mean(axis=0)) * 1e3
    return held, float(stated), float(true)


def main(seeds: int) -> None:
    """Print the table."""
    print("| | held | stated | true | none: held | stated | true |")
    print("|---|" + 6 * "---|")
    for name in CONFIGURATIONS:
        rows = [
            shares(name, seeds),
            shares(name, seeds, scale=0.0),
        ]
        told = " | ".join(f"{h:.0%} | {s:.3f} | {t:.3f}" for h, s, t in rows)
        print(f"| {name} | {told} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
