"""Another process, asked and answered through its standard input and output, never for long."""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import threading
from collections.abc import Sequence


class PipeEndedError(Exception):
    """The other process has ended; how, and its last words."""


class Pipe:
    """A process, read in the background so that waiting for it can end."""

    def __init__(self, command: Sequence[str]) -> None:
        """Start it.

        Raises:
            OSError: There is no such program.
        """
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._chunks: queue.Queue[bytes] = queue.Queue()
        self._rest, self._words = b"", b""
        self._readers = [
            threading.Thread(target=target, daemon=True) for target in (self._drain, self._listen)
        ]
        for reader in self._readers:
            reader.start()

    def write(self, data: bytes) -> None:
        """Send something.

        Raises:
            OSError: The process has ended.
        """
        assert self._process.stdin  # noqa: S101
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def line(self, patience: float) -> bytes:
        """Return the next line, without its end.

        Raises:
            TimeoutError: It did not come within ``patience`` [s].
            PipeEndedError: It never will.
        """
        while b"\n" not in self._rest:
            self._more(patience)
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def read(self, size: int, patience: float) -> bytes:
        """Return the next ``size`` bytes; raises as :meth:`line`."""
        parts, missing = [self._rest[:size]], size - len(self._rest)
        self._rest = self._rest[size:]
        while missing > 0:
            self._more(patience)
            parts.append(self._rest[:missing])
            self._rest, missing = self._rest[missing:], missing - len(self._rest)
        return b"".join(parts)

    def close(self) -> None:
        """End the process; safe to call twice."""
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream:
                with contextlib.suppress(OSError):
                    stream.close()

    def _more(self, patience: float) -> None:
        try:
            chunk = self._chunks.get(timeout=patience)
        except queue.Empty:
            raise TimeoutError from None
        if not chunk:
            self._chunks.put(b"")
            raise PipeEndedError(self._ending())
        self._rest += chunk

    def _ending(self) -> str:
        self._readers[1].join()
        words = self._words.decode(errors="replace").strip().splitlines()
        return f"exit {self._process.wait()}{f': {words[-1]}' if words else ''}"

    def _drain(self) -> None:
        assert self._process.stdout  # noqa: S101
        while chunk := os.read(self._process.stdout.fileno(), 1 << 20):
            self._chunks.put(chunk)
        self._chunks.put(b"")

    def _listen(self) -> None:
        assert self._process.stderr  # noqa: S101
        while chunk := os.read(self._process.stderr.fileno(), 1 << 16):
            self._words = (self._words + chunk)[-4096:]
