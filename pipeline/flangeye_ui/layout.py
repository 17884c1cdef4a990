"""Layout of every page: the five steps, their status, and the primary button."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import ui

from flangeye.workflow.report.look import LIGHT, LOGO, css
from flangeye.workflow.result import SIMULATED

if TYPE_CHECKING:
    from flangeye_ui.project import Project

WAY = {
    "Cell": ("/", "Choose the arm, the scanner and its mounting."),
    "Poses": ("/poses", "Check that the arm reaches every pose and the scanner sees it."),
    "Scan": ("/scan", "Let the scanner look at the flange from every pose."),
    "Result": ("/result", "See whether the calibration can be trusted, and what would mend it."),
    "Use": ("/use", "Take the calibration to your system."),
}
"""The way from an empty folder to an exported file: address, and what to do there."""
OTHER_PAGES = {
    "Watch": ("/watch", "See whether stored calibrations still hold."),
    "Archive": ("/archive", "Compare the sessions of this folder and look into their scans."),
}


class ActionBar:
    """The bar below a page: the status line, and the primary button.

    Attributes:
        simulated: Line at the top that marks a simulated cell.
    """

    def __init__(self, simulated: ui.label) -> None:
        self.simulated = simulated
        with (
            ui.footer().classes("bar") as self._footer,
            ui.row().classes("items-center gap-3 no-wrap w-full"),
        ):
            self._said = ui.label().classes("grow").props('role="status"')
            self._buttons = ui.row().classes("items-center gap-2 justify-end")

        self._footer.set_visibility(False)

    def say(self, text: str) -> None:
        """Show a status line."""
        self._footer.set_visibility(True)
        self._said.text = text

    def offer(self, label: str, go: Callable[[], Any], *, second: bool = False) -> ui.button:
        """Return a button in the bar; of the primary ones a page shows one at a time."""
        self._footer.set_visibility(True)
        with self._buttons:
            button = ui.button(label, on_click=go).props("no-caps")
        weigh(button, second)
        return button.classes("act")

    def lead(self, title: str, label: str) -> ui.button:
        """Return a button that leads to a step."""
        return self.offer(label, lambda: ui.navigate.to(WAY[title][0]))


def weigh(button: ui.button, second: bool) -> None:
    """Style a button as the primary one, or as a secondary one."""
    plain, filled = "outline", "unelevated"
    button.props(plain if second else filled, remove=filled if second else plain)


@contextmanager
def page(project: Project, title: str) -> Iterator[ActionBar]:
    """Lay out a page around its content; yield the bar with its primary button."""
    ui.add_css(css() + (Path(__file__).parent / "page.css").read_text(encoding="utf-8"))
    ui.add_head_html("<script>document.documentElement.lang = 'en'</script>")
    ui.colors(
        primary=LIGHT["link"], positive=LIGHT["verified"], negative=LIGHT["refused"],
        warning=LIGHT["unverified"],
    )  # fmt: skip
    ui.page_title(f"{title} · flangeye")
    ui.on_exception(lambda error: ui.notify(str(error), type="negative"))
    bar = ActionBar(_header(project, title))
    with ui.column().classes("w-full max-w-screen-xl mx-auto gap-3 page"):
        with ui.column().classes("gap-0"):
            ui.label(title).classes("title").props('role="heading" aria-level="1"')
            ui.label({**WAY, **OTHER_PAGES}[title][1]).classes("what")
        yield bar


def _header(project: Project, title: str) -> ui.label:
    """Show the steps; return the line that marks a simulated cell."""
    done = project.done()
    with ui.header().classes("head"):
        with ui.element("nav").props('aria-label="Steps"').classes("ways"):
            ui.html(f"{LOGO}<span>flangeye</span>", sanitize=False).classes("brand")
            with ui.element("ol").classes("steps"):
                for number, name in enumerate(WAY, 1):
                    with ui.element("li"):
                        _way(name, name == title, f"{number}", name in done)
            with ui.element("ul").classes("beside"):
                for name in OTHER_PAGES:
                    with ui.element("li"):
                        _way(name, name == title)
        simulated = ui.label(SIMULATED).classes("simulated").props('role="note"')
        simulated.set_visibility(project.simulated)
    return simulated


def _way(name: str, here: bool, number: str = "", done: bool = False) -> None:
    link = ui.link(target={**WAY, **OTHER_PAGES}[name][0]).classes("done" if done else "")
    with link:
        if number:
            ui.label("✓" if done else number).classes("mark").props('aria-hidden="true"')
        ui.label(name)
    if done:
        link.props('aria-description="done"')
    if here:
        link.props('aria-current="page"')


def command_line(text: str) -> ui.label:
    """Show a command that does the same, with a button that copies it."""
    with ui.row().classes("items-center gap-1 no-wrap w-full command"):
        shown = code(text)
        copy = ui.button(icon="content_copy", on_click=lambda: ui.clipboard.write(shown.text))
        copy.props('flat dense size=sm aria-label="Copy the command"')
    return shown


def warning(text: str) -> ui.label:
    """Show a warning in one line."""
    return ui.label(f"⚠ {text}").classes("text-warning")


def mistake(text: str) -> ui.label:
    """Show a mistake in one line."""
    return ui.label(text).classes("text-negative").props('role="alert"')


async def code_from_terminal() -> str:
    """Ask for the code shown in the terminal; return it, or an empty text."""
    with ui.dialog() as dialog, ui.card():
        ui.label("The arm will move. Is its workspace clear of people?").classes("title")
        ui.label("The terminal of 'flangeye ui' shows a code for this move.")
        box = ui.input("Code from the terminal").props("autofocus inputmode=numeric outlined")
        box.on("keydown.enter", lambda: dialog.submit(box.value)).classes("w-full")
        with ui.row():
            move = ui.button("Move the arm", on_click=lambda: dialog.submit(box.value))
            move.props("no-caps unelevated color=negative")
            ui.button("No", on_click=lambda: dialog.submit("")).props("no-caps outline")
    return str(await dialog or "")


def code(text: str) -> ui.label:
    """Show text literally, without interpreting markup."""
    return ui.label(text).classes("code").props('tabindex=0 role="group" aria-label="Text"')


def svg(text: str) -> ui.html:
    """Show an SVG drawing made by this program, with its text already escaped."""
    return ui.html(text, sanitize=False)
