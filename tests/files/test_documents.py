"""Arrays of poses in other programs' files: what damages their parsers does not damage us."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from flangeye.errors import StageError
from flangeye.files.tables import document_of

POSES = np.tile(np.eye(4), (5, 1, 1))


def arrays_of(file: Path) -> Any:
    document = document_of(file)
    assert document is not None
    return document.data


def refusal(file: Path) -> str:
    with pytest.raises(StageError) as refused:
        arrays_of(file)
    assert "\n" not in str(refused.value)
    return str(refused.value).removeprefix(f"{file}: ")


def test_a_mat_file_that_crashes_its_parser(tmp_path: Path) -> None:
    file = tmp_path / "poses.mat"
    savemat(file, {"robot": POSES})
    content = bytearray(file.read_bytes())
    content[180] = 127  # what kind of numbers the matrix has: scipy ends by a signal
    file.write_bytes(content)
    assert refusal(file) == "cannot be read: it is damaged, its parser crashed"


def test_what_a_parser_quotes_of_a_file_is_short_and_plain(tmp_path: Path) -> None:
    file = tmp_path / "poses.mat"
    savemat(file, {"robot": POSES[0]}, format="4")
    content = bytearray(file.read_bytes())
    content[16:20] = (30).to_bytes(4, "little")  # the name is longer, and what follows too short
    content[20:30] = b"\x1b[31m\nred\x07"
    file.write_bytes(content)
    text = refusal(file)
    assert text.startswith("cannot be read: Not enough bytes to read matrix")
    assert len(text) < 200 and "\x1b" not in text


def test_names_and_numbers_of_a_mat_file(tmp_path: Path) -> None:
    file = tmp_path / "poses.mat"
    savemat(file, {"file": POSES, "count": np.uint8(5), "text": "no numbers"})
    found = arrays_of(file)
    assert set(found) == {"file", "count"}
    assert np.array_equal(found["file"], POSES)


YAML = "%YAML:1.0\n---\nT_0: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: [ 1., 2., {} ]\n"


def test_opencvs_yaml(tmp_path: Path) -> None:
    file = tmp_path / "pairs.yml"
    file.write_text(YAML.format("3.,\n       4.e+00") + "count: 1\n")
    assert np.array_equal(arrays_of(file)["T_0"], [[1, 2], [3, 4]])
    file.write_text(YAML.format("3."))
    assert refusal(file) == "cannot be read: cannot reshape array of size 3 into shape (2,2)"


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencvs_matrices_of_several_channels(tmp_path: Path, suffix: str) -> None:
    """A stack of poses, or of vectors, is a matrix of several channels to OpenCV."""
    stacks = {
        "robot": np.arange(80.0).reshape(5, 4, 4),
        "rvecs": np.arange(15.0).reshape(5, 1, 3),
        "T_0": np.eye(4),
    }
    storage = cv2.FileStorage(str(tmp_path / f"data{suffix}"), cv2.FILE_STORAGE_WRITE)
    for name, stack in stacks.items():
        storage.write(name, stack)
    storage.release()
    found = arrays_of(tmp_path / f"data{suffix}")
    assert found.keys() == stacks.keys()
    assert all(np.array_equal(found[name], stack) for name, stack in stacks.items())


@pytest.mark.parametrize("head", [b"MATLAB 7.3 MAT-file, Platform: GLNXA64", b"\x89HDF\r\n\x1a\n"])
def test_a_mat_file_of_matlab_7_3_says_what_to_do(tmp_path: Path, head: bytes) -> None:
    file = tmp_path / "poses.mat"
    file.write_bytes(head.ljust(512, b" ") + b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert refusal(file) == (
        "is a MATLAB 7.3 file (HDF5), which is not read; in MATLAB, write it anew: "
        "load('poses.mat'); save('poses.mat', '-v7')"
    )
