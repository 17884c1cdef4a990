"""Survey a folder of recordings, and ask the user what it does not show."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flangeye.errors import FlangeyeError, RecipeError, StageError
from flangeye.files.cameras import cameras_in
from flangeye.files.clouds import CONVERSIONS
from flangeye.files.images import is_depth_image
from flangeye.files.recording import MIN_CAPTURES
from flangeye.files.regular import is_pointer
from flangeye.files.scans import CLOUD_SUFFIXES, IMAGES, is_matrix, natural, texts_of_points
from flangeye.files.tables import DOCUMENT_READERS, Table, number_of, read_table, tables_in
from flangeye.files.words import printable
from flangeye.workflow.recipe.draft.headings import lists_in, role_in

Prompt = Callable[[str, str | None], str]
"""Asks a person; takes the question and the default, returns the answer."""
AnswerCheck = Callable[[str], object]
"""Raises :class:`FlangeyeError` for an answer that cannot be used."""


def one_of(*choices: str) -> AnswerCheck:
    """Return a check that only ``choices`` pass."""

    def check(answer: str) -> None:
        if answer not in choices:
            raise RecipeError(f"{answer}: is not one of {', '.join(choices)}")

    return check


@dataclass
class Questions:
    """Answers to questions: from options, from the data, or from the user.

    Attributes:
        given: Answers by option, from the command line or the user; None if not given.
        prompt: Asks the user; None without a terminal.
        assumed: Lines on the defaults used, to print at the end.
        likely: Likely answers from the data with their evidence, by option.
        mended: Corrections of the target's poses, as ``reader.corrected`` takes it.
        open: Option of the question that neither data nor a person answered; empty without one.
        rivals: Rotation conventions among which scans should decide, if the assumed one is unsure.
    """

    given: dict[str, str | None] = field(default_factory=dict)
    prompt: Prompt | None = None
    assumed: list[str] = field(default_factory=list)
    likely: dict[str, tuple[str, str]] = field(default_factory=dict)
    mended: dict[str, Any] = field(default_factory=dict)
    open: str = ""
    rivals: Sequence[str] = ()

    def ask(
        self,
        flag: str,
        question: str,
        default: str | None,
        example: str = "",
        check: AnswerCheck | None = None,
        known: str = "",
    ) -> str:
        """Return the answer to a question; a person is asked again after an invalid answer.

        Args:
            flag: Command-line option that answers the question.
            question: Text shown to the person.
            default: The likely answer; None if there is none.
            example: Example answer, shown in the error message.
            check: Raises an error for an invalid answer.
            known: List of possible answers, shown with the question.

        Raises:
            RecipeError: There is neither a default nor a person to ask; names the option to add.
        """
        answer = self.given.get(flag)
        if answer is None:
            default, shown = self.likely.get(flag, (default, ""))
            if self.prompt is None and default is not None:
                reason = f"{shown}; " if shown else ""
                self.assumed.append(f"{question}: {default} ({reason}--{flag} changes it)")
                answer = default
            else:
                asked = f"{question} ({known})" if known else question
                asked += f"; by the data: {shown}" if shown else ""
                answer = self._asked(flag, asked, default, example, check)
            self.given[flag] = answer
        return answer

    def _asked(
        self, flag: str, question: str, default: str | None, example: str, check: AnswerCheck | None
    ) -> str:
        if self.prompt is None:
            self.open = flag
            raise RecipeError(f"not known: {question}; add --{flag} {example}".rstrip())
        refused = ""
        while True:
            answer = self.prompt(f"{refused}{question} (--{flag})", default)
            try:
                if check:
                    check(answer)
            except FlangeyeError as error:
                refused = f"{error}\n"
            else:
                return answer


@dataclass(frozen=True)
class FolderSurvey:
    """The contents of a folder of recordings.

    Attributes:
        folder: Path of the folder.
        files: All files of the folder and its subfolders.
        tables: Files that are tables of numbers.
        points: Text files and archives of arrays with one cloud each.
        cameras: Calibration files of a camera.
    """

    folder: Path
    files: Sequence[Path]
    tables: Sequence[Table]
    points: Collection[Path] = ()
    cameras: Collection[Path] = ()

    @property
    def clouds(self) -> list[Path]:
        """The clouds, those in texts and archives of arrays too."""
        found = {*(p for p in self.of(CLOUD_SUFFIXES) if not is_matrix(p)), *self.points}
        return [path for path in self.files if path in found or is_depth_image(path)]

    @property
    def images(self) -> list[Path]:
        """The images of a camera."""
        return [path for path in self.of(IMAGES) if not is_depth_image(path)]

    def of(self, suffixes: Sequence[str]) -> list[Path]:
        """Return the files that end so; tables of poses are not clouds."""
        read = {file for table in self.tables for file in table.files}
        return [p for p in self.files if p.suffix.lower() in suffixes and p not in read]

    def lines(self) -> list[str]:
        """Return the survey as lines of text."""
        unread = (".npz", ".mat", *CONVERSIONS)
        read = {*self.cameras, *self.points}
        told = [
            f"{what}: {', '.join(f'{n} {suffix}' for suffix, n in sorted(kinds.items()))}"
            for what, paths in (
                ("clouds", self.clouds),
                ("images", self.images),
                ("not read", [p for p in self.of(unread) if p not in read]),
            )
            if (kinds := Counter(p.suffix.lower() for p in paths))
        ]
        return [*told, *(f"table: {_of_table(table)}" for table in self.tables)]


def look(folder: Path) -> FolderSurvey:
    """Return a survey of a folder.

    Raises:
        RecipeError: There is none, or it is empty.
    """
    if not folder.is_dir():
        raise RecipeError(f"{folder}: is not a folder; name the one that holds the recordings")
    cameras: set[Path] = set()
    folder = _where_files_are(folder)
    found = (p for p in (*folder.glob("*"), *folder.glob("*/*")) if p.is_file())
    files = sorted(found, key=lambda path: natural(str(path)))
    for path in files:
        if printable(str(path)) != str(path):
            raise RecipeError(
                f"{folder}: the name of {path.name!a} has control characters or is not UTF-8, so "
                "no recipe can name it; rename the file"
            )
    if not any(folder.iterdir()):
        raise RecipeError(f"{folder}: is empty; put the clouds or images and their poses there")
    if pointers := [path for path in files if is_pointer(path)]:
        raise RecipeError(
            f"{folder}: {len(pointers)} of {len(files)} files are Git LFS pointers, not the files "
            f"themselves, such as {pointers[0].name}; fetch them: git lfs pull"
        )
    with suppress(StageError):
        cameras = {camera.path for camera in cameras_in(folder)}
    points = texts_of_points(files)
    others = [file for file in files if file not in points]
    tables = [
        table
        for place, of in places(folder, others)
        for table in _tables(folder, place, len(of))
        # What calibrated the camera saw the target, or where it was: rvecs, transform_matrix
        if not cameras & set(of) or re.search("vec|transform", " ".join(table.heading).lower())
    ]
    return FolderSurvey(folder, files, _whole(folder, tables), points, cameras)


def _where_files_are(folder: Path) -> Path:
    """Return a folder, or its only non-empty subfolder, recursively.

    Raises:
        RecipeError: There are files in several subfolders only; the message names one.
    """
    inner = [path for path in folder.iterdir() if not path.name.startswith(".")]
    # Archives often unpack into a folder within a folder
    while len(inner) == 1 and inner[0].is_dir():
        folder, inner = inner[0], list(inner[0].iterdir())
    if not any(p.is_file() for pattern in ("*", "*/*") for p in folder.glob(pattern)):
        deep = next((p for p in sorted(folder.glob("*/*/*")) if p.is_file()), None)
        if deep is not None:
            raise RecipeError(
                f"{folder}: its files are in nested folders, such as {deep.relative_to(folder)}; "
                f"name the folder of one session: flangeye init {deep.parents[1]}"
            )
    return folder


def places(folder: Path, files: Sequence[Path]) -> Iterator[tuple[str, list[Path]]]:
    """Yield files as named in a recipe; files with similar names share one pattern."""
    groups: dict[str, list[Path]] = defaultdict(list)
    known = (
        ".csv", ".txt", ".md", ".dat", ".tsv", ".tum", ".log", ".mod", ".src", ".ls", ".script",
        *DOCUMENT_READERS,
    )  # fmt: skip
    for file in files:
        if file.suffix.lower() in known and not too_long(file):
            alike = re.sub(r"\d+", "*", file.stem) + file.suffix
            groups[str(file.relative_to(folder).with_name(alike))].append(file)
    groups = {place: of for files in groups.values() for place, of in _series(folder, files)}
    single = [file for files in groups.values() if len(files) < MIN_CAPTURES for file in files]
    one_each = [n for n, count in Counter(f.name for f in single).items() if count >= MIN_CAPTURES]
    yield from ((place, files) for place, files in groups.items() if len(files) >= MIN_CAPTURES)
    for file in single:
        if file.name not in one_each:
            yield str(file.relative_to(folder)), [file]
    for name in one_each:  # a folder for each capture
        yield f"*/{name}", [file for file in single if file.name == name]


def too_long(file: Path) -> bool:
    """Return whether a file is too large to hold poses; it is not looked into."""
    return file.stat().st_size > 10_000_000


def _series(folder: Path, files: Sequence[Path]) -> Iterator[tuple[str, list[Path]]]:
    """Yield groups of files whose names differ in numbers only, by pattern.

    Files of several cameras form separate groups: an earlier number separates them if the last
    number occurs twice (``cam0_7`` and ``cam1_7``), unless it belongs to a date or time.
    """
    runs = [re.split(r"(\d+)", file.stem) for file in files]
    parts: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for at, run in enumerate(runs):
        parts[tuple(run[:-2])].append(at)
    last = Counter(run[-2] for run in runs if len(run) > 1)
    whole = max(last.values(), default=0) == 1 or max(map(len, parts.values())) < MIN_CAPTURES
    for ats in [list(range(len(files)))] if whole else parts.values():
        columns = zip(*(runs[at] for at in ats), strict=True)
        stem = "".join(
            column[0]
            if len(set(column)) == 1 and k < len(runs[0]) - 2
            else "*"
            if k % 2
            else column[0]
            for k, column in enumerate(columns)
        )
        place = files[ats[0]].relative_to(folder).with_name(stem + files[0].suffix)
        yield str(place), [files[at] for at in ats]


def _tables(folder: Path, place: str, files: int) -> list[Table]:
    """Return the tables of poses in a file, or one table for files with one pose each."""
    try:
        found = [read_table(folder, place)] if files > 1 else tables_in(folder, place)
    except FlangeyeError:
        return []
    apart = [part for table in found for part in _by_whom(folder, table) or [table]]
    return [t for t in apart if _holds_numbers(t) and (files < 2 or len(t.rows) == files)]


def _by_whom(folder: Path, table: Table) -> list[Table]:
    """Return the rows of arm and target, if a column names the owner of each row."""
    for column in range(len(table.heading)):
        called = [str(name) for name in dict.fromkeys(table.texts(column))]
        # Owners recur (robot, marker, robot, …), names of rows do not
        few = len(called) * MIN_CAPTURES <= len(table.rows)
        if few and {role_in(name) for name in called} >= {"arm", "target"}:
            return [read_table(folder, f"{table.name}:{name}") for name in called if role_in(name)]
    return []


def _holds_numbers(table: Table) -> bool:
    if len(table.rows) < MIN_CAPTURES:
        return False
    numbers = sum(number_of(cell) is not None for cell in table.rows[0][1])
    return numbers >= MIN_CAPTURES


def _whole(folder: Path, tables: Sequence[Table]) -> list[Table]:
    """Return tables with rotations joined to positions of the same name.

    Points without the same number of poses are left out.
    """
    keys = {table.name: _key(table.name) for table in tables if _width(table) in (3, 9)}
    joined: list[Table] = []
    used: set[str] = set()
    for turns in tables:
        key = keys.get(turns.name)
        # Each rotation looks for its position; the reverse would join every pair twice
        if key is None or key[0].startswith(("t", "p")):
            continue
        for places_of in tables:
            other = keys.get(places_of.name)
            same = other is not None and other[1] == key[1] and other[0].startswith(("t", "p"))
            if same and _width(places_of) == 3 and len(places_of.rows) == len(turns.rows):
                joined.append(read_table(folder, [places_of.name, turns.name]))
                used |= {places_of.name, turns.name}
    rest = [table for table in tables if table.name not in used]
    counts = {len(t.rows) for t in (*joined, *rest) if t.heading or _width(t) > 3}
    return [*joined, *(t for t in rest if _width(t) > 3 or len(t.rows) in counts)]


def _width(table: Table) -> int:
    """Return the number of values in a row without column names; 0 with names."""
    return 0 if table.heading else len(table.rows[0][1])


def _key(name: str) -> tuple[str, str] | None:
    """Return whether a name is of rotations or of positions, and the rest of it."""
    match = re.search(
        r"(?<![a-z])(r|rot|rotations?|rvecs?|t|trans|translations?|tvecs?|pos)(?![a-z])",
        name.lower(),
    )
    return match and (match[1], name[: match.start()].lower() + name[match.end() :].lower())


def _of_table(table: Table) -> str:
    lists = lists_in(table.heading)
    sizes = Counter(lists.values())
    names = dict.fromkeys(lists.get(name, name) for name in table.heading)
    shown = [f"{name} ({sizes[name]} numbers)" if name in sizes else name for name in names]
    heading = ", ".join(shown) or f"no heading, {len(table.rows[0][1])} columns"
    return f"{table.name}, {len(table.rows)} rows: {heading}"
