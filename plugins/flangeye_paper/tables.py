"""Read the results of ``flangeye batch``, and write figures and tables in the paper's style."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from flangeye import FlangeyeError
from flangeye.workflow.batch.outcome import ACCEPTED

Batches = Annotated[Path, typer.Argument(help="Folder of the study's batches.")]
FolderOption = Annotated[Path, typer.Option(help="The authors' published folder.")]
OutOption = Annotated[Path, typer.Option(help="Folder for CSV files and pictures.")]
Row = Mapping[str, Any]


@dataclass(frozen=True)
class SessionRow:
    """One session of a batch.

    Attributes:
        row: Row of ``sessions.csv``.
        folder: Folder with ``result.json``.
    """

    row: Mapping[str, str]
    folder: Path

    @property
    def accepted(self) -> bool:
        """Whether the session gave a calibration."""
        return self.row["status"] in ACCEPTED

    def result(self) -> dict[str, Any]:
        """Return the document ``result.json``.

        Raises:
            FlangeyeError: The file does not exist.
        """
        path = self.folder / "result.json"
        try:
            document: dict[str, Any] = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise FlangeyeError(f"{path}: cannot be read: {error}") from None
        return document

    def figures(self, stage: str) -> dict[str, float]:
        """Return the figures of a verify step, by the stage's name."""
        for label, verification in self.result()["verifications"].items():
            if label.endswith(stage):
                figures: dict[str, float] = verification["figures"]
                return figures
        raise FlangeyeError(f"{self.folder}: has no step {stage}")

    def number(self, path: str) -> float:
        """Return a varied parameter as a number, its unit left out."""
        return float(self.row[path].partition(" ")[0])


def read_sessions(batch: Path) -> list[SessionRow]:
    """Return the sessions of a batch in the order of its table.

    Raises:
        FlangeyeError: The folder was not written by ``flangeye batch``.
    """
    table = batch / "sessions.csv"
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise FlangeyeError(
            f"{table}: cannot be read ({error.strerror}); recipes/paper/reproduce.sh shows the "
            "command that makes it"
        ) from None
    return [SessionRow(row, batch / row["session"]) for row in rows]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with the columns of the first; numbers with four significant digits or more."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _text(value) for name, value in row.items()} for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table that :func:`write_csv` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def columns(rows: Iterable[Row], *names: str) -> list[list[float]]:
    """Return named columns of rows as numbers."""
    listed = list(rows)
    return [[float(row[name]) for row in listed] for name in names]


def printed_units(values: Mapping[str, float]) -> dict[str, float]:
    """Return the components of a pose in mm and degrees, from metres and radians."""
    degrees = float(np.degrees(1.0))
    return {axis: values[axis] * (1e3 if len(axis) == 1 else degrees) for axis in AXIS_COLOURS}


def with_units(values: Iterable[Any]) -> dict[str, Any]:
    """Return the components of a pose by name and printed unit, as the tables' columns are."""
    names = (f"{axis} {'mm' if len(axis) == 1 else 'deg'}" for axis in AXIS_COLOURS)
    return dict(zip(names, values, strict=True))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) >= 1e-3 or value == 0 else f"{value:.3g}"
    return "" if value is None else str(value)


AXIS_COLOURS: Mapping[str, str] = {
    "x": "#d97706", "y": "#1d4ed8", "z": "#15803d",
    "roll": "#d97706", "pitch": "#1d4ed8", "yaw": "#15803d",
}  # fmt: skip
"""Components of a pose and their colours."""

TABLE_1: Mapping[str, tuple[float, ...]] = {
    "UR5 PhoXi M": (11.60, 2.81, 5.55, 0.49, -0.89, -0.47),
    "UR10e PhoXi M": (0.60, 1.75, -0.41, 0.10, -0.04, -0.23),
    "Franka PhoXi M": (4.34, -4.06, -0.13, -0.30, -0.34, -0.07),
    "Aubo i5 PhoXi S": (-0.26, -0.27, -0.35, 0.14, 0.04, 0.01),
    "UR10e Azure Kinect": (-11.11, 3.90, 7.15, -0.15, 0.92, 1.56),
}
"""Table 1: errors with all sample points; the Kinect's are those of section 4.2."""

TABLE_2: Mapping[str, tuple[float, ...]] = {
    "4 pairs": (-1.94, -0.90, -0.86, -0.07, 0.04, -0.10),
    "16 pairs": (-0.98, -1.01, -0.83, -0.07, 0.09, -0.11),
}
"""Table 2: Photoneo's software with a sphere."""

GROWTH = 1 / 7
"""Section 3.1: growth of the translational deviation with noise, iterative to all data."""


class PlotStyle(NamedTuple):
    """Label and style of a method in plots."""

    label: str
    colour: str


METHOD_LOOKS: Mapping[str, PlotStyle] = {
    "all-data": PlotStyle("least squares on all poses", "#64748b"),
    "algorithm-1-oracle": PlotStyle("Algorithm 1, its cost knows the truth (emulation)", "#d97706"),
    "algorithm-1-held-out": PlotStyle("Algorithm 1, held-out cost", "#be123c"),
    "robust": PlotStyle("solve.robust", "#1d4ed8"),
}
BOUND = PlotStyle("Cramér-Rao bound", "black")
PRINTED = PlotStyle("the paper", "#15803d")


@dataclass(frozen=True)
class Sheet:
    """A figure and its panels.

    Attributes:
        figure: matplotlib's.
        panels: Row by row.
    """

    figure: Any
    panels: Sequence[Any]

    def save(self, path: Path) -> None:
        """Write a PNG that is the same for the same numbers."""
        self.figure.savefig(path, dpi=100, metadata={"Software": None})


def sheet(rows: int, columns: int, width: float, height: float) -> Sheet:
    """Return an empty figure of ``rows`` times ``columns`` panels, in inches.

    Raises:
        FlangeyeError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise FlangeyeError(
            "the studies' pictures need matplotlib; install with: pip install 'flangeye[studies]'"
        ) from None
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = [figure.add_subplot(rows, columns, i + 1) for i in range(rows * columns)]
    for panel in panels:
        panel.grid(visible=True, color="#e2e8f0", linewidth=0.8)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    return Sheet(figure, panels)


def dress(panel: Any, title: str, x: str, y: str) -> None:
    """Give a panel its title and its axes' names."""
    panel.set_title(title, fontsize=9, loc="left")
    panel.set_xlabel(x, fontsize=8)
    panel.set_ylabel(y, fontsize=8)


def logarithmic(panel: Any, *ticks: float) -> None:
    """Make a panel's height logarithmic, with plain numbers at the ticks."""
    panel.set_yscale("log")
    panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.minorticks_off()


def legend(panel: Any, **options: Any) -> None:
    """Put a small legend into a panel."""
    panel.legend(fontsize=7, frameon=False, **options)
