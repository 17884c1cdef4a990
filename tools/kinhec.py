"""Solve the sequences of the KinHEC benchmark, and write the table of docs/reference/kinhec.md.

    pip install kinhec && kinhec generate --tier smoke --out kinhec
    python -m tools.kinhec kinhec

Every sequence is solved as ``acquire.samples`` and ``solve.robust`` would with their defaults, from
the pairs of poses that the benchmark's own eleven reference solvers are given. Of the monocular
track, whose cameras do not know how far they see, with `target_size: unknown`. Three sequences of
the motion track turn about one axis exactly: no solver can know the translation along it, and what
the references leave there is what they guess.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
import typer

from flangeye import FlangeyeError
from flangeye.models.configuration import Configuration
from flangeye.types import BASE, CAMERA, FLANGE, TARGET, Observation, PoseFeature, Transform
from flangeye_plugins.solve.robust import RobustParams, solve_poses

ANGLE_NOISE, POSITION_NOISE = np.radians(0.2), 0.5e-3
"""The defaults of acquire.samples [rad, m]."""
PAGE = Path(__file__).parents[1] / "docs" / "reference" / "kinhec.md"


def observations(sequence):
    """Return a sequence's pairs of poses as observations of a marker."""
    offset = None if sequence.synchronous else sequence.time_offset
    flanges, seen = sequence.axyb_poses(time_offset=offset)
    markers = np.linalg.inv(seen) if sequence.eye_in_hand else seen
    covariance = np.diag(np.square([ANGLE_NOISE] * 3 + [POSITION_NOISE] * 3))
    return [
        Observation(
            f"{i:05d}",
            PoseFeature(Transform(CAMERA, TARGET, marker), covariance),
            {FLANGE: Transform(BASE, FLANGE, flange)},
        )
        for i, (flange, marker) in enumerate(zip(flanges, markers, strict=True))
    ]


def error(sequence):
    """Return the error of X [mm], or why there is none."""
    hand = sequence.eye_in_hand
    cell = Configuration("eye-in-hand", FLANGE, BASE) if hand else Configuration()
    name = "flange_T_camera" if hand else "flange_T_target"
    size = "unknown" if sequence.manifest["track"] == "monocular" else "known"
    try:
        params = RobustParams(target_size=size)
        found = solve_poses(observations(sequence), params, None, cell)
    except FlangeyeError as refused:
        return str(refused)
    place = found.transforms[name].transform.translation
    return 1e3 * float(np.linalg.norm(place - sequence.X[:3, 3]))


def references(sequence):
    """Return the errors of X [mm] of the benchmark's solvers, by name."""
    from kinhec import benchmark

    rows = benchmark.evaluate_sequence(sequence, list(benchmark.SOLVERS), "oracle")
    return {row["solver"]: row["X_trans_err_mm"] for row in rows}


def main(data: Path) -> None:
    """Solve every sequence of DATA and write the page."""
    from kinhec import load_manifest, load_sequence

    manifest, tracks, lines, refusals = load_manifest(data), defaultdict(list), [], []
    for name in manifest["sequence_id"]:
        sequence = load_sequence(data, name, manifest)
        ours, theirs = error(sequence), references(sequence)
        best = min(theirs, key=lambda k: theirs[k] if np.isfinite(theirs[k]) else np.inf)
        if isinstance(ours, str):
            refusals.append(f"- {name}: {ours}")
            ours = np.nan
        tracks[sequence.manifest["track"]].append((ours, theirs))
        told = "refused" if np.isnan(ours) else f"{ours:.2f}"
        lines.append(f"| {name} | {told} | {theirs[best]:.2f} | {best} |")
        print(lines[-1], flush=True)
    PAGE.write_text("\n".join(page(tracks, lines, refusals)) + "\n")


def page(tracks, lines, refusals):
    """Give the page's lines."""
    yield "# KinHEC\n\n" + (__doc__ or "").split("\n", 2)[2]
    yield "Median error of X per track [mm]; the reference is the solver with the least median.\n"
    yield "| track | flangeye | refused | best reference | which |\n|---|---|---|---|---|"
    for track, found in tracks.items():
        medians = {k: np.nanmedian([t[k] for _, t in found]) for k in found[0][1]}
        best = min(medians, key=medians.__getitem__)
        ours = [o for o, _ in found if np.isfinite(o)]
        told = f"{np.median(ours):.2f}" if ours else "—"
        refused = f"{len(found) - len(ours)} of {len(found)}"
        yield f"| {track} | {told} | {refused} | {medians[best]:.2f} | {best} |"
    yield "\nEach sequence [mm]; the reference is the best of eleven on that sequence, by the truth.\n"
    yield "| sequence | flangeye | best reference | which |\n|---|---|---|---|"
    yield from lines
    yield "\nWhat was refused, and why:\n"
    yield from refusals


if __name__ == "__main__":
    typer.run(main)
