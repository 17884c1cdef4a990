"""Processes that this one starts, and those it asks through their standard input and output."""

import contextlib
import mmap
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import IO, cast


def python_command(*words: str) -> list[str]:
    """Return a command of this Python that does not import from the current folder."""
    return [sys.executable, "-P", *words]


def keep_current_folder_out() -> None:
    """Keep child processes from importing modules of their current folder."""
    os.environ["PYTHONSAFEPATH"] = "1"


def busy() -> str:
    """Return advice if this computer is overloaded, else an empty text."""
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load <= cores:
        return ""
    return (
        f"; this computer is busy (load {load:.1f} on {cores} cores): end other programs, "
        "then start again"
    )


def require_memory(what: str, megabytes: int = 256) -> None:
    """Require that the process can allocate more memory; the test allocation is freed at once.

    Raises:
        MemoryError: The memory is not available; the message begins with ``what``.
    """
    try:
        mmap.mmap(-1, megabytes << 20).close()
    except OSError as error:
        raise MemoryError(f"{what}; fewer than {megabytes} MB are left") from error


class PipeEndedError(Exception):
    """The child process has ended; with its exit code and last output."""


class Pipe:
    """A child process read by a background thread, so that a wait can time out."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        """Start the command, by default with this process's environment.

        Raises:
            OSError: There is no such program.
        """
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C is for us, who then close it
        )
        self._in, self._out, self._err = cast(
            "tuple[IO[bytes], IO[bytes], IO[bytes]]",
            (self._process.stdin, self._process.stdout, self._process.stderr),
        )
        self._chunks: queue.Queue[bytes] = queue.Queue()
        self._rest, self._words = b"", b""
        self._readers = [
            threading.Thread(target=target, daemon=True) for target in (self._drain, self._listen)
        ]
        for reader in self._readers:
            reader.start()

    def write(self, data: bytes) -> None:
        """Send a line or bytes.

        Raises:
            OSError: The process has ended.
        """
        self._in.write(data)
        self._in.flush()

    def line(self, patience: float | None) -> bytes:
        """Return the next line, without its end.

        Raises:
            TimeoutError: No line came within ``patience`` [s]; None waits for ever.
            PipeEndedError: The process has ended.
        """
        while b"\n" not in self._rest:
            self._more(patience)
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def read(self, size: int, patience: float | None) -> bytes:
        """Return the next ``size`` bytes; raises as :meth:`line`."""
        parts, missing = [self._rest[:size]], size - len(self._rest)
        self._rest = self._rest[size:]
        while missing > 0:
            self._more(patience)
            parts.append(self._rest[:missing])
            self._rest, missing = self._rest[missing:], missing - len(self._rest)
        return b"".join(parts)

    def close(self, patience: float = 0.0) -> None:
        """End the process; safe to call twice.

        Args:
            patience: Longest wait for the process to end after its input is closed [s].
        """
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            self._in.close()
            self._process.wait(patience)
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join()
        for stream in (self._in, self._out, self._err):
            with contextlib.suppress(OSError):  # what was not sent yet has nowhere to go
                stream.close()

    def _more(self, patience: float | None) -> None:
        try:
            chunk = self._chunks.get(timeout=patience)
        except queue.Empty:
            raise TimeoutError from None
        # An empty chunk marks the end of the output; it is put back for later calls
        if not chunk:
            self._chunks.put(b"")
            raise PipeEndedError(self._ending())
        self._rest += chunk

    def _ending(self) -> str:
        self._readers[1].join()
        words = self._words.decode(errors="replace").strip().splitlines()
        return f"exit {self._process.wait()}{f': {words[-1]}' if words else ''}"

    def _drain(self) -> None:
        while chunk := os.read(self._out.fileno(), 1 << 20):
            self._chunks.put(chunk)
        self._chunks.put(b"")

    def _listen(self) -> None:
        while chunk := os.read(self._err.fileno(), 1 << 16):
            self._words = (self._words + chunk)[-4096:]
