"""The bar plot of the residual of every pose, with its held-out error beside it."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from textwrap import wrap
from typing import Any

import numpy as np

from flangeye.maths.statistics import rms
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES
from flangeye.workflow.report.plot import FigureData, Trace, plain
from flangeye.workflow.report.units import millimetres
from flangeye.workflow.result import contract as r


@dataclass(frozen=True)
class Errors:
    """Every error per pose [m].

    Attributes:
        poses: The measured poses, in order.
        residuals: Residual of each pose.
        held_out: Step -> pose -> error of the verifications that have errors per pose.
    """

    poses: tuple[r.ObservationResult, ...]
    residuals: Mapping[str, float]
    held_out: Mapping[str, Mapping[str, float]]

    @property
    def ids(self) -> list[str]:
        """Every pose that has an error, in order; those kept for verification come last."""
        measured = [o.id for o in self.poses]
        return list(dict.fromkeys([*measured, *(i for e in self.held_out.values() for i in e)]))

    def group(self, used: bool) -> dict[str, float]:
        """Return the residuals of used poses, or of the others."""
        ids = [o.id for o in self.poses if o.used is used and o.id in self.residuals]
        return {i: self.residuals[i] for i in ids}

    @property
    def limit(self) -> float:
        """Where the axis ends [m]: all bars fit, unless some dwarf those that count."""
        unused = self.group(used=False)
        held = [item for errors in self.held_out.values() for item in errors.items()]
        every = [*self.residuals.items(), *held]
        longest = max(error for _, error in every)
        kept = max((error for i, error in every if i not in unused), default=longest)
        # Bars longer than this times the longest that counts are cut off, so that the rest can be
        # read
        return 1.2 * (longest if longest <= 2.0 * kept else kept) or 1e-6

    @property
    def summary(self) -> str:
        """The plot's content in words."""
        used = self.group(used=True)
        if not used:
            return "No pose was used in an estimate."
        worst, lengths = max(used, key=lambda i: used[i]), np.array(list(used.values()))
        text = (
            f"Used poses: {millimetres(rms(lengths))} mm rms, "
            f"{millimetres(float(np.median(lengths)))} mm median, "
            f"largest {millimetres(used[worst])} mm ({worst})."
        )
        if max(self.residuals.values()) <= self.limit:
            return text
        return f"{text} Much longer bars are cut off and labelled with their length."


def errors_of(facts: Facts) -> Errors:
    """Return every error per pose that a run computed."""
    found = facts.result.verifications.items()
    held = {step: verification.errors for step, verification in found if verification.errors}
    return Errors(tuple(facts.measured), facts.residuals, held)


def residual_figure(errors: Errors) -> FigureData | None:
    """Return the plot, or None when there are no errors to show."""
    if not errors.residuals and not errors.held_out:
        return None
    names = _labels(errors.ids)
    traces = [
        _bars("residual, used", errors.group(used=True), SERIES["used"]),
        _bars("residual, not used", errors.group(used=False), SERIES["unused"]),
        *(_diamonds(step, held) for step, held in errors.held_out.items()),
    ]
    measured = {o.id: o for o in errors.poses}
    hover = {i: _hover(i, measured.get(i), errors) for i in errors.ids}
    drawn = [_placed(trace, names, hover) for trace in traces if trace["errors"]]
    return {"data": drawn, "layout": _layout(names, errors)}


def _bars(name: str, group: Mapping[str, float], colour: str) -> Trace:
    pattern = {"shape": "/", "size": 5, "solidity": 0.5} if colour == SERIES["unused"] else {}
    return {
        "type": "bar",
        "name": f"{name} ({len(group)})",
        "marker": {"color": colour, "pattern": pattern},
        "errors": group,
    }


def _diamonds(step: str, held: Mapping[str, float]) -> Trace:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": f"{plain(step, 40)}, pose left out",
        "marker": {"color": SERIES["held_out"], "symbol": "diamond", "size": 7},
        "errors": held,
    }


def _placed(trace: Trace, names: Mapping[str, str], hover: Mapping[str, str]) -> Trace:
    """Return the trace with its errors as coordinates and texts."""
    errors = trace.pop("errors")
    return {
        **trace,
        "x": [names[i] for i in errors],
        "y": [round(error * 1e3, 6) for error in errors.values()],
        "hovertext": [hover[i] for i in errors],
        "hoverinfo": "text",
    }


def _hover(capture: str, found: r.ObservationResult | None, errors: Errors) -> str:
    lines = [f"<b>{plain(capture, 60)}</b>"]
    if found and capture in errors.residuals:
        xyz = ", ".join(millimetres(x) for x in found.residual_in_base or [])
        lines += [f"residual {millimetres(errors.residuals[capture])} mm", f"x, y, z: {xyz} mm"]
    lines += [
        f"left out by {plain(step, 40)}: {millimetres(held[capture])} mm"
        for step, held in errors.held_out.items()
        if capture in held
    ]
    if found and found.reason:
        lines += [escape(line) for line in wrap(f"not used: {found.reason[:400]}", 60)]
    return "<br>".join(lines)


def _labels(ids: list[str]) -> dict[str, str]:
    """Return a label for each id, short where that leaves them different."""
    short = {i: plain(i, 12) for i in ids}
    return short if len(set(short.values())) == len(ids) else {i: escape(i) for i in ids}


def _layout(names: Mapping[str, str], errors: Errors) -> dict[str, Any]:
    limit = errors.limit
    cut = {names[i]: error for i, error in errors.residuals.items() if error > limit}
    return {
        "annotations": [_length_of_cut_bar(name, error, limit) for name, error in cut.items()],
        "xaxis": {
            "type": "category",
            "categoryorder": "array",
            "categoryarray": list(names.values()),
            "tickangle": -60,
            "automargin": True,
        },
        "yaxis": {"title": {"text": "error [mm]"}, "range": [0, limit * 1e3]},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        "margin": {"l": 56, "r": 8, "t": 8, "b": 8},
        "bargap": 0.25,
        "showlegend": True,
    }


def _length_of_cut_bar(name: str, error: float, limit: float) -> dict[str, Any]:
    return {
        "x": name,
        "y": limit * 1e3,
        "text": f"{millimetres(error)}↑",
        "textangle": -90,
        "yanchor": "top",
        "showarrow": False,
        "bgcolor": "#7a4e00",
        "font": {"color": "#fff", "size": 12},
    }
