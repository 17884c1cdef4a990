"""Common style of report, certificate, page and documentation: colours, fonts and logo.

Text colours have a contrast of at least 4.5 on their background (WCAG 2.1, AA), in both themes.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment

LIGHT = {
    "paper": "#ffffff", "panel": "#f6f7f9", "ink": "#1c2230", "muted": "#5b6474", "rule": "#dfe3e9",
    "link": "#1f5fa8", "bar": "#3a7ebf", "axis": "#7b8494", "grid": "#dfe3e9",
    "verified": "#1a7f45", "unverified": "#8a5000", "refused": "#c02626", "incomplete": "#5b6474",
    "arm": "#b9c1cd",
}  # fmt: skip
DARK = {
    "paper": "#14171d", "panel": "#1c2028", "ink": "#e6e9ef", "muted": "#9aa4b4", "rule": "#2f3641",
    "link": "#7db4ee", "bar": "#4f93d2", "axis": "#7b8494", "grid": "#2f3641",
    "verified": "#4cc07f", "unverified": "#e3a33c", "refused": "#ff7b72", "incomplete": "#9aa4b4",
    "arm": "#5b6474",
}  # fmt: skip
SERIES = {
    "used": "#3a7ebf", "unused": "#d98a00", "held_out": "#8a8f98", "truth": "#c0559a",
    "circle": "#d5451b", "x": "#d5451b", "y": "#2a9d5c", "z": "#3a7ebf",
}  # fmt: skip
"""Colours of a chart's series, distinguishable for colour-blind readers (Okabe and Ito 2008) and
readable on both themes; x, y, z are red, green, blue as in every robot tool."""

SANS = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'
MONO = 'ui-monospace, "Cascadia Mono", "DejaVu Sans Mono", Menlo, Consolas, monospace'

LOGO = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32" role="img" aria-label="flangeye">'
    '<g fill="none" stroke="currentColor"><circle cx="16" cy="16" r="13.5" stroke-width="3"/>'
    '<circle cx="16" cy="16" r="5" stroke-width="2.5"/></g><g fill="currentColor">'
    '<circle cx="16" cy="7" r="1.7"/><circle cx="25" cy="16" r="1.7"/>'
    '<circle cx="16" cy="25" r="1.7"/><circle cx="7" cy="16" r="1.7"/>'
    '<circle cx="16" cy="16" r="1.8"/></g></svg>'
)
"""A flange plate with its bolt circle, which is also an eye. Drawn in the colour of the text."""


def css() -> str:
    """Return the CSS variables of both themes and of the type, for a page's ``<style>``."""
    return (
        f":root {{ color-scheme: light dark; --sans: {SANS}; --mono: {MONO}; "
        f"{_variables(LIGHT)} }}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {_variables(DARK)} }} }}\n"
    )


def _variables(colours: dict[str, str]) -> str:
    return " ".join(f"--{name}: {value};" for name, value in colours.items())


@cache
def templates(*folders: Path) -> Environment:
    """Return templates that escape everything, for ids, reasons and titles come from anywhere.

    Kept while the process runs: parsing them takes longer than filling in a page of a batch.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(folders),
        autoescape=True,
        optimized=False,  # most processes render one page
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    environment.globals["look"] = css
    return environment
