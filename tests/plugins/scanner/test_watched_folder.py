"""Files as scanners' software leaves them: at once, in parts, renamed, overwritten, out of time."""

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from flangeye.devices import DeviceError, Scanner
from flangeye.errors import StageError
from flangeye.files.clouds import write_cloud
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, PointCloud
from flangeye.units import SI
from flangeye_plugins.scanner.watched_folder import (
    WatchedFolderParams,
    scanner_watched_folder,
)

PHOXI = load_model("scanners", "phoxi-m")


def cloud(mark=0.0):
    """A small organised cloud 0.7 m away; its first x tells it from others [m]."""
    xyz = np.full((4, 5, 3), 0.7, np.float32)
    xyz[0, 0, 0] = mark
    return PointCloud(CAMERA, xyz)


def content(tmp_path, mark, unit="mm"):
    """The bytes of a file with such a cloud."""
    path = tmp_path / "made.pcd"
    write_cloud(path, cloud(mark), unit)
    return path.read_bytes()


def watch(folder, model=PHOXI, **changes):
    plain = {"unit": "mm", "settle": SI(0.15), "timeout": SI(10.0)}
    return scanner_watched_folder(model, WatchedFolderParams(path=folder, **plain | changes))


def mark_of(scan):
    return float(scan.cloud.xyz[0, 0, 0])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "exports"
    path.mkdir()
    return path


def later(seconds, action, *arguments):
    timer = threading.Timer(seconds, action, arguments)
    timer.start()
    return timer


def test_each_new_file_is_a_scan_in_metres_and_old_ones_are_left(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "old.pcd").write_bytes(content(tmp_path, 0.9))
    with watch(folder) as scanner:
        assert isinstance(scanner, Scanner)
        before = time.monotonic_ns()
        timer = later(0.3, (folder / "new.pcd").write_bytes, content(tmp_path, 0.1))
        scan = scanner.expose()()
        timer.join()
    assert capsys.readouterr().err == f"Scan now, and export the cloud into {folder}\n"
    assert mark_of(scan) == pytest.approx(0.1)
    assert scan.cloud.xyz.shape == (4, 5, 3)
    assert scan.cloud.xyz[1, 1, 2] == np.float32(0.7)
    assert scan.started_ns >= before - 1e9
    assert scan.started_ns < scan.ended_ns <= time.monotonic_ns()


def test_files_are_taken_in_the_order_of_their_count(folder: Path, tmp_path: Path) -> None:
    with watch(folder) as scanner:
        for count in (10, 9, 11):
            (folder / f"scan_{count}.pcd").write_bytes(content(tmp_path, count / 100))
        marks = [mark_of(scanner.expose()()) for _ in range(3)]
    assert marks == pytest.approx([0.09, 0.10, 0.11])


def test_a_file_that_came_while_the_arm_moved_says_so(folder: Path, tmp_path: Path) -> None:
    """Its exposure may have begun as early as the folder was last looked at."""
    with watch(folder) as scanner:
        (folder / "1.pcd").write_bytes(content(tmp_path, 0.1))
        scanner.expose()()
        looked = time.monotonic_ns()
        (folder / "2.pcd").write_bytes(content(tmp_path, 0.2))
        time.sleep(0.3)
        arrived = time.monotonic_ns()
        scan = scanner.expose()()
    assert scan.started_ns <= looked < arrived


def test_a_file_that_is_written_slowly_is_waited_for(folder: Path, tmp_path: Path) -> None:
    whole = content(tmp_path, 0.3)

    def write():
        with (folder / "slow.pcd").open("wb") as file:
            for byte in range(0, len(whole), 60):
                file.write(whole[byte : byte + 60])
                file.flush()
                time.sleep(0.1)

    with watch(folder) as scanner:
        timer = later(0.0, write)
        scan = scanner.expose()()
        assert not timer.is_alive()
    assert mark_of(scan) == pytest.approx(0.3)


def test_a_pause_in_the_writing_is_not_taken_for_its_end(folder: Path, tmp_path: Path) -> None:
    whole = content(tmp_path, 0.4)
    (half, rest), path = (whole[:-50], whole[-50:]), folder / "pause.pcd"
    with watch(folder, settle=SI(0.0)) as scanner:
        path.write_bytes(half)

        def finish():
            with path.open("ab") as file:
                file.write(rest)

        timer = later(0.8, finish)
        scan = scanner.expose()()
        timer.join()
    assert mark_of(scan) == pytest.approx(0.4)


def test_a_later_file_waits_for_one_that_is_not_whole(folder: Path, tmp_path: Path) -> None:
    first, second = content(tmp_path, 0.5), content(tmp_path, 0.6)
    with watch(folder) as scanner:
        (folder / "1.pcd").write_bytes(first[:-20])
        (folder / "2.pcd").write_bytes(second)
        timer = later(0.8, (folder / "1.pcd").write_bytes, first)
        marks = [mark_of(scanner.expose()()) for _ in range(2)]
        timer.join()
    assert marks == pytest.approx([0.5, 0.6])


def test_a_rename_into_place_is_seen_once_and_hidden_names_never(
    folder: Path, tmp_path: Path
) -> None:
    with watch(folder) as scanner:
        for name in (".part.pcd", "~lock.pcd", "part.tmp"):
            (folder / name).write_bytes(content(tmp_path, 0.9))
        timer = later(0.3, os.replace, folder / "part.tmp", folder / "done.pcd")
        assert mark_of(scanner.expose()()) == pytest.approx(0.9)
        timer.join()
    with watch(folder, timeout=SI(0.4)) as scanner, pytest.raises(DeviceError):
        scanner.expose()


@pytest.mark.parametrize("moment", [0, 2_000_000_000, 4_000_000_000])
def test_times_that_a_server_makes_up_do_not_matter(
    folder: Path, tmp_path: Path, moment: int
) -> None:
    with watch(folder) as scanner:
        for mark in (0.1, 0.2):  # overwritten: the same name again
            (folder / "made.tmp").write_bytes(content(tmp_path, mark))
            os.utime(folder / "made.tmp", (moment, moment))
            (folder / "made.tmp").replace(folder / "scan.pcd")
            assert mark_of(scanner.expose()()) == pytest.approx(mark)


def test_a_pattern_chooses_among_names(folder: Path, tmp_path: Path) -> None:
    with watch(folder, pattern="scan_*.pcd") as scanner:
        (folder / "other.pcd").write_bytes(content(tmp_path, 0.9))
        (folder / "scan_1.pcd").write_bytes(content(tmp_path, 0.1))
        assert mark_of(scanner.expose()()) == pytest.approx(0.1)


def test_nothing_new_in_time_is_said(folder: Path) -> None:
    with watch(folder, timeout=SI(0.2)) as scanner, pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == (
        f"folder {folder}: no whole new cloud within 0.2 s; looked for * (.asc, .csv, .npy, .npz, "
        ".pcd, .ply, .pts, .txt, .xyz)"
    )


def test_a_file_that_never_becomes_whole_is_said(folder: Path, tmp_path: Path) -> None:
    with watch(folder, timeout=SI(0.6)) as scanner:
        (folder / "torn.pcd").write_bytes(content(tmp_path, 0.1)[:-10])
        with pytest.raises(DeviceError) as error:
            scanner.expose()
    assert str(error.value).startswith(
        f"folder {folder}: no whole new cloud within 0.6 s: {folder / 'torn.pcd'}: "
    )
    assert "\n" not in str(error.value)


def test_a_wrong_unit_is_said(folder: Path, tmp_path: Path) -> None:
    with watch(folder) as scanner:
        (folder / "metres.pcd").write_bytes(content(tmp_path, 0.1, "m"))
        with pytest.raises(StageError) as error:
            scanner.expose()()
    assert str(error.value) == (
        f"{folder / 'metres.pcd'}: median distance 0.00121 m with unit mm, but phoxi-m sees 0.458 "
        "to 1.118 m; these look like metres: set unit: m"
    )


def test_a_folder_that_is_missing_lost_or_closed_to_us_is_said(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = tmp_path / "nowhere"
    with pytest.raises(DeviceError) as error:
        watch(missing)
    assert str(error.value) == f"scanner.watched_folder: no folder {missing}"
    with watch(folder) as scanner:
        folder.rmdir()
        with pytest.raises(DeviceError) as error:
            scanner.expose()
    assert str(error.value) == f"scanner.watched_folder: no folder {folder}"
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(DeviceError) as error:
        watch(file)
    assert str(error.value) == f"scanner.watched_folder: {file} cannot be read (Not a directory)"


def test_closing_ends_the_wait(folder: Path) -> None:
    scanner = watch(folder)
    timer = later(0.2, scanner.close)
    began = time.monotonic()
    with pytest.raises(DeviceError, match="is closed"):
        scanner.expose()
    timer.join()
    scanner.close()
    assert time.monotonic() - began < 5
