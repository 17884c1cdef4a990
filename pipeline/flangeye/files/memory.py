"""Answers kept in the user's cache, each under a key of everything that it follows from."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

from flangeye.errors import StageError
from flangeye.files.written import write_whole

MOST = 100
"""Answers of a sort that are kept."""


def recall(sort: str, key: str) -> str | None:
    """Return the answer kept under a key, None where there is none or the memory is damaged."""
    answer = _kept(sort).get(key)
    return answer if isinstance(answer, str) else None


def keep(sort: str, key: str, answer: str, most: int = MOST) -> None:
    """Keep an answer; a cache that cannot be written costs a second look, no more.

    Args:
        sort: What is answered: the name of the file.
        key: A digest of all that the answer follows from.
        answer: The answer.
        most: How many answers of the sort are kept; the oldest is forgotten for a new one.
    """
    kept = _kept(sort)
    kept.pop(key, None)
    newest = [*kept.items(), (key, answer)][-most:]
    with suppress(StageError):
        write_whole(_place(sort), json.dumps(dict(newest)))


def _kept(sort: str) -> dict[str, object]:
    with suppress(OSError, ValueError, RecursionError):
        kept = json.loads(_place(sort).read_text(encoding="utf-8"))
        if isinstance(kept, dict):
            return kept
    return {}


def _place(sort: str) -> Path:
    return user_cache_path("flangeye") / f"{sort}.json"
