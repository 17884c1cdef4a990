"""Two arms in a folder: each pose names where the second one was, in its own base."""

import csv
import json

import numpy as np

from flangeye.types import ArchivePath
from flangeye_plugins.acquisition.archive import ArchiveParams, acquire_archive
from flangeye_plugins.readers.auto import auto

SECOND = {"position": [500.0, -20.0, 300.0], "rotation_vector_rad": [0.1, 0.0, 0.2]}


def as_json(archive, second):
    """Turn poses.csv into poses.json, with a second arm that moves along x."""
    with (archive / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    poses = [
        {
            "cloud": row["cloud"],
            "position": [float(row[f"{axis}_m"]) * 1e3 for axis in "xyz"],
            "quaternion_xyzw": [float(row[f"q{axis}"]) for axis in "xyzw"],
            "second": {**second, "position": [500.0 + i, -20.0, 300.0]},
        }
        for i, row in enumerate(rows)
    ]
    (archive / "poses.csv").unlink()
    (archive / "poses.json").write_text(json.dumps({"unit": "mm", "poses": poses}))


def test_every_capture_says_where_the_second_arm_was(archive, scanner):
    as_json(archive, SECOND)
    params = ArchiveParams(reader=auto.bind())
    captures = list(acquire_archive(scanner, ArchivePath(archive), params))
    assert len(captures) == 5
    for capture in captures:
        assert capture.base2_T_flange2.name == "base2_T_flange2"
    places = sorted(capture.base2_T_flange2.translation[0] for capture in captures)
    assert np.allclose(places, [0.5, 0.501, 0.502, 0.503, 0.504])
