"""What every page has: the way to the others, the command to copy, a clear line for a mistake."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nicegui import ui

PAGES = {"/": "Cell", "/plan": "Plan", "/run": "Run", "/verdict": "Verdict", "/archive": "Archive"}


@contextmanager
def page(title: str) -> Iterator[None]:
    """Lay out one page around what is made inside."""
    ui.dark_mode(None)
    ui.colors(primary="#1f5fa8", positive="#1a7f45", negative="#c02626", warning="#a86200")
    ui.page_title(f"{title} · flangeye")
    with ui.header().classes("items-center q-py-xs"), ui.element("nav").classes("row gap-4"):
        for path, name in PAGES.items():
            link = ui.link(name, path).classes("text-white text-subtitle1")
            if name == title:
                link.classes("text-bold").props('aria-current="page"')
    with ui.column().classes("w-full max-w-screen-xl mx-auto gap-3 q-pa-sm").props('role="main"'):
        ui.label(title).classes("text-h5").props('role="heading" aria-level="1"')
        yield


def command_line(text: str) -> ui.code:
    """Show a command that does the same, with a button that copies it."""
    with ui.row().classes("items-center gap-2 no-wrap w-full"):
        return ui.code(text, language="sh").classes("grow overflow-x-auto")


def warning(text: str) -> ui.label:
    """Show what a person should know or do, in one line."""
    return ui.label(f"⚠ {text}").classes("text-warning")


def mistake(text: str) -> ui.label:
    """Show what is wrong, in one line."""
    return ui.label(text).classes("text-negative").props('role="alert"')


async def confirmed(question: str, yes: str) -> bool:
    """Ask, and return whether the person agreed."""
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():
            ui.button(yes, on_click=lambda: dialog.submit(True), color="negative")
            ui.button("No", on_click=lambda: dialog.submit(False)).props("autofocus outline")
    return bool(await dialog)
