"""The README's console block is what the command prints, and its picture belongs to that block."""

import pytest
from PIL import Image

from tools.readme import PICTURE, README, STAMP, output_of, same, shown, stamp


def test_the_picture_was_made_with_the_console_block() -> None:
    (quote,) = shown().values()
    with Image.open(PICTURE) as picture:
        assert picture.info[STAMP] == stamp(quote), "python -m tools.readme renews both"


@pytest.mark.slow
def test_the_demo() -> None:
    ((command, quoted),) = shown().items()
    printed = output_of(command)
    assert same(quoted, printed), f"python -m tools.readme renews it; it printed:\n{printed}"


def test_the_readme_has_at_most_800_words() -> None:
    assert len(README.read_text().split()) <= 800


def test_a_changed_word_or_a_changed_figure_is_seen() -> None:
    quoted = "Held-out error     0.303 mm rms, 27 of 30 poses,  -148.2680 deg"
    assert same(quoted, "Held-out error     0.302 mm rms, 27 of 30 poses,  -148.2682 deg")
    assert not same(quoted, "Held-out error     0.323 mm rms, 27 of 30 poses,  -148.2680 deg")
    assert not same(quoted, "Held-out error     0.303 mm rms, 26 of 30 poses,  -148.2680 deg")
    assert not same(quoted, "Held-out error     0.303 mm p95, 27 of 30 poses,  -148.2680 deg")
