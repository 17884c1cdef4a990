"""What a person asks of ``flangeye batch``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flangeye.errors import FlangeyeError

SEED = "seed"


class BatchError(FlangeyeError):
    """The batch cannot start; nothing has run."""


@dataclass(frozen=True)
class Tls:
    """Files for an encrypted connection in which both sides are known.

    Attributes:
        ca: Certificate of the authority that signed the others, PEM.
        cert: Our certificate, PEM.
        key: Its private key, PEM: who has it may run code on every worker.
    """

    ca: Path
    cert: Path
    key: Path


@dataclass(frozen=True)
class Request:
    """What the command line asks for.

    Attributes:
        recipe: File, or name of a bundled recipe.
        archives: Recordings to run on, paths or URLs; none for recipes that simulate.
        overrides: ``PATH=VALUE``, the same in every session.
        grid: ``PATH=a,b,c``: every combination is run.
        repeat: How many seeds, counted up from the recipe's; None for the recipe's alone.
        vary: What ``repeat`` counts up; only ``seed`` can be.
        workers: Worker processes on this machine; None for one per core.
        scheduler: Address of a running dask scheduler, instead of workers here.
        tls: What proves to that scheduler who we are, and to us that it is the one.
        out: Folder of the batch, by path or URL; None for ``batches/<recipe>``.
        report: Make each session's ``report.html``.
    """

    recipe: str
    archives: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    grid: tuple[str, ...] = ()
    repeat: int | None = None
    vary: str = SEED
    workers: int | None = None
    scheduler: str | None = None
    tls: Tls | None = None
    out: str | None = None
    report: bool = True
