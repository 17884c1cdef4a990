"""Thousands of sessions in one process: python -m tools.soak.

Memory and open files are looked at in the second half: they must not grow by more than 5 %.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import typer

from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run
from tests.conftest import TOY_RECIPE, toy_plugins

ALLOWED = 0.05


def main(sessions: int = 1000, captures: int = 2000) -> None:
    """Run the sessions, then one of many captures, and compare."""
    seen: list[tuple[int, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "toy.yaml"
        for number in range(sessions):
            _session(recipe, Path(folder) / str(number), 6)
            seen.append(_held())
        _session(recipe, Path(folder) / "long", captures)
        seen.append(_held())
    half = seen[len(seen) // 2]
    print(f"after {len(seen) // 2} sessions: {half[0]} kB, {half[1]} files")
    print(f"after {sessions} sessions and one of {captures} captures: {seen[-2][0]} then {seen[-1][0]} kB, "
          f"{seen[-1][1]} files")  # fmt: skip
    raise typer.Exit(seen[-2][0] > half[0] * (1 + ALLOWED) or seen[-1][1] > half[1])


def _session(recipe: Path, out: Path, captures: int) -> None:
    recipe.write_text(TOY_RECIPE.replace("count: 6", f"count: {captures}"), "utf-8")
    registry = toy_plugins()
    folder = RunFolder.create("toy", out)
    record_run(load_recipe(recipe, registry), registry, folder, Start(), report=False)
    assert read_run(folder.log).complete
    folder.discard()


def _held() -> tuple[int, int]:
    """Return resident memory [kB] and open files of this process."""
    status = Path("/proc/self/status").read_text("utf-8")
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]), len(list(Path("/proc/self/fd").iterdir()))


if __name__ == "__main__":
    typer.run(main)
