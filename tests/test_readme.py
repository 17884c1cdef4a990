"""The outputs in the README are what the commands print, to the digits that travel."""

from pathlib import Path

import pytest

from tools.readme import output_of, same, shown


def test_the_real_recordings(ancorasir: Path) -> None:
    (command,) = [c for c in shown() if "aubo" in c]
    quoted, printed = shown()[command], output_of(command)
    assert same(quoted, printed), f"python -m tools.readme renews it; it printed:\n{printed}"


@pytest.mark.slow
def test_the_demo() -> None:
    (command,) = [c for c in shown() if "simulated" in c]
    quoted, printed = shown()[command], output_of(command)
    assert same(quoted, printed), f"python -m tools.readme renews it; it printed:\n{printed}"


def test_a_changed_word_or_a_changed_figure_is_seen() -> None:
    quoted = "held-out error     0.303 mm rms, 27 of 30 poses,  -148.2680 deg"
    assert same(quoted, "held-out error     0.302 mm rms, 27 of 30 poses,  -148.2682 deg")
    assert not same(quoted, "held-out error     0.323 mm rms, 27 of 30 poses,  -148.2680 deg")
    assert not same(quoted, "held-out error     0.303 mm rms, 26 of 30 poses,  -148.2680 deg")
    assert not same(quoted, "held-out error     0.303 mm p95, 27 of 30 poses,  -148.2680 deg")
