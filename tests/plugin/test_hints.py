"""What a signature says, evaluated when it is asked for."""

from __future__ import annotations

import pytest

from flangeye.plugin.hints import Hints

Word = str


def taken(word: Word, count: int, lost: Missing = None) -> Word:  # type: ignore[name-defined]  # noqa: F821
    return word * count


def test_each_is_evaluated_by_itself() -> None:
    hints = Hints(taken)
    assert list(hints) == ["word", "count", "lost", "return"] and len(hints) == 4
    assert hints["word"] is str and hints["count"] is int
    with pytest.raises(NameError, match="Missing"):
        hints["lost"]
    with pytest.raises(KeyError):
        hints["other"]


def test_what_is_taken_out_is_no_longer_there() -> None:
    hints = Hints(taken)
    assert hints.pop("return") is str and "return" not in hints
    assert hints.pop("return") is type(None)


def test_the_same_words_are_the_same_where_their_names_are() -> None:
    def other(word: Word, count: Word) -> None: ...

    def elsewhere(word: Word) -> None: ...

    foreign = Hints(elsewhere)
    foreign._names = {"Word": bytes}
    assert Hints(taken).says_as(Hints(other), "word")
    assert not Hints(taken).says_as(Hints(other), "count")
    assert not Hints(taken).says_as(foreign, "word")
