"""Errors on poses that took no part, on the published recordings."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye import FlangeyeError
from flangeye.maths.statistics import rms
from flangeye_paper import tables
from flangeye_paper.published import stored_results

STAGE = "verify.holdout"

HELD_OUT_METHODS: Mapping[str, tables.PlotStyle] = {
    "all-data": tables.METHOD_LOOKS["all-data"],
    "algorithm-1": tables.METHOD_LOOKS["algorithm-1-held-out"],
    "robust": tables.METHOD_LOOKS["robust"],
    "robust-joints": tables.PlotStyle("solve.robust with joint offsets", "#0e7490"),
}


class CentreSet(NamedTuple):
    """One set of centres.

    Attributes:
        name: Name in messages and reports.
        stored: Name of the stored results that belong to these centres.
    """

    name: str
    stored: str | None


RECORDINGS: Mapping[str, CentreSet] = {
    "run.mcap": CentreSet("Aubo, 30 clouds by fit.rim", None),
    "aubo": CentreSet("Aubo, 54 published centres", "aubo"),
    "ur5": CentreSet("UR5, 52 published centres", "ur5"),
    "franka": CentreSet("Franka, 48 published centres", "franka"),
}
"""Published centres by the name of the archive's last folder or file."""


def heldout(
    batches: tables.Batches, archive: tables.FolderOption, out: tables.OutOption = Path()
) -> None:
    """Write heldout.csv and heldout.png.

    Poses that solve.robust sets aside when it sees them all are left out of ``rms`` for every
    method alike, so that methods are compared on the same poses; ``all poses`` leaves out none.

    Args:
        batches: Folder with the batches heldout_<method>.
        archive: The published folder.
        out: Folder for the file.
    """
    found = {method: _by_recording(batches, method) for method in HELD_OUT_METHODS}
    rows: list[tables.Row] = []
    for key, recording in RECORDINGS.items():
        observations = found["robust"][key][0].result()["observations"]
        kept = {o["id"] for o in observations if o["used"]}
        for method, look in HELD_OUT_METHODS.items():
            if key in found[method]:
                rows.append(_row(recording, look.label, found[method][key], kept))
        if recording.stored:
            rows.append(_stored_row(recording, archive, found["robust"][key][0], kept))
    tables.write_csv(out / "heldout.csv", rows)
    _draw(rows).save(out / "heldout.png")


def _by_recording(batches: Path, method: str) -> dict[str, list[tables.SessionRow]]:
    """Return the sessions of a method by recording, one for each split."""
    found: dict[str, list[tables.SessionRow]] = {}
    for session in _sessions(batches, method):
        key = Path(session.row["archive"]).name
        if key not in RECORDINGS:
            raise FlangeyeError(f"{session.folder}: ran on {key}, which this study does not know")
        found.setdefault(key, []).append(session)
    return found


def _sessions(batches: Path, method: str) -> Iterable[tables.SessionRow]:
    folders = [*batches.glob(f"heldout_{method}"), *sorted(batches.glob(f"heldout_{method}_*"))]
    for folder in folders or [batches / f"heldout_{method}"]:
        yield from (session for session in tables.read_sessions(folder) if session.accepted)


def _row(
    recording: CentreSet, label: str, splits: list[tables.SessionRow], kept: set[str]
) -> tables.Row:
    errors = [_errors(session) for session in splits]
    common = [rms([v for k, v in e.items() if k in kept]) for e in errors]
    return {
        "recording": recording.name,
        "method": label,
        "splits": len(splits),
        "rms mm": float(np.median(common)),
        "range over splits mm": f"{min(common):.3f} to {max(common):.3f}",
        "poses": len(kept),
        "all poses: rms mm": float(np.median([rms(list(e.values())) for e in errors])),
        "median mm": float(np.median([np.median(list(e.values())) for e in errors])),
        "of poses": len(errors[0]),
    }


def _errors(session: tables.SessionRow) -> dict[str, float]:
    """Return the held-out error of each pose [mm]."""
    for label, verification in session.result()["verifications"].items():
        if label.endswith(STAGE):
            return {k: v * 1e3 for k, v in verification["errors"].items()}
    raise FlangeyeError(f"{session.folder}: has no step {STAGE}")


def _stored_row(
    recording: CentreSet, archive: Path, session: tables.SessionRow, kept: set[str]
) -> tables.Row:
    """Return the errors of the authors' 50 stored answers on all poses, their pools included."""
    matrices, _ = stored_results(archive, recording.stored or "")
    poses = [o for o in session.result()["observations"] if o["centre_in_camera"]]
    centres = np.array([o["centre_in_camera"] for o in poses])
    tcps = np.array([o["tcp_in_base"] for o in poses])
    mapped = centres @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
    errors = np.linalg.norm(mapped - tcps, axis=2) * 1e3
    among = np.array([o["id"] in kept for o in poses])
    each = np.sqrt((errors[:, among] ** 2).mean(axis=1))
    return {
        "recording": recording.name,
        "method": "the authors' 50 stored results of Algorithm 1 (not held out)",
        "splits": len(each),
        "rms mm": float(np.median(each)),
        "range over splits mm": f"{each.min():.3f} to {each.max():.3f}",
        "poses": int(among.sum()),
        "all poses: rms mm": float(np.median(np.sqrt((errors**2).mean(axis=1)))),
        "median mm": float(np.median(errors)),
        "of poses": len(poses),
    }


def _draw(rows: list[tables.Row]) -> Any:
    page = tables.sheet(1, 1, 8.0, 3.4)
    panel = page.panels[0]
    looks = {look.label: look.colour for look in HELD_OUT_METHODS.values()}
    names = [recording.name for recording in RECORDINGS.values()]
    for row in rows:
        low, high = (float(v) for v in row["range over splits mm"].split(" to "))
        colour = looks.get(row["method"], "#d97706")
        place = names.index(row["recording"]) + _beside(row["method"], list(looks))
        label = None if row["method"] in {r["method"] for r in rows[: rows.index(row)]} else row
        panel.plot([place, place], [low, high], color=colour, linewidth=3, alpha=0.4)
        panel.plot(
            [place], [row["rms mm"]], "o", color=colour, label=label and str(label["method"])
        )
    panel.set_xticks(range(len(names)), names, fontsize=8)
    tables.dress(panel, "", "", "held-out error, rms [mm]")
    tables.logarithmic(panel, 0.2, 0.3, 0.5, 1, 2, 5)
    tables.legend(panel, loc="upper left", bbox_to_anchor=(0.0, 1.32), ncols=2)
    return page


def _beside(method: str, methods: list[str]) -> float:
    index = methods.index(method) if method in methods else len(methods)
    return (index - len(methods) / 2) * 0.13
