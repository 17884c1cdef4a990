"""What verify steps drew while they judged: pictures, and points over a value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from flangeye.errors import StageError
from flangeye.log.read import JournalEntry, read_notes
from flangeye.report.facts import Facts
from flangeye.report.images import data_uri
from flangeye.report.plot import AXES, HELD_OUT, USED, Figure, layout2d, plain

COLOURS = (*AXES, USED, HELD_OUT)


@dataclass(frozen=True)
class Drawing:
    """One drawing of a check.

    Attributes:
        step: The verify step, such as ``4.verify.stitch``.
        summary: What the step found, in its own words.
        picture: As a data URI; empty for a figure.
        figure: For plotly; None for a picture.
    """

    step: str
    summary: str
    picture: str = ""
    figure: Figure | None = None


def drawings_of(facts: Facts) -> list[Drawing]:
    """Return what the verify steps of a run drew; nothing of a log that is damaged."""
    found = facts.log.of_kind("verify")
    judged = {e.step: e.value.reason for e in found if e.step in facts.log.noted}
    if not judged:
        return []
    try:
        return list(_drawn(facts, judged))
    except StageError:
        return []  # the report says of the damage already


def _drawn(facts: Facts, judged: dict[str, str]) -> Iterator[Drawing]:
    for note in read_notes(facts.log.path, set(judged)):
        summary = judged[note.step]
        if note.name == "comparison":
            yield Drawing(note.step, summary, figure=_figure(note))
        elif not isinstance(note.value, dict):
            yield Drawing(note.step, summary, data_uri(note.value))


def _figure(note: JournalEntry) -> Figure:
    """Return points by series over a value, as a step noted them."""
    value: dict[str, Any] = note.value
    traces = [
        {
            "type": "scatter", "mode": "markers", "name": plain(name),
            "x": [x for x, _ in points], "y": [y for _, y in points],
            "marker": {"color": colour, "size": 8},
        }
        for (name, points), colour in zip(value["series"].items(), COLOURS, strict=False)
    ]  # fmt: skip
    layout = {**layout2d(plain(value["x"]), plain(value["y"])), "showlegend": len(traces) > 1}
    layout["yaxis"]["zeroline"] = True
    return {"data": traces, "layout": layout}
