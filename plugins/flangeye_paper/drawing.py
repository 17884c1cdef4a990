"""How the studies' pictures look. matplotlib comes with the extra ``studies``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from flangeye import FlangeyeError


class Look(NamedTuple):
    """How a method is called and drawn."""

    label: str
    colour: str


METHODS: Mapping[str, Look] = {
    "all-data": Look("least squares on all poses", "#64748b"),
    "algorithm-1-oracle": Look("Algorithm 1, its cost knows the truth (emulation)", "#d97706"),
    "algorithm-1-held-out": Look("Algorithm 1, held-out cost", "#be123c"),
    "robust": Look("solve.robust", "#1d4ed8"),
}
BOUND = Look("Cramér-Rao bound", "black")
PRINTED = Look("the paper", "#15803d")

AXIS_COLOURS = {
    "x": "#d97706", "y": "#1d4ed8", "z": "#15803d",
    "roll": "#d97706", "pitch": "#1d4ed8", "yaw": "#15803d",
}  # fmt: skip


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
