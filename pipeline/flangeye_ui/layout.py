"""What every page has: the way to the others, the command to copy, a clear line for a mistake."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nicegui import ui

from flangeye.report.look import LIGHT

PAGES = {"/": "Cell", "/plan": "Plan", "/run": "Run", "/verdict": "Verdict", "/archive": "Archive"}


@contextmanager
def page(title: str) -> Iterator[None]:
    """Lay out one page around what is made inside."""
    ui.dark_mode(None)
    ui.colors(
        primary=LIGHT["link"], positive=LIGHT["verified"], negative=LIGHT["refused"],
        warning=LIGHT["unverified"],
    )  # fmt: skip
    ui.page_title(f"{title} · flangeye")
    with ui.header().classes("items-center q-py-xs"), ui.element("nav").classes("row gap-4"):
        for path, name in PAGES.items():
            link = ui.link(name, path).classes("text-white text-subtitle1")
            if name == title:
                link.classes("text-bold").props('aria-current="page"')
    with ui.column().classes("w-full max-w-screen-xl mx-auto gap-3 q-pa-sm").props('role="main"'):
        ui.label(title).classes("text-h5").props('role="heading" aria-level="1"')
        yield


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
        ui.label("The terminal of 'flangeye ui' shows a code for this move.").classes(
            "text-caption"
        )
        box = ui.input("Code from the terminal").props("autofocus inputmode=numeric")
        box.on("keydown.enter", lambda: dialog.submit(box.value))
        with ui.row():
            ui.button("Move the arm", on_click=lambda: dialog.submit(box.value), color="negative")
            ui.button("No", on_click=lambda: dialog.submit("")).props("outline")
    return str(await dialog or "")


def code(text: str) -> ui.label:
    """Show text as it is written: never as markup, whatever is in it."""
    return ui.label(text).classes("font-mono whitespace-pre w-full overflow-x-auto text-caption")
