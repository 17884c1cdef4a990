"""Which sessions a batch has, and when a session is still the same."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.errors import FlangeyeError, StageError
from flangeye.plugin.registry import load_registry
from flangeye.workflow.batch import plan as batch_plan
from flangeye.workflow.batch.outcome import BatchError, Request
from flangeye.workflow.batch.plan import (
    Software,
    _code_of,
    check_software,
    plan,
    software_of,
    split_values,
)
from flangeye.workflow.recipe.load import load_recipe
from tests.conftest import Call

SOFTWARE = Software("1", ("toy 1.0",))


@pytest.fixture
def sessions(recipe: Path, registry: Any) -> Callable[..., Any]:
    def call(name=recipe, software=SOFTWARE, **wanted):
        return list(plan(Request(str(name), **wanted), registry, software))

    return call


def test_grid_times_seeds(sessions: Callable[..., Any]) -> None:
    found = sessions(grid=("steps.2.inlier=0.2 mm,0.3 mm", "steps.0.count=5,6,7"), repeat=2)
    assert [(*s.varied.values(), s.seed) for s in found] == [
        (inlier, count, seed)
        for inlier in ("0.2 mm", "0.3 mm") for count in "567" for seed in (3, 4)
    ]  # fmt: skip
    assert len({s.id for s in found}) == 12
    assert found[0].overrides == ("steps.2.inlier=0.2 mm", "steps.0.count=5")


def test_a_grid_compares_solvers() -> None:
    request = Request("ur5_phoxi-m_sample", grid=("steps.3=solve.svd,solve.robust",))
    found = list(plan(request, load_registry(), SOFTWARE))
    assert [s.varied for s in found] == [{"steps.3": "solve.svd"}, {"steps.3": "solve.robust"}]
    assert len({s.key for s in found}) == 2


def test_archives_times_values(
    sessions: Callable[..., Any], archive_recipe: Path, archives: Any
) -> None:
    found = sessions(
        archive_recipe, archives=tuple(map(str, archives)), grid=("steps.4.max_rms=1 mm,2 mm",)
    )
    assert [s.archive for s in found] == [str(path) for path in archives] * 2
    assert all("<" not in s.id and "/" not in s.id for s in found)
    assert found[0].id.startswith("replay_one.txt_")


def test_a_recipe_alone_is_one_session(sessions: Callable[..., Any]) -> None:
    (session,) = sessions()
    assert (session.varied, session.seed, session.archive) == ({}, 3, None)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"grid": ("steps.9.x=1,2",)}, "--set-grid steps.9.x: no step '9'; steps are 0 to 4"),
        ({"grid": ("steps.0.cuont=1,2",)},
         "--set-grid steps.0.acquire.toy.cuont: unknown key 'cuont'; did you mean 'count'? "
         "(allowed: count, noise, bad, verification)"),
        ({"grid": ("steps.2.inlier=0.2 mm,3",)},
         "--set-grid steps.2.fit.toy.inlier: '3' has no unit: a length needs one (mm, m, um, for "
         "example '31.5 mm')"),
        ({"overrides": ("steps.9.x=1",)}, "--set steps.9.x: no step '9'; steps are 0 to 4"),
        ({"grid": ("seed",)}, "--set-grid seed: write PATH=a,b,c, for example "
         "steps.2.inlier='0.2 mm,0.3 mm'"),
        ({"grid": ("seed=1,,2",)}, "--set-grid seed=1,,2: write PATH=a,b,c, for example "
         "steps.2.inlier='0.2 mm,0.3 mm'"),
        ({"grid": ("seed=1", "seed=2")},
         "--set-grid: the same path is given twice; write its values in one list"),
        ({"grid": ("seed=1,2",), "repeat": 2},
         "--repeat counts the seed up, and --set-grid sets it; use one of them"),
        ({"repeat": 2, "vary": "steps.0.count"},
         "--vary steps.0.count: --repeat can vary the seed only; for other values write "
         "--set-grid steps.0.count=a,b,c"),
        ({"grid": ("steps.2.inlier=0.2 mm,0.0002 m",)},
         "the same session is requested twice: toy.yaml steps.2.inlier=0.2 mm and "
         "toy.yaml steps.2.inlier=0.0002 m"),
    ],
)  # fmt: skip
def test_what_cannot_start_is_one_line(
    sessions: Callable[..., Any], wanted: dict[str, Any], message: str
) -> None:
    with pytest.raises(FlangeyeError) as caught:
        sessions(**wanted)
    assert str(caught.value) == message
    assert caught.value.exit_code == 2


def test_an_archive_for_a_recipe_that_simulates(
    sessions: Callable[..., Any], archives: Any
) -> None:
    with pytest.raises(BatchError) as caught:
        sessions(archives=(str(archives[0]),))
    assert str(caught.value) == (
        f"acquire.toy takes no archive, and {archives[0]} is given; leave it out"
    )


def test_more_seeds_than_anybody_runs(flangeye: Call) -> None:
    code, _, err = flangeye("batch", "ur5_phoxi-m_simulated", "--repeat", "9" * 20)
    assert (code, "less than or equal to 10000000" in err) == (2, True)


def test_the_same_archive_twice(
    sessions: Callable[..., Any], archive_recipe: Path, archives: Any
) -> None:
    with pytest.raises(BatchError, match="requested twice: /.*one.txt and /.*one.txt"):
        sessions(archive_recipe, archives=(str(archives[0]),) * 2)


def test_a_key_holds_all_that_decides_the_result(
    sessions: Callable[..., Any], recipe: Path, archive_recipe: Path, archives: Any
) -> None:
    def key(name=archive_recipe, archive=archives[0], **more):
        return sessions(name, archives=(str(archive),), **more)[0].key

    first = key()
    assert key() == first
    assert key(overrides=("steps.4.max_rms=2 mm",)) == first  # what it was anyway
    assert key(overrides=("steps.4.max_rms=3 mm",)) != first
    assert key(archive=archives[1]) != first
    assert key(software=Software("2", ("toy 1.0",))) != first
    assert key(software=Software("1", ("toy 1.1",))) != first
    archive_recipe.write_text(archive_recipe.read_text() + "\n# a comment\n")
    assert key() == first
    archives[0].write_text("7")
    assert key() != first


def test_large_files_are_known_by_size_and_time(
    sessions: Callable[..., Any], archive_recipe: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    large, small = folder / "large.bin", folder / "small.txt"
    large.write_bytes(bytes(70_000))
    small.write_text("a")

    def key():
        return sessions(archive_recipe, archives=(str(folder),))[0].key

    first = key()
    os.utime(small, ns=(1, 1))
    assert key() == first
    os.utime(large, ns=(1, 1))
    second = key()
    assert second != first
    small.rename(folder / "other.txt")
    assert key() != second


def test_files_that_the_recipe_names_count(sessions: Callable[..., Any], tmp_path: Path) -> None:
    first = sessions(overrides=("steps.3.reads=there",))[0].key
    (tmp_path / "there").write_text("now")
    assert sessions(overrides=("steps.3.reads=there",))[0].key != first


def test_a_thousand_seeds_are_planned_from_one_reading_of_the_recipe(
    sessions: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []

    def noted(*given):
        read.append(given)
        return load_recipe(*given)

    monkeypatch.setattr(batch_plan, "load_recipe", noted)
    found = sessions(grid=("steps.0.count=5,6",), repeat=1000)
    assert len(read) == 3 and len({s.key for s in found}) == 2000
    assert found[7].key == sessions(overrides=("seed=10", "steps.0.count=5"))[0].key


def test_code_that_changed_under_one_version_is_other_software(tmp_path: Path) -> None:
    package = tmp_path / "package"
    package.mkdir()
    module = package / "__init__.py"
    module.write_text("")
    (package / "part.py").write_text("A = 1")
    first = _code_of(str(module))
    _code_of.cache_clear()
    assert _code_of(str(module)) == first
    (package / "part.py").write_text("A = 2")
    _code_of.cache_clear()
    assert _code_of(str(module)) != first


@given(st.lists(st.text("ab1. {}[]", min_size=1).filter(str.strip), min_size=1))
def test_splitting_undoes_joining(values: Any) -> None:
    balanced = [v.strip() for v in values if _balanced(v)]
    assert split_values(",".join(balanced)) == (balanced or [""])


def _balanced(text):
    depth = 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        if depth < 0:
            return False
    return depth == 0


def test_commas_inside_brackets_and_quotes_belong_to_the_value() -> None:
    assert split_values("{a: {x: 1, y: 2}}, [1, 2] ,'c,d',\"e,'f\"") == [
        "{a: {x: 1, y: 2}}", "[1, 2]", "'c,d'", "\"e,'f\"",
    ]  # fmt: skip


def test_workers_must_have_the_same_software(registry: Any) -> None:
    here = software_of(registry)
    assert any(re.fullmatch(r"toy_batch 1.0 \(code \w{8}\)", each) for each in here.plugins)
    check_software(here, here, "host")
    for other, told in (
        (
            Software("9", here.plugins),
            f"flangeye {re.escape(here.flangeye)}, the batch was started with flang",
        ),
        (Software(here.flangeye, (*here.plugins, "zzz 1")), "plugins, the batch was started with"),
        (Software(here.flangeye, ("aaa 1", *here.plugins[1:])), "the batch was started with aaa 1"),
    ):
        with pytest.raises(StageError, match=told):
            check_software(other, here, "host")


def test_sessions_are_counted_without_being_made_and_made_again_alike(
    recipe: Path, registry: Any
) -> None:
    made = plan(Request(str(recipe), grid=("steps.0.count=5,6",), repeat=3), registry, SOFTWARE)
    assert len(made) == 6 and list(made) == list(made)
    assert made.values() == {"steps.0.count": ["5", "6"]}
    assert all(session.id.endswith(f"_{session.key[:16]}") for session in made)
    assert {session.number for session in made} == {session.key[:16] for session in made}
