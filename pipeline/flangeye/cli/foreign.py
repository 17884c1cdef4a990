"""Messages about logs that are damaged, foreign or still empty."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.cli.console import say
from flangeye.errors import FlangeyeError, StageError

if TYPE_CHECKING:
    from flangeye.log.read import RunLog


def name_damage(log: RunLog) -> None:
    """Name every damaged part, and end as for bad input."""
    for note in log.notes:
        say(f"note: {note}", err=True)
    log.require_sound()


def require_gathered(log: RunLog) -> None:
    """Refuse a log in which nothing was recorded."""
    if not log.gathered:
        log.require_sound()
        raise StageError(f"{log.path}: the run ended early; nothing was gathered yet")


@contextmanager
def of_foreign(path: Path, what: str) -> Iterator[None]:
    """Take any failure for the fault of a log that others may have written."""
    from flangeye.log.records import reason_of

    try:
        yield
    except FlangeyeError:
        raise
    except Exception as error:
        raise StageError(f"{path}: {what}: {reason_of(error)}") from error
