"""A log that is still being written, and what its messages so far say of the run."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from typing_extensions import Buffer

from flangeye.errors import StageError
from flangeye.files.regular import open_regular
from flangeye.files.words import printable
from flangeye.log.read import decode_json
from flangeye.log.records import Channel, LogFile, LogMessage, NotMcapError, reason_of

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["Channel", "LogMessage", "follow"]


class WaitingFile(io.RawIOBase):
    """A file whose end is not its end: reading waits until there is more."""

    def __init__(self, file: BinaryIO, wait: Callable[[], None]) -> None:
        """Take a file; ``wait`` is called while there is nothing new, and may raise to give up."""
        self._file, self._wait = file, wait

    def readinto(self, buffer: Buffer) -> int:
        """Fill as much of the buffer as there is, and at least a byte."""
        while not (new := self._file.read(len(memoryview(buffer)))):
            self._wait()
        memoryview(buffer)[: len(new)] = new
        return len(new)

    def readable(self) -> bool:
        """Say that it can be read."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def follow(
    path: Path, wait: Callable[[], None], note: Callable[[str], None] = lambda what: None
) -> Iterator[LogMessage]:
    """Yield the messages of a log from its beginning until the run ends.

    Args:
        path: The log.
        wait: Called while there is nothing new; whatever it raises ends the reading.
        note: Is told of what is damaged.

    Raises:
        StageError: The file cannot be read, or is no MCAP file.
    """

    def damaged(what: str) -> None:
        note(f"damaged: {what}")

    with WaitingFile(open_regular(path), wait) as file:
        try:
            yield from LogFile(damaged).messages(io.BufferedReader(file))
        except NotMcapError:
            raise StageError(f"{path}: is not an MCAP file") from None


@dataclass
class RunView:
    """The state of a run.

    Attributes:
        name: The run's folder.
        total: Captures that are expected at most, when known.
        captures: Captures that arrived.
        fitted: Those that became an observation.
        arm: Where the arm was last: position [m], and when [s].
        progress: What the solver last knew of its error.
        next: Where the arm goes, and why there: the capture's id, and what it promises.
        events: The latest lines for people.
        newest_ns: When the last message was logged.
        ended: Whether the run came to its end.
    """

    name: str
    total: int | None = None
    captures: int = 0
    fitted: int = 0
    arm: tuple[list[float], str] | None = None
    progress: dict[str, Any] | None = None
    next: tuple[str, str] | None = None
    events: list[str] = field(default_factory=list)
    newest_ns: int = 0
    ended: bool = False

    def take(self, message: LogMessage) -> None:
        """Take in one message."""
        self.newest_ns = message.time_ns
        before = vars(self).copy()
        try:
            self._take(message)
            self.rows()  # what cannot be shown is not taken in
        except Exception as error:  # what a foreign log holds can be wrong in any way
            vars(self).update(before)
            self.note(f"message {message.number} on {message.channel.topic}: {reason_of(error)}")

    def note(self, what: str) -> None:
        """Show a line of our own among the events."""
        self._say(what)

    def _take(self, message: LogMessage) -> None:
        topic, schema = message.channel.topic, message.channel.schema
        if message.channel.encoding != "json":
            return
        content = decode_json(message.data)
        if topic == "/source":
            self.total = content["total"]
            self._say(*content["notes"])
        elif topic == "/capture":
            self.captures += 1
            self._place(content["poses"]["flange"], "at the last capture")
        elif topic == "/rejection":
            self._say(f"set aside {content['id']}: {content['stage']}: {content['reason']}")
        elif topic.startswith("/step/"):
            self._step(topic.removeprefix("/step/"), schema, content)
        elif topic.startswith("/note/"):
            self._note(topic.rpartition("/")[2], schema, content["value"])

    def _step(self, step: str, schema: str, content: dict[str, Any]) -> None:
        if content["capture"] is None:
            reason = f": {content['value']['reason']}" if schema.endswith("Verification") else ""
            self._say(f"{step} done{reason}")
        elif step.partition(".")[2].startswith("fit"):
            self.fitted += 1
            self._say(f"fitted {content['capture']}")

    def _note(self, name: str, schema: str, value: dict[str, Any]) -> None:
        if name == "next":
            self.next = value["id"], value["why"]
        elif schema == "flangeye.RobotState":
            self._place(value["base_T_flange"], value["mode"])
        elif schema == "flangeye.Progress":
            self.progress = value

    def _place(self, base_T_flange: dict[str, Any], when: str) -> None:
        self.arm = [row[3] for row in base_T_flange["matrix"][:3]], when

    def _say(self, *lines: str) -> None:
        # Latest events that are shown
        self.events = [*self.events, *map(str, lines)][-6:]

    def rendered(self) -> RenderableType:
        """Return the view for the terminal."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for label, text in self.rows():
            table.add_row(Text(label, style="bold"), Text(printable(text)))
        return Group(table, *(Text(printable(f"  {line}"), style="dim") for line in self.events))

    def rows(self) -> list[tuple[str, str]]:
        """Return labels and texts."""
        of = f" of at most {self.total}" if self.total else ""
        return [
            ("run", f"{self.name}{', ended' if self.ended else self._silence()}"),
            ("captures", f"{self.captures}{of}, {self.fitted} fitted"),
            ("arm", self._arm()),
            ("error so far", self._error()),
            *([("next pose", ": ".join(filter(None, self.next)))] if self.next else []),
        ]

    def _arm(self) -> str:
        if self.arm is None:
            return "not known yet"
        place, when = self.arm
        return ", ".join(f"{1e3 * x:.1f}" for x in place) + f" mm in the base, {when}"

    def _error(self) -> str:
        if self.progress is None:
            return "not known yet"
        error, required = (self.progress[key] for key in ("error", "required"))
        if not np.isfinite(error or np.inf):
            return f"not observable yet after {self.progress['poses']} poses"
        return (
            f"95 % below {error * 1e3:.3f} mm after {self.progress['poses']} poses, "
            f"{required * 1e3:.3f} mm required"
        )

    def _silence(self) -> str:
        silent = time.time() - self.newest_ns * 1e-9
        return f", nothing new for {silent:.0f} s" if self.newest_ns and silent > 5 else ""
