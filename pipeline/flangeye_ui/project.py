"""State shared by all pages of a server: the folder, the recipe, the present run."""

from __future__ import annotations

import re
import secrets
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flangeye.devices import RobotDriver
from flangeye.errors import FlangeyeError, RecipeError, StageError
from flangeye.files.regular import read_regular, read_text, write_whole
from flangeye.files.yaml_lines import edited, flow, parse_yaml
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import KINDS
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import Recipe, load_recipe
from flangeye.workflow.report.facts import Facts, facts_of
from flangeye_ui.process import RunProcess


@dataclass(frozen=True)
class Mistake:
    """A mistake in the recipe.

    Attributes:
        line: Line of the YAML, from 1; 0 if unknown.
        path: Path of the field, such as ``steps.2.fit.rim.inlier``; empty if unknown.
        text: Text of the mistake.
    """

    line: int
    path: str
    text: str


class Project:
    """The state behind the pages; one per server, so that all browsers show the same.

    Attributes:
        folder: Folder of recipes and runs.
        registry: The installed plugins.
        codes: Confirmation codes for motions, shown in the terminal.
        run: The run started last from a page, if any.
        owner: The page that started it.
        ran: The recipe with which it was started.
        planned: The recipe whose poses were checked last, with these poses.
    """

    def __init__(self, folder: Path, registry: Registry, codes: MoveCodes) -> None:
        self.folder, self.registry, self.codes = folder, registry, codes
        self.run: RunProcess | None = None
        self.owner, self.ran = "", ""
        self.planned, self.plan = "", list[dict[str, Any]]()
        if not self.recipe_path.exists():
            self.text = read_text(Path(__file__).with_name("new.yaml"))
        read_regular(self.recipe_path)

    @property
    def recipe_path(self) -> Path:
        """The recipe that the pages work on."""
        return self.folder / "cell.yaml"

    @property
    def text(self) -> str:
        """The recipe's text on disk; ``check`` reports bytes that are not text."""
        return read_regular(self.recipe_path).decode("utf-8", "replace")

    @text.setter
    def text(self, text: str) -> None:
        write_whole(self.recipe_path, text)

    def data(self) -> dict[str, Any]:
        """Return the recipe as data; empty if it is not a mapping."""
        try:
            data = parse_yaml(self.text, self.recipe_path.name).data
        except RecipeError:
            return {}
        return data if isinstance(data, dict) else {}

    def section(self, name: str) -> dict[str, Any]:
        """Return a section of the recipe as data; one word is its model, as in any recipe."""
        given = self.data().get(name)
        if isinstance(given, dict):
            return given
        return {"model": given} if isinstance(given, str) else {}

    def steps(self) -> list[tuple[str, dict[str, Any]]]:
        """Return name and given parameters of every step; empty ones for an invalid step."""
        given = self.data().get("steps")
        return [_step_of(entry) for entry in given] if isinstance(given, list) else []

    def edit(self, data: dict[str, Any]) -> None:
        """Write the changes to the recipe's file; comments are kept."""
        self.text = edited(self.text if self.data() else "", data)

    def start_from(self, recipe: Path) -> None:
        """Use another recipe; the files that it names are not copied."""
        text = read_text(recipe)
        for name in set(re.findall(r"[\w./-]+", text)):
            beside = (recipe.parent / name).resolve()
            if "." in name and beside.exists():
                text = text.replace(f" {name}", f" {flow(str(beside))}")
        self.text = text

    def check(self) -> tuple[Recipe | None, list[Mistake]]:
        """Return the checked recipe, or everything that is wrong with it."""
        try:
            return load_recipe(self.recipe_path, self.registry), []
        except FlangeyeError as error:
            return None, [_mistake(line) for line in str(error).splitlines()]

    @property
    def simulated(self) -> bool:
        """Whether scans come from a simulation, or an arm or a scanner is an emulator."""
        drivers = [str(self.section(part).get("driver")) for part in ("robot", "scanner")]
        first = next((name for name, _ in self.steps()), "")
        return ".simulated" in first or any("emulator" in driver for driver in drivers)

    def done(self) -> set[str]:
        """Return the steps that are done: of the recipe, and of the newest run."""
        # A recipe with mistakes undoes its own steps, not those of a run that exists
        sound = self.check()[0] is not None
        newest = next(iter(self.runs()), None)
        found = {"Cell", *({"Poses"} if self.planned == self.text or newest else ())}
        if newest and (newest / "result.json").exists():
            found.add("Scan")
            found |= {"Result"} if (newest / "calibration.yaml").exists() else set()
            found |= {"Use"} if any(newest.glob("exports/*")) else set()
        return found if sound else found - {"Cell", "Poses"}

    def runs(self) -> list[Path]:
        """Return the folders of all runs, newest first."""
        logs = self.found("runs/*/run.mcap")
        return [p.parent for p in sorted(logs, key=lambda p: p.stat().st_mtime, reverse=True)]

    def found(self, pattern: str) -> list[Path]:
        """Return the folder's files that match a pattern, sorted, without undecodable names.

        Python represents a byte that is not UTF-8 by a lone surrogate, which a page cannot show.
        """
        paths = sorted(self.folder.glob(pattern))
        here = len(str(self.folder))
        return [p for p in paths if not re.search("[\ud800-\udfff]", str(p)[here:])]

    def read(self, run: Path) -> Facts:
        """Return the log of a run.

        Raises:
            StageError: It cannot be read: damaged, or written by another version.
        """
        try:
            return facts_of(read_run(run / "run.mcap"))
        except ValueError as error:
            what = str(error).splitlines()[0]
            raise StageError(f"{run.name}/run.mcap: cannot be read: {what}") from None

    def command(self, *words: str) -> str:
        """Return a command line of flangeye, to copy."""
        return shlex.join(["flangeye", *words])

    def run_command(self, words: Sequence[str], patience: float = 300.0) -> str:
        """Run a flangeye command that moves nothing in the folder, and return its output."""
        line = [sys.executable, "-P", "-m", "flangeye.cli", *words]
        try:
            # Another process: a command that hangs or crashes must not take the pages with it
            done = subprocess.run(
                line, cwd=self.folder, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                timeout=patience,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return f"error: flangeye {words[0]} took longer than {patience:.0f} s"
        return (done.stdout + done.stderr).strip()

    def write_line(self, name: str, params: Mapping[str, Any]) -> None:
        """Insert a line into the recipe: parameters into a step, or a section into the header."""
        if "." in name:
            self.write_step(name, params)
        else:
            data = {**self.data(), name: dict(params)}
            self.edit({**{k: v for k, v in data.items() if k != "steps"}, "steps": data["steps"]})

    def write_step(self, name: str, params: Mapping[str, Any]) -> None:
        """Set a step's parameters in the recipe; add the step at its place if it is missing.

        If a recipe can have only one step of this kind, the present one is replaced.
        """
        data = self.data()
        steps, known = list(data.get("steps") or []), self.steps()
        names = [step for step, _ in known]
        if name in names:
            at = names.index(name)
            steps[at] = {name: {**known[at][1], **params}}
        else:
            kinds, kind = list(KINDS), name.partition(".")[0]
            ranks = [kinds.index(each.partition(".")[0]) for each in names]
            # Before the first later kind; after steps of its own kind if there may be several
            before = kinds.index(kind) + KINDS[kind].several
            at = next((i for i, rank in enumerate(ranks) if rank >= before), len(steps))
            replaced = not KINDS[kind].several and kinds.index(kind) in ranks
            # An empty slice inserts, one of length 1 replaces
            steps[at : at + replaced] = [{name: dict(params)}]
        self.edit({**data, "steps": steps})

    def unfinished(self) -> Path | None:
        """Return the newest run if it ended before its result; None while a run goes on."""
        runs = self.runs()
        going = self.run is not None and self.run.code is None
        if going or self.elsewhere() or not runs or (runs[0] / "result.json").exists():
            return None
        return runs[0]

    def elsewhere(self) -> Path | None:
        """Return a run that another program is writing, if there is one."""
        ours = self.run.path if self.run else None
        now = time.time()
        for run in self.runs()[:1]:
            # A log that did not grow for so long is not being written any more [s]; nor is one of
            # a time to come: the clock was set back after it
            fresh = abs(now - (run / "run.mcap").stat().st_mtime) < 10.0
            if fresh and run != ours and not (run / "result.json").exists():
                return run
        return None

    def begin(self, words: Sequence[str], owner: str, code: str | None = None) -> None:
        """Start ``flangeye run``, or a live check, for a page.

        Args:
            words: Words of the command line, without ``--move``: ``run cell.yaml``.
            owner: The page that starts it.
            code: Confirmation code from the terminal that permits motion; None moves nothing.

        Raises:
            StageError: The code does not belong to this command and page.
        """
        if code is not None:
            self.codes.spend(code, words, owner)
        self.run = RunProcess(self.folder, words, code is not None, self.registry)
        self.owner, self.ran = owner, self.text

    def page_gone(self, page: str, why: str = "the page was closed") -> None:
        """Stop an arm that moves for a page that is not there any more."""
        if self.run and self.run.moves and page == self.owner:
            self.run.stop(why)


def is_live(recipe: Recipe) -> bool:
    """Return whether a recipe scans with the cell's own arm and scanner."""
    return recipe.steps[0].stage.name == "acquire.live"


def moves(recipe: Recipe) -> bool:
    """Return whether a run of a recipe moves an arm, which asks for a code."""
    arm = recipe.context.get(RobotDriver)
    return is_live(recipe) and not (arm and arm.passive)


def _step_of(entry: Any) -> tuple[str, dict[str, Any]]:
    """Return name and parameters of a step as written in a recipe."""
    if isinstance(entry, dict) and len(entry) == 1:
        ((name, given),) = entry.items()
        return str(name), given if isinstance(given, dict) else {}
    return entry if isinstance(entry, str) else "", {}


def _mistake(line: str) -> Mistake:
    found = re.match(r"^[^:]*:(\d+)(?::\d+)?: (?:([\w.]+): )?(.*)$", line)
    if not found:
        return Mistake(0, "", line)
    return Mistake(int(found[1]), found[2] or "", found[3])


def at(mistakes: list[Mistake], *paths: str) -> Iterator[str]:
    """Yield the mistakes at a field or within it."""
    for mistake in mistakes:
        if any(mistake.path == p or mistake.path.startswith(f"{p}.") for p in paths):
            yield mistake.text


class MoveCodes:
    """Makes codes, each for one command of one page, and takes each once."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show, self._wrong = show, 0
        self._open: tuple[str, tuple[str, ...], str, float] | None = None

    def ask(self, words: Sequence[str], page: str) -> None:
        """Show a new code in the terminal, with the command that it would allow."""
        digits = 6
        code = f"{secrets.randbelow(10**digits):0{digits}d}"
        # A code is good for so long [s]: time to walk to the terminal and back.
        life = 120.0
        self._open = (code, tuple(words), page, time.monotonic() + life)
        line = shlex.join(["flangeye", *words, "--move"])
        self._show(f"code {code} moves the arm: {line}   (asked for by the page, {life:.0f} s)")

    def spend(self, given: str, words: Sequence[str], page: str) -> None:
        """Use up a confirmation code.

        Raises:
            StageError: The code does not belong to this command, or was used already.
        """
        # Wrong codes of one server, by mistyping; guessing that often meets 5 of 10^6.
        if self._wrong >= 5:
            raise StageError("too many wrong codes: nothing moves until 'flangeye ui' is restarted")
        shown, self._open = self._open, None
        if shown is None or shown[1:3] != (tuple(words), page) or time.monotonic() > shown[3]:
            raise StageError("the code has expired: start again, and type the new one")
        if not secrets.compare_digest(given.strip().encode(), shown[0].encode()):
            self._wrong += 1
            raise StageError("that is not the code in the terminal: start again for a new one")
