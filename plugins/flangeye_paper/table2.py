"""Table 2: a calibration sphere beside the flange itself, simulated."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye.types.geometry import rpy_from_rotation
from flangeye_paper import tables

TARGETS = {"flange": "#1d4ed8", "sphere": "#d97706"}


class Trials(NamedTuple):
    """Calibrations of one kind.

    Attributes:
        target: The seen target.
        pairs: Poses of each.
        narrow: Whether the poses covered a small range only.
        errors: (N, 6) errors at the camera's origin, mm and deg.
        workspace: (N,) rms over the workspace [mm].
        refused: Number of trials without an answer.
    """

    target: str
    pairs: int
    narrow: bool
    errors: Floats
    workspace: Floats
    refused: int


def table2(batches: tables.Batches, out: tables.OutOption = Path()) -> None:
    """Write table2.csv and table2.png.

    Args:
        batches: Folder with the batches table2_<target> and table2-narrow_<target>.
        out: Folder for the files.
    """
    trials = []
    for target in TARGETS:
        wide = tables.read_sessions(batches / f"table2_{target}")
        for counts, pairs in (("[2, 2, 1]", 4), ("[4, 2, 2]", 16)):
            chosen = [s for s in wide if s.row["steps.0.poses.grid.counts"] == counts]
            trials.append(_trials(target, pairs, False, chosen))
        narrow = tables.read_sessions(batches / f"table2-narrow_{target}")
        trials.append(_trials(target, 16, True, narrow))
    printed = [
        {"target": "sphere, Photoneo's software, the paper", "pairs": pairs.split()[0]}
        | tables.with_units(f"{v:+.2f}" for v in values)
        for pairs, values in tables.TABLE_2.items()
    ]
    rows = [_row(t) for t in trials]
    tables.write_csv(
        out / "table2.csv", [*rows, *({**dict.fromkeys(rows[0]), **p} for p in printed)]
    )
    _draw(trials).save(out / "table2.png")


def _trials(target: str, pairs: int, narrow: bool, sessions: Sequence[tables.SessionRow]) -> Trials:
    results = [session.result() for session in sessions if session.accepted]
    errors = [_error(result) for result in results]
    workspace = [result["truth"]["rms_over_workspace"] * 1e3 for result in results]
    missing = len(sessions) - len(results)
    return Trials(target, pairs, narrow, np.array(errors), np.array(workspace), missing)


def _error(result: dict[str, Any]) -> Floats:
    """Return the error camera'_T_camera as the paper has it, mm and deg."""
    found = np.array(result["transforms"]["base_T_camera"]["matrix"])
    error = np.linalg.inv(found) @ np.array(result["truth"]["base_T_camera"])
    return np.array([*error[:3, 3] * 1e3, *np.degrees(rpy_from_rotation(error[:3, :3]))])


def _row(trials: Trials) -> tables.Row:
    rms = np.sqrt((trials.errors**2).mean(axis=0))
    return {
        "target": trials.target + (", poses within 60 x 60 x 40 mm" if trials.narrow else ""),
        "pairs": trials.pairs,
        "trials": len(trials.errors),
        **tables.with_units(f"{v:.2f}" for v in rms),
        "worst translation mm": float(np.linalg.norm(trials.errors[:, :3], axis=1).max()),
        "workspace rms mm": float(np.median(trials.workspace)),
        "worst mm": float(trials.workspace.max()),
    }


def _draw(trials: Sequence[Trials]) -> Any:
    page = tables.sheet(1, 2, 9.0, 3.2)
    names = ["4 pairs", "16 pairs", "16 pairs,\nclose together"]
    for kind in trials:
        place = (2 if kind.narrow else [4, 16].index(kind.pairs)) + (
            0.1 if kind.target == "sphere" else -0.1
        )
        label = kind.target if kind.pairs == 4 else None
        norms = np.linalg.norm(kind.errors[:, :3], axis=1)
        for panel, values in zip(page.panels, (norms, kind.workspace), strict=True):
            panel.plot(
                [place] * len(values), values, "o", color=TARGETS[kind.target], alpha=0.5, ms=4,
                label=label,
            )  # fmt: skip
    for index, values in enumerate(tables.TABLE_2.values()):
        norm = float(np.linalg.norm(values[:3]))
        page.panels[0].plot(
            [index],
            [norm],
            "D",
            color=tables.PRINTED.colour,
            label=None if index else "Table 2, a sphere",
        )
    titles = ("translation at the camera's origin, as printed", "at the work: over the workspace")
    for panel, title in zip(page.panels, titles, strict=True):
        panel.set_xticks(range(3), names)
        panel.set_xlim(-0.5, 2.5)
        tables.logarithmic(panel, 0.05, 0.1, 0.2, 0.5, 1, 2, 5)
        tables.dress(panel, title, "", "error [mm]")
    tables.legend(page.panels[0], loc="upper right")
    return page
