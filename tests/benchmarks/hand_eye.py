"""Errors of every solver on simulated sessions: python -m tests.benchmarks.hand_eye [SESSIONS]

Prints the error of X over sessions of n poses within +-tilt, camera noise 0.05 deg and 0.1 mm per
axis, robot 0.2 mrad and 0.05 mm, beside the Cramer-Rao bound; then how often AXB = YCZ converges
from a random start.

    python -m tests.benchmarks.hand_eye --write sessions.npz

writes the sessions that tests/benchmarks/opencv4.py solves, with OpenCV 4 in an environment of its
own, for OpenCV 5 has no hand-eye functions:

    python -m venv cv4 && cv4/bin/pip install "opencv-python-headless<5"
    cv4/bin/python tests/benchmarks/opencv4.py sessions.npz > tests/benchmarks/opencv4.json
"""

import sys
from typing import Any

import numpy as np

from flangeye.estimation.start.closed import (
    alternate,
    motions_of,
    park_martin,
    random_rotations,
    shah,
)
from flangeye.estimation.start.sightings import problem_of
from flangeye.models.cell import cell_of
from flangeye.types.geometry import rotation_log
from flangeye_plugins.solve import literature
from flangeye_plugins.solve.robust import (
    RobustParams,
    solve_robust,
)
from tests.estimation.cells import CONFIGURATIONS, session

MARKER = CONFIGURATIONS["eye-in-hand, marker"]
CASES = {"n=15, 17 deg": (15, np.radians(17)), "n=8, 30 deg": (8, np.radians(30))}
BY_MOTIONS = {
    "tsai_lenz": literature.tsai_lenz,
    "park_martin": park_martin,
    "horaud_dornaika": literature.horaud_dornaika,
    "andreff": literature.andreff,
    "daniilidis": literature.daniilidis,
}
BY_BOTH = {"shah": shah, "li": literature.li}


def sessions(case: str, count: int) -> list:
    """Return the same sessions each time."""
    n, tilt = CASES[case]
    rng = np.random.default_rng(2026)
    return [session(MARKER, rng, n=n, tilt=tilt) for _ in range(count)]


def arrays(made) -> tuple[np.ndarray, np.ndarray]:
    """Return base_T_flange and camera_T_target, both (N, 4, 4)."""
    carried = np.array([o.base_T_flange.matrix for o in made.observations])
    return carried, np.array([o.feature.camera_T_target.matrix for o in made.observations])


def closed(name: str, made) -> np.ndarray:
    """Return X (4, 4) by a closed form."""
    carried, seen = arrays(made)
    if name in BY_BOTH:
        return BY_BOTH[name](carried, seen)[0]
    return BY_MOTIONS[name](motions_of(carried, seen))


def most_likely(made) -> np.ndarray:
    """Return X (4, 4) by solve.robust."""
    found = solve_robust(made.stream(), RobustParams(), configuration=made.configuration)
    return found.camera.transform.matrix


def rms(found: list, made: list) -> tuple[float, float]:
    """Return the error of X over sessions: rotation [deg] and translation [mm], both rms."""
    true = [m.truth["flange_T_camera"] for m in made]
    turns = [rotation_log(f[:3, :3] @ x[:3, :3].T) for f, x in zip(found, true, strict=True)]
    shifts = [f[:3, 3] - x[:3, 3] for f, x in zip(found, true, strict=True)]
    turn, shift = (np.sqrt((np.array(e) ** 2).sum(axis=1).mean()) for e in (turns, shifts))
    return float(np.degrees(turn)), float(shift * 1e3)


def bound(made: list) -> tuple[float, float]:
    """Return the Cramer-Rao bound of the same two figures, the arm's noise being known."""
    traces = []
    for m in made:
        problem = problem_of(m.observations, cell_of(MARKER, None))
        linear = problem.linearised(
            {"camera": m.truth["flange_T_camera"], "target": m.truth["base_T_target"]}
        )
        rows = np.concatenate([linear.blocks[name] for name in problem.unknown], axis=2)
        arm = np.diag(np.repeat(np.square((2e-4, 5e-5)), 3))
        of_arm = linear.blocks["flange"]
        noise = problem.seen.covariances + of_arm @ arm @ np.swapaxes(of_arm, 1, 2)
        known = np.linalg.inv(np.einsum("nai,nab,nbj->ij", rows, np.linalg.inv(noise), rows))
        traces.append([np.trace(known[:3, :3]), np.trace(known[3:6, 3:6])])
    turn, shift = np.sqrt(np.mean(traces, axis=0))
    return float(np.degrees(turn)), float(shift * 1e3)


def converged(count: int) -> int:
    """Return how often AXB = YCZ comes from one random start within 1 deg of the answer."""
    rng, good = np.random.default_rng(12), 0
    for _ in range(count):
        made = session(CONFIGURATIONS["two arms, marker"], rng)
        first = np.array([o.base_T_flange.rotation for o in made.observations])
        seen = np.array([o.feature.camera_T_target.rotation for o in made.observations])
        second = np.array([o.poses["flange2"].rotation for o in made.observations])
        (x, _, _), _ = alternate((first, seen, second), random_rotations(rng))
        true = made.truth["flange_T_camera"][:3, :3]
        good += bool(np.linalg.norm(rotation_log(x @ true.T)) < np.radians(1.0))
    return good


def main(words: list[str]) -> None:
    if words[:1] == ["--write"]:
        held: dict[str, Any] = {}
        for case in CASES:
            made = sessions(case, 60)
            held[f"{case}/carried"], held[f"{case}/seen"] = map(
                np.array, zip(*map(arrays, made), strict=True)
            )
            held[f"{case}/truth"] = np.array([m.truth["flange_T_camera"] for m in made])
        np.savez(words[1], **held)
        return
    count = int(words[0]) if words else 200
    for case in CASES:
        made = sessions(case, count)
        print(f"{case}, {count} sessions: error of X, rms")
        for name in [*BY_MOTIONS, *BY_BOTH]:
            print(
                "  {:20} {:.4f} deg {:.3f} mm".format(
                    name, *rms([closed(name, m) for m in made], made)
                )
            )
        print(
            "  {:20} {:.4f} deg {:.3f} mm".format(
                "robust", *rms([most_likely(m) for m in made], made)
            )
        )
        print("  {:20} {:.4f} deg {:.3f} mm".format("Cramer-Rao bound", *bound(made)))
    print(f"AXB = YCZ from one random start: {converged(count)} of {count} converge")


if __name__ == "__main__":
    main(sys.argv[1:])
