"""Run every recipe with two versions of the code and compare the results bit by bit.

    python -m tools.equal_results COMMIT [WORD ...]

COMMIT is checked out into a temporary folder and run by the same interpreter and libraries. The
other version is this folder, or another commit (``--to``). Recipes with one of the words in their
names are run, by default all that both versions have. Timing, versions and names of folders are
ignored.

One line per recipe is printed: ``equal``, or the number of different values with their names and
the first one. Recipes with an emulator in real time (``--move``) are left out, as they differ from
run to run; the paper's studies are run by tests/paper. Archives are those of ``--archive``
(../shared/data/ancorasir).
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve().parents[1]
RECORDINGS = HERE.parent / "shared" / "data" / "ancorasir"
# What two equal runs differ in, and what says which code and which folder it was.
APART = ("timing", "provenance.versions", "provenance.plugins", "exports")
# Hashes and notes may hold the recording's path.
PATHS = ("provenance.input_hash", "provenance.recipe_hash")


def main() -> int:
    request = _request()
    with TemporaryDirectory() as place:
        before = _checked_out(request.commit, Path(place) / "code_before")
        after = _checked_out(request.to, Path(place) / "code_after") if request.to else HERE
        names = [n for n in _recipes(before) if n in _recipes(after) and _wanted(n, request.words)]
        with ThreadPoolExecutor(request.processes) as pool:
            lines = pool.map(lambda n: _line(n, before, after, request.archive), names)
            told = [_printed(line) for line in lines]
    equal = sum(line.endswith(": equal") for line in told)
    print(
        f"{equal} of {len(told)} recipes are equal at {request.commit} and {request.to or 'here'}"
    )
    return 0 if equal == len(told) else 1


def _request() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.equal_results", description=__doc__)
    parser.add_argument("commit", help="the state to compare with")
    parser.add_argument("words", nargs="*", help="parts of the names of recipes")
    parser.add_argument("--to", metavar="COMMIT", help="a commit in place of this folder")
    parser.add_argument("--archive", type=Path, default=RECORDINGS, help="recordings of archives")
    parser.add_argument("--processes", type=int, default=2)
    return parser.parse_intermixed_args()


def _printed(line: str) -> str:
    print(line, flush=True)
    return line


def _checked_out(commit: str, folder: Path) -> Path:
    """Return a folder with the code of a commit and its plugins' metadata."""
    archive = subprocess.run(
        ["git", "archive", commit], cwd=HERE, check=True, capture_output=True
    ).stdout
    folder.mkdir(parents=True)
    subprocess.run(["tar", "x"], cwd=folder, input=archive, check=True)
    return folder


def _recipes(code: Path) -> list[str]:
    folder = code / "recipes"
    return sorted(str(p.relative_to(folder).with_suffix("")) for p in folder.rglob("*.yaml"))


def _wanted(name: str, words: list[str]) -> bool:
    return (
        not name.startswith("paper/")
        and not name.endswith("_loopback")
        and (not words or any(word in name for word in words))
    )


def _line(name: str, before: Path, after: Path, archive: Path) -> str:
    """Return the line that compares a recipe's two results."""
    with TemporaryDirectory() as place:
        old, new = (
            _result(name, code, Path(place) / code.name, archive) for code in (before, after)
        )
    if isinstance(old, dict) and isinstance(new, dict):
        return f"{name}: " + _summary(list(_differences(old, new)))
    return (
        f"{name}: equal" if old == new else f"{name}: {_ending(old)} before, {_ending(new)} after"
    )


def _summary(apart: list[str]) -> str:
    """Return a text with the number of different values, their names, and the first one."""
    if not apart:
        return "equal"
    places = (re.sub(r"\[\d+\]", "", line.partition(":")[0]) for line in apart)
    names = ", ".join(sorted({place.rpartition(".")[2] for place in places}))
    return f"{len(apart)} values differ, of {names}; {apart[0]}"


def _ending(result: Any) -> str:
    return repr(result) if isinstance(result, str) else "a result"


def _result(name: str, code: Path, out: Path, archive: Path) -> Any:
    """Return the result of a recipe run by some state of the code, or its last line without."""
    run = out / name.replace("/", "_")
    words = ["run", str(code / "recipes" / f"{name}.yaml"), "--out", str(run)]
    if name.endswith("_archive"):
        words += ["--archive", str(archive)]
    out.mkdir(parents=True, exist_ok=True)
    ended = subprocess.run(
        [sys.executable, "-P", "-m", "flangeye.cli", *words],
        cwd=out, env=_environment(code, out), capture_output=True, text=True,
    )  # fmt: skip
    found = list(run.rglob("result.json"))
    if not found:
        return (ended.stderr.strip().splitlines() or ["no word"])[-1].replace(str(code), "CODE")
    text = found[0].read_text(encoding="utf-8")
    return json.loads(text.replace(str(code), "CODE").replace(str(out), "OUT"))


def _environment(code: Path, out: Path) -> dict[str, str]:
    """Return an environment that imports the packages and plugins of `code`."""
    named = out / "plugins"
    for file in (code / "pyproject.toml", code / "plugins" / "flangeye_paper" / "pyproject.toml"):
        if file.is_file():
            _name_plugins(tomllib.loads(file.read_text(encoding="utf-8"))["project"], named)
    path = os.pathsep.join(map(str, (named, code / "pipeline", code / "plugins")))
    return {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(out / "cache")}


def _name_plugins(project: dict[str, Any], named: Path) -> None:
    """Write plugin metadata that takes precedence over the installed one."""
    info = named / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = project.get("entry-points", {}).get("flangeye", {})
    lines = [f"{name} = {where}" for name, where in points.items()]
    (info / "entry_points.txt").write_text("\n".join(["[flangeye]", *lines, ""]))


def _differences(before: Any, after: Any, where: str = "") -> Iterator[str]:
    """Yield each value that differs, by its place; numbers are equal to the last bit or not."""
    if where in APART or where in PATHS:
        return
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            below = f"{where}.{key}" if where else key
            yield from _differences(before.get(key), after.get(key), below)
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for i, pair in enumerate(zip(before, after, strict=True)):
            yield from _differences(*pair, f"{where}[{i}]")
    elif before != after and not _both_nan(before, after):
        yield f"{where}: {_short(before)}, now {_short(after)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _both_nan(before: Any, after: Any) -> bool:
    pair = (before, after)
    return all(isinstance(x, float) and math.isnan(x) for x in pair)


if __name__ == "__main__":
    raise SystemExit(main())
