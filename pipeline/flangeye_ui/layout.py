"""What every page has: the five steps with what is done, what to do now, and the way on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from nicegui import ui

from flangeye.report.look import LIGHT

if TYPE_CHECKING:
    from flangeye_ui.project import Project

STEPS = {
    "Cell": ("/", "Choose the arm, the scanner and its place. The recipe grows from it."),
    "Poses": ("/poses", "Check that the arm reaches every pose and that the scanner sees it."),
    "Scan": ("/scan", "Take the scans. Stop at any time with the button or the space bar."),
    "Result": ("/result", "See whether the calibration can be trusted, and what would mend it."),
    "Use": ("/use", "Take the calibration to your system: a file, a copy or a certificate."),
}
"""The way from an empty folder to an exported file: address, and what to do there."""
BESIDE = {
    "Archive": ("/archive", "Compare the sessions of this folder and look into their scans."),
}
SIMULATED = "Simulated: no real arm or scanner. Figures are those of the simulation."
STYLE = """
.steps {display: flex; flex-wrap: wrap; gap: .25rem 1.1rem; align-items: center}
.steps a {color: inherit; text-decoration: none; padding: .35rem .15rem}
.steps a[aria-current] {font-weight: 700; border-bottom: 3px solid currentColor}
.brand {font-weight: 700; letter-spacing: -.01em; margin-right: .75rem}
.number {font-variant-numeric: tabular-nums; font-size: 2.4rem; line-height: 1.1; font-weight: 650}
.banner {border-left: .4rem solid #a86200; padding: .4rem .75rem; width: 100%}
body:not(.body--dark) .text-warning {color: #8a5000 !important}
body.body--dark .text-positive {color: #4cc07f !important}
body.body--dark .text-negative {color: #ff7b72 !important}
body.body--dark .text-warning {color: #e3a33c !important}
body.body--dark .nicegui-link {color: #7db4ee}
"""
"""The report's colours where Quasar's lack contrast."""


@contextmanager
def page(project: Project, title: str) -> Iterator[None]:
    """Lay out one page around what is made inside; the next step is offered when one is done."""
    ui.add_css(STYLE)
    ui.colors(
        primary=LIGHT["link"], positive=LIGHT["verified"], negative=LIGHT["refused"],
        warning=LIGHT["unverified"],
    )  # fmt: skip
    ui.page_title(f"{title} · flangeye")
    done = project.done()
    with ui.header().classes("q-py-xs"), ui.element("nav").classes("steps") as nav:
        nav.props('aria-label="Steps"')
        ui.label("flangeye").classes("brand")
        for number, name in enumerate(STEPS, 1):
            _step(name, f"{number}", name == title, name in done)
        for name in BESIDE:
            _step(name, "", name == title, False)
    with ui.column().classes("w-full max-w-screen-xl mx-auto gap-3 q-pa-sm").props('role="main"'):
        ui.label(title).classes("text-h5").props('role="heading" aria-level="1"')
        ui.label({**STEPS, **BESIDE}[title][1]).classes("text-body1")
        if project.simulated:
            ui.label(SIMULATED).classes("banner").props('role="note"')
        yield


def _step(name: str, number: str, here: bool, done: bool) -> None:
    with ui.element("div").classes("row items-center no-wrap gap-1"):
        if number:
            ui.label("✓" if done else number).props(f'aria-hidden="{str(not done).lower()}"')
        link = ui.link(name, {**STEPS, **BESIDE}[name][0])
        if here:
            link.props('aria-current="page"')


def next_step(title: str, label: str) -> ui.button:
    """Offer the step that follows, as the page's one primary button."""
    path = STEPS[title][0]
    return ui.button(label, on_click=lambda: ui.navigate.to(path)).props("no-caps unelevated")


def command_line(text: str) -> ui.label:
    """Show a command that does the same, with a button that copies it."""
    with ui.row().classes("items-center gap-2 no-wrap w-full"):
        shown = code(text)
        copy = ui.button(icon="content_copy", on_click=lambda: ui.clipboard.write(shown.text))
        copy.props('flat dense size=sm aria-label="Copy the command"')
    return shown


def warning(text: str) -> ui.label:
    """Show what a person should know or do, in one line."""
    return ui.label(f"⚠ {text}").classes("text-warning")


def mistake(text: str) -> ui.label:
    """Show what is wrong, in one line."""
    return ui.label(text).classes("text-negative").props('role="alert"')


async def code_from_terminal() -> str:
    """Ask for the code that the terminal shows; return it, empty where nobody gave one."""
    with ui.dialog() as dialog, ui.card():
        ui.label("The arm will move. Is its workspace clear of people?")
        ui.label("The terminal of 'flangeye ui' shows a code for this move.")
        box = ui.input("Code from the terminal").props("autofocus inputmode=numeric")
        box.on("keydown.enter", lambda: dialog.submit(box.value))
        with ui.row():
            ui.button("Move the arm", on_click=lambda: dialog.submit(box.value), color="negative")
            ui.button("No", on_click=lambda: dialog.submit("")).props("outline")
    return str(await dialog or "")


def code(text: str) -> ui.label:
    """Show text as it is written: never as markup, whatever is in it."""
    shown = ui.label(text).classes("font-mono whitespace-pre w-full overflow-x-auto text-caption")
    return shown.props("tabindex=0")
