"""Everything a recipe can make a process open or start is in one list in the documentation."""

import re
from pathlib import Path

import pytest

from tests.openings import ROOT, openings

PAGE = ROOT / "docs" / "reference" / "what-a-recipe-can-open.md"


def listed():
    rows = re.findall(r"^\| (\S+\.py) \| (.*?) \|", PAGE.read_text("utf-8"), re.MULTILINE)
    return {(file, word) for file, words in rows for word in re.findall(r"`([^`]+)`", words)}


def test_the_list_has_all_that_opens_loads_or_starts_something_and_nothing_else() -> None:
    found = openings()
    missing, gone = sorted(found - listed()), sorted(listed() - found)
    assert not missing, f"say in {PAGE.name} what these open, and who names it: {missing}"
    assert not gone, f"{PAGE.name} lists what the source does not have: {gone}"


def test_the_search_sees_each_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tests.openings as search

    source = tmp_path / "pipeline" / "flangeye" / "new.py"
    source.parent.mkdir(parents=True)
    lines = {
        "import subprocess": "subprocess", "from ctypes import CDLL": "ctypes",
        "import importlib\nimportlib.import_module(name)": "import_module",
        "exec(text)": "exec", "__import__(name)": "__import__", "os.execv(a, b)": "execv",
        "path.open('rb')": "open", "open(path)": "open", "np.load(path)": "np.load",
        "harvester.add_file(path)": "add_file", "import pickle": "pickle",
    }  # fmt: skip
    monkeypatch.setattr(search, "ROOT", tmp_path)
    for line, word in lines.items():
        source.write_text(line)
        assert word in {w for _, w in search.openings()}, line
    source.write_text("re.compile(x)\nwith robot.open() as r: pass\n")
    assert search.openings() == set()
