"""``flangeye regress``: run known recordings as a batch and compare with expectations."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from flangeye.errors import FlangeyeError, RecipeError
from flangeye.files.paths import at_home, storage_at
from flangeye.models.model import Model, read_model
from flangeye.units import Length
from flangeye.workflow.batch import run_sessions
from flangeye.workflow.batch.dataset import Dataset, Ledger, columns_of
from flangeye.workflow.batch.outcome import Request, SessionOutcome
from flangeye.workflow.batch.plan import BatchSession, plan, software_of
from flangeye.workflow.doctor.opening import examined

if TYPE_CHECKING:
    from rich.console import Console

    from flangeye.plugin.registry import Registry


@dataclass(frozen=True)
class ManifestComparison:
    """Comparison of a run's results with a manifest of expected ones.

    Attributes:
        name: File name of the manifest, without its suffix.
        verdict: Whether the run agrees, differs, or was skipped.
        told: Text: the differences, the results, or the reason for skipping.
    """

    name: str
    verdict: Literal["as expected", "DIFFERS", "skipped"]
    told: str

    def line(self) -> str:
        """Return the comparison as printable text."""
        return f"{self.verdict:11}  {self.name}: {self.told}"


def compare(
    manifests: Mapping[Path, Manifest],
    out: Path,
    workers: int | None,
    registry: Registry,
    console: Console,
) -> list[ManifestComparison]:
    """Return each manifest's comparison of results with expectations, in their order.

    Args:
        manifests: Manifests by their files.
        out: Folder of the batch; what finished there with the same software is not run again.
        workers: Processes; None for one a core.
        registry: The plugins.
        console: Console for the progress.

    Raises:
        FlangeyeError: The batch cannot start, another one uses its folder, or a manifest's recipe
            is wrong.
    """
    there = {file: m for file, m in manifests.items() if _recording(file, m).exists()}
    sessions = {file: _session(file, m, registry) for file, m in there.items()}
    outcomes = _run(
        list(sessions.values()), Request("", workers=workers, out=str(out)), registry, console
    )
    return [
        _compared(
            file.stem, m.expected, outcomes[sessions[file].id], out / sessions[file].id, registry
        )
        if file in there
        else ManifestComparison(
            file.stem, "skipped", f"{_recording(file, m)} is not there; {m.source}"
        )
        for file, m in manifests.items()
    ]


def _recording(file: Path, manifest: Manifest) -> Path:
    try:
        return Path(os.path.normpath(file.parent / at_home(manifest.recording)))
    except ValueError as error:
        raise RecipeError(f"{file}: recording: {error}, not '{manifest.recording}'") from None


def _session(file: Path, manifest: Manifest, registry: Registry) -> BatchSession:
    near = file.parent / manifest.recipe
    reader = [] if manifest.reader is None else [f"steps.0.reader={json.dumps(manifest.reader)}"]
    request = Request(
        str(near) if near.is_file() else manifest.recipe,
        (str(_recording(file, manifest)),),
        (*reader, *manifest.overrides),
    )
    try:
        (session,) = plan(request, registry, software_of(registry))
    except FlangeyeError as error:
        raise RecipeError(f"{file}: {error}") from None
    return session


def _run(
    sessions: Sequence[BatchSession], request: Request, registry: Registry, console: Console
) -> Mapping[str, SessionOutcome]:
    if not sessions:
        return {}
    once = list({session.id: session for session in sessions}.values())
    out = str(request.out)
    run_sessions(request, out, once, {}, software_of(registry), console)
    rows = Dataset(storage_at(out), columns_of({})).rows(Ledger(once))
    fields = SessionOutcome.__dataclass_fields__
    found = {row["session"]: SessionOutcome(**{name: row[name] for name in fields}) for row in rows}
    lost = [session.id for session in once if session.id not in found]
    if lost:
        raise FlangeyeError(
            f"{out}: holds no outcome of {lost[0]}; another batch writes to this folder: wait for "
            "its end, or give --out"
        )
    return found


def _compared(
    name: str, expected: Expected, outcome: SessionOutcome, run: Path, registry: Registry
) -> ManifestComparison:
    told = [outcome.status if outcome.origin is None else f"{outcome.status} ({outcome.origin})"]
    differs: list[str] = []
    if outcome.status != expected.status:
        reason = f" ({outcome.reason})" if outcome.reason else ""
        differs.append(f"{outcome.status}{reason}, expected {expected.status}")
    if expected.closure is not None and expected.tolerance is not None:
        (told if _near(outcome, expected) else differs).append(_closure(outcome, expected))
    if expected.findings is not None:
        found = _findings(run, registry)
        same = sorted(found) == sorted(expected.findings)
        line = f"findings {', '.join(found) or 'none'}"
        (told if same else differs).append(
            line if same else f"{line}, expected {', '.join(expected.findings) or 'none'}"
        )
    if differs:
        return ManifestComparison(name, "DIFFERS", "; ".join(differs))
    return ManifestComparison(name, "as expected", "; ".join(told))


def _near(outcome: SessionOutcome, expected: Expected) -> bool:
    found, closure, tolerance = outcome.holdout_median_m, expected.closure, expected.tolerance
    if found is None or closure is None or tolerance is None:
        return False
    return abs(found - closure) <= tolerance


def _closure(outcome: SessionOutcome, expected: Expected) -> str:
    found = outcome.holdout_median_m
    mm = "none" if found is None else f"{found * 1e3:.3f} mm"
    return (
        f"closure {mm}, expected {(expected.closure or 0) * 1e3:.3f} +- "
        f"{(expected.tolerance or 0) * 1e3:.3f} mm"
    )


def _findings(run: Path, registry: Registry) -> list[str]:
    try:
        return [f.name for f in examined(run, registry).findings]
    except FlangeyeError as error:
        return [f"not examined: {error}"]


class Expected(Model):
    """The accepted result of a recording, which later runs are compared with."""

    status: Literal["verified", "unverified", "refused"] = "verified"
    closure: Length | None = None
    """Median held-out error."""
    tolerance: Length | None = None
    """Largest accepted difference of the held-out error from ``closure``."""
    findings: tuple[str, ...] | None = None
    """Names of what flangeye doctor finds, in any order. Default: not compared."""


class Manifest(Model):
    """A recorded session, how to read it, and its expected result."""

    title: str
    """One line shown in reports."""
    recording: str
    """The folder or file, from the manifest's folder, or from ~; skipped if absent."""
    recipe: str
    """A bundled recipe, or a file, from the manifest's folder."""
    reader: Any = None
    """The reader and its conventions, as a recipe has them; the recipe's own if not given."""
    overrides: tuple[str, ...] = ()
    """As --set: fit.rim.inlier=0.2 mm."""
    expected: Expected
    source: str
    """Address at which others find the recording."""
    licence: str
    """Under which licence, or that none is stated."""


def read_manifests(folder: Path) -> dict[Path, Manifest]:
    """Return the manifests of a folder by their files.

    Raises:
        RecipeError: There are none, or one is wrong: names the line.
    """
    files = sorted(p for p in folder.glob("*.y*ml") if p.is_file())
    if not files:
        raise RecipeError(
            f"{folder}: holds no manifests; one is a .yaml file with title, recording, recipe, "
            "expected, source and licence"
        )
    return {file: _checked(file) for file in files}


def _checked(file: Path) -> Manifest:
    manifest = read_model(file, Manifest)
    if (manifest.expected.closure is None) != (manifest.expected.tolerance is None):
        raise RecipeError(f"{file}: expected.closure and expected.tolerance go together")
    return manifest


__all__ = ["Manifest", "ManifestComparison", "compare", "read_manifests"]
