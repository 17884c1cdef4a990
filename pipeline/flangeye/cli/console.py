"""How commands print, and how errors end them; nothing here takes time to import."""

from __future__ import annotations

import io
import os
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from flangeye.errors import FlangeyeError, NothingMoved, StageError
from flangeye.files.processes import keep_current_folder_out, require_memory
from flangeye.files.words import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import Console

    from flangeye.workflow.log.read import RunLog


def say(text: object, err: bool = False) -> None:
    """Print a line; control characters from foreign text are escaped."""
    print(printable(str(text)), file=sys.stderr if err else sys.stdout, flush=True)


def write(console: Console, text: str, style: str = "") -> None:
    """Print lines, in colour on a terminal; markup in foreign text is not interpreted."""
    console.print(printable(text), style=style, markup=False, highlight=False, soft_wrap=True)


def wrapped(console: Console, text: str, indent: int = 2) -> str:
    """Return a text wrapped to the terminal's width; commands are not broken.

    Line breaks in it become spaces, so that foreign text cannot look like a line of ours.
    """
    return textwrap.fill(
        text.replace("\n", " "), width(console), subsequent_indent=" " * indent,
        break_long_words=False, break_on_hyphens=False, replace_whitespace=False,
    )  # fmt: skip


def width(console: Console) -> int:
    """Return the number of columns of a line of text."""
    # Columns of a line that goes to a file or another program, whose width is unknown
    return console.width if console.is_terminal else 100


def say_notes(notes: Sequence[str]) -> None:
    """Print notes and warnings to standard error."""
    if notes:
        from flangeye.types.arrays import as_line

        for note in notes:
            say(as_line(note), err=True)


@contextmanager
def progress_bar(what: str, steps: int | None = None) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, with the time left if the number of steps is known.

    Yields a function to call after each step. A call after the last step starts a new round.
    """
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    parts = TextColumn("{task.description}"), BarColumn(bar_width=12), TimeElapsedColumn()
    bar = Progress(*parts, TimeLeft(compact=True), console=Console(stderr=True), transient=True)
    task = bar.add_task(what, total=steps)

    def step() -> None:
        if bar.finished:
            bar.reset(task, total=steps)
        bar.advance(task)

    with bar:
        yield step


def report_errors(command: Callable[[], object]) -> None:
    """Run the command line; an expected error is printed as one line and gives an exit code."""
    keep_current_folder_out()
    # Ours are not plugins of pydantic; it would look for one in every installed distribution.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    _open_streams()
    try:
        try:
            # With less the libraries do not load: each fails, or never ends, in a way of its own
            require_memory("numerical libraries need it")
            command()
        except (ImportError, RuntimeError, SystemError) as error:
            require_memory(f"{type(error).__name__}: {error}")  # as a library fails without it
            raise
        finally:
            sys.stdout.flush()
    except NothingMoved as plan:
        say(plan)
    except FlangeyeError as error:
        _fail(error)
    except MemoryError as error:
        _fail(FlangeyeError(f"not enough memory: {str(error) or 'the machine has no more'}"))
    # The reader, such as head, has what it wanted: this is no failure
    except BrokenPipeError:
        _discard_output()
        sys.exit(0)
    except OSError as error:
        deleted = isinstance(error, FileNotFoundError)
        what = error.filename or ("the current folder" if deleted else "standard output")
        if error.filename is None:
            _discard_output()
        _fail(FlangeyeError(f"{what}: cannot be read or written: {error.strerror or error}"))


def _open_streams() -> None:
    """Make sure that both output streams are open and can encode any text."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        # A parent process may have closed it
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _discard_output() -> None:
    """Discard unwritten output, or the interpreter would try to write it again at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(error: FlangeyeError) -> NoReturn:
    if os.environ.get("FLANGEYE_DEBUG"):
        import traceback

        traceback.print_exception(error)
    with suppress(OSError):
        # Of an error, lines, and characters of each: mistakes and names in it come from files
        most, longest = 100, 4000
        lines = printable(str(error)).splitlines()
        for line in lines[:most]:
            more = f" ({len(line) - longest} characters more)" if len(line) > longest else ""
            sys.stderr.write(f"error: {line[:longest]}{more}\n")
        if len(lines) > most:
            sys.stderr.write(f"error: {len(lines) - most} lines more\n")
    sys.exit(error.exit_code)


def require_undamaged(log: RunLog) -> None:
    """Name every damaged part, and end as for bad input."""
    say_notes(log.notes)
    log.require_sound()


@contextmanager
def as_damage(path: Path, what: str) -> Iterator[None]:
    """Report any failure in the context as damage of a log from an unknown source."""
    from flangeye.workflow.log.records import reason_of

    try:
        yield
    except FlangeyeError:
        raise
    except Exception as error:
        raise StageError(f"{path}: {what}: {reason_of(error)}") from error
