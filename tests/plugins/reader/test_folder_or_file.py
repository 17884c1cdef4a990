"""A folder given where a file is meant, and the reverse: each reader says so, in one line."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from flangeye.errors import FlangeyeError
from flangeye.plugin.registry import load_registry

REGISTRY = load_registry()
ENDINGS = ("", ".csv", ".yaml", ".json", ".mcap", ".db3", ".npy", ".npz", ".ply", ".png")


def readers():
    """The readers that need no parameters."""
    for name in REGISTRY.parts:
        if name.startswith("reader."):
            part = REGISTRY.part(name)
            try:
                yield name, part.bind()
            except ValidationError:
                continue


@pytest.mark.parametrize("read", [pytest.param(read, id=name) for name, read in readers()])
def test_what_is_of_the_wrong_kind_is_refused_in_one_line(read: Any, tmp_path: Path) -> None:
    for ending in ENDINGS:
        folder, inside, file = (
            tmp_path / f"d{ending}",
            tmp_path / f"in{ending}",
            tmp_path / f"f{ending}",
        )
        folder.mkdir()
        (inside / f"x{ending or '.pcd'}").mkdir(parents=True)
        file.write_bytes(b"x\n")
        for path in (folder, inside, file):
            with pytest.raises(FlangeyeError) as refused:
                read(path)
            assert "\n" not in str(refused.value)
