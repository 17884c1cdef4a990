"""The history as one HTML page that needs no network."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flangeye.files.regular import write_whole
from flangeye.workflow.doctor.monitor.drift import DriftTest
from flangeye.workflow.doctor.monitor.history import CheckFinding, History
from flangeye.workflow.report.look import LIGHT, SERIES, templates

STATE_COLOURS = {
    "OK": LIGHT["verified"],
    "DEGRADED": LIGHT["unverified"],
    "MOVED": LIGHT["refused"],
}


def write_chart(history: History, test: DriftTest, path: Path, simulated: bool) -> None:
    """Write the chart of every check; its title says whether the calibration is simulated.

    Raises:
        StageError: It cannot be written.
    """
    last = history.findings[-1]
    page = templates(Path(__file__).parent).get_template("chart.html.j2").render(
        ink=LIGHT["ink"], paper=LIGHT["paper"],
        state=last.state, colour=STATE_COLOURS[last.state], sentence=sentence(last),
        figure=figure(history, test).to_html(full_html=False, include_plotlyjs="inline"),
        simulated=simulated, checks=len(history.findings), path=history.path,
        rate=test.false_alarms,
    )  # fmt: skip
    write_whole(path, page)


def sentence(finding: CheckFinding) -> str:
    """Return a check's finding as a sentence."""
    how_far = f"the work is off by {finding.shift * 1e3:.2f} mm at its worst corner"
    if finding.since is None:
        return f"{how_far}, which is within what the calibration allows."
    part = f"; most likely {finding.part} ({finding.probability:.0%})" if finding.part else ""
    return f"{how_far}, since check {finding.since}{part}."


def figure(history: History, test: DriftTest) -> Any:
    """Return the chart as a plotly figure: shift and test statistic over the checks."""
    from plotly.subplots import make_subplots

    chart = make_subplots(
        rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.65, 0.35]
    )
    at = _axis(history)
    colours = [STATE_COLOURS[f.state] for f in history.findings]
    shifts = [f.shift * 1e3 for f in history.findings]
    chart.add_scatter(
        x=at, y=shifts, mode="lines+markers", line={"color": LIGHT["axis"], "width": 1},
        marker={"color": colours, "size": 8}, text=[f.state for f in history.findings],
        hovertemplate="%{y:.3f} mm, %{text}<extra></extra>", row=1, col=1,
    )  # fmt: skip
    chart.add_scatter(
        x=at, y=[f.statistic for f in history.findings], mode="lines",
        line={"color": SERIES["used"]}, hovertemplate="%{y:.2f}<extra></extra>", row=2, col=1,
    )  # fmt: skip
    limit = test.limit * 1e3
    chart.add_hline(y=limit, line_color=STATE_COLOURS["MOVED"], line_dash="dot", row=1, col=1)
    chart.add_hline(
        y=limit / 2, line_color=STATE_COLOURS["DEGRADED"], line_dash="dot", row=1, col=1
    )
    chart.add_hline(y=1.0, line_color=STATE_COLOURS["MOVED"], line_dash="dot", row=2, col=1)
    chart.update_yaxes(title_text="shift of the work, mm", rangemode="tozero", row=1, col=1)
    chart.update_yaxes(title_text="step test / threshold", rangemode="tozero", row=2, col=1)
    if len(at) == 1:  # nothing else fixes the axis, and it would show the milliseconds
        chart.update_xaxes(tickvals=at)
    chart.update_layout(
        template="plotly_white", height=560, showlegend=False, margin={"t": 20, "r": 20}
    )
    return chart


def _axis(history: History) -> list[Any]:
    # Checks of unknown or equal times are placed by their number
    times = [c.time_ns for c in history.checks[: len(history.findings)]]
    if all(times) and len(set(times)) == len(times):
        return [datetime.fromtimestamp(x // 10**9, UTC) for x in times]
    return list(range(len(times)))
