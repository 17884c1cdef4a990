"""Two thousand spoilt inputs: each is read, or refused in one line."""

import random
import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.damage import NASTY, damaged, spoilt
from tests.fuzz.strategies import STRATEGIES
from tests.fuzz.targets import SEEDS, TARGETS, survives

CASES = 50
"""For each of the targets; ``python -m tools.fuzz`` does as many as one likes."""


@pytest.mark.parametrize("name", TARGETS)
def test_spoilt_input_is_read_or_refused(name: Any, tmp_path: Path) -> None:
    target, chance = TARGETS[name], random.Random(name)
    sound = target.seeds(tmp_path)
    for number in range(CASES):
        path = tmp_path / f"{number}{target.suffix}"
        path.write_bytes(damaged(chance.choice(sound), target.suffix, chance))
        survives(target, path)
        path.unlink()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2_000_000  # kB


@pytest.mark.parametrize("name", TARGETS)
def test_sound_seeds_are_read_and_texts_of_old_refused_or_read(name: Any, tmp_path: Path) -> None:
    target = TARGETS[name]
    sound = target.seeds(tmp_path)
    for number, raw in enumerate([*sound, *NASTY]):
        path = tmp_path / f"{number}{target.suffix}"
        path.write_bytes(raw)
        assert (
            survives(target, path)
            or number >= len(sound)
            or name in ("poses", "records", "table", "request", "url", "batch", "name")
        ), raw[:80]


@pytest.mark.parametrize("name", STRATEGIES)
def test_made_input_is_read_or_refused(name: Any, tmp_path: Path) -> None:
    target, path = TARGETS[name], tmp_path / f"made{TARGETS[name].suffix}"

    @settings(suppress_health_check=list(HealthCheck), database=None)
    @given(STRATEGIES[name])
    def reads(raw):
        path.write_bytes(raw)
        survives(target, path)

    reads()


FOUND = sorted(SEEDS.glob("*/*")) if SEEDS.is_dir() else []


@pytest.mark.parametrize("find", FOUND, ids=lambda p: f"{p.parent.name}-{p.name}")
def test_what_was_once_found_stays_mended(find: Any, tmp_path: Path) -> None:
    target = TARGETS[find.parent.name]
    target.seeds(tmp_path)
    path = tmp_path / f"find{target.suffix}"
    path.write_bytes(find.read_bytes())
    survives(target, path)


def test_the_damage_is_worth_its_name(tmp_path: Path) -> None:
    chance = random.Random(0)
    raw = bytes(range(200))
    changed = {spoilt(raw, chance) for _ in range(100)}
    assert len(changed) > 90
    assert raw not in changed
