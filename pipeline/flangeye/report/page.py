"""Put the page together: sections and figures into the template, plotly.js and all inside."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from flangeye import __version__
from flangeye.errors import StageError
from flangeye.report.account import provenance_of, set_aside_of, timings_of
from flangeye.report.cell import cell_drawing
from flangeye.report.clouds import cloud_panels
from flangeye.report.facts import Facts, facts_of
from flangeye.report.images import image_view
from flangeye.report.residuals import errors_of, residual_figure
from flangeye.report.seam import seam_view
from flangeye.report.space import workspace_drawing
from flangeye.report.summary import headlines_of, transform_text, verdict_of
from flangeye.report.units import degrees, millimetres, percent
from flangeye.report.weld import weld_drawing
from flangeye.runlog import RunLog

if TYPE_CHECKING:
    from jinja2 import Environment

_HERE = Path(__file__).parent


def write_report(log: RunLog, path: Path) -> None:
    """Write the report of a run, finished or not, as one HTML file that needs nothing else.

    Args:
        log: What :func:`flangeye.runlog.read_run` gave.
        path: The file to write.

    Raises:
        StageError: The file cannot be written.
    """
    page = render(log)
    try:
        path.write_bytes(page.encode("utf-8", "replace"))
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from None


def render(log: RunLog) -> str:
    """Return the page as text."""
    facts = facts_of(log)
    return _environment().get_template("report.html.j2").render(_content(facts))


def _content(facts: Facts) -> dict[str, Any]:
    """Return what the template shows, in reading order."""
    from plotly.offline import get_plotlyjs

    errors = errors_of(facts)
    return {
        "facts": facts,
        "result": facts.result,
        "verdict": verdict_of(facts),
        "headlines": headlines_of(facts),
        "transforms": [transform_text(*item) for item in facts.result.transforms.items()],
        "errors": errors,
        "residuals": residual_figure(errors),
        "workspace": workspace_drawing(facts),
        "panels": cloud_panels(facts),
        "image": image_view(facts),
        "cell": cell_drawing(facts),
        "seam": seam_view(facts),
        "weld": weld_drawing(facts),
        "set_aside": set_aside_of(facts),
        "timings": timings_of(facts),
        "provenance": provenance_of(facts),
        "plotly_js": get_plotlyjs(),
        "version": __version__,
    }


def _environment() -> Environment:
    """Return templates that escape everything, for ids, reasons and titles come from anywhere."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    environment.filters |= {"mm": millimetres, "deg": degrees, "percent": percent}
    return environment
