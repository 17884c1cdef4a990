"""Names belong together by what they share; where the sets differ, nothing is paired."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.files.scans import (
    PoseNames,
    in_order,
    natural,
    numbers_of,
    partners,
    scans_in,
    scans_of,
)
from flangeye.types import Warn


def test_names_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    names = [f"{k}.jpg" for k in np.random.default_rng(3).permutation(25)]
    assert sorted(names, key=natural) == [f"{k}.jpg" for k in range(25)]
    for name in names:
        (tmp_path / name).touch()
    assert [scan.stem for scan in scans_in(tmp_path)] == [str(k) for k in range(25)]


@pytest.mark.parametrize(
    ("poses", "others"),
    [
        ("pose_{}", "img_{:03}"),
        ("{}", "2026-11-25_cam0_{}"),
        ("rPe_{}_v2", "{:02}"),
        ("run_{0}_{0}", "a{0}b{0}"),
    ],
)
def test_partners_are_found_by_number(poses: str, others: str) -> None:
    numbers = range(2, 13)
    shuffled = np.random.default_rng(1).permutation(numbers).tolist()
    found, note = partners(
        "here", [poses.format(k) for k in numbers], [others.format(k) for k in shuffled]
    )
    assert [shuffled[i] for i in found] == list(numbers)
    assert note == (
        f"paired by number: {poses.format(2)} with {others.format(2)}, …, "
        f"{poses.format(12)} with {others.format(12)}"
    )


def test_a_name_in_common_comes_before_a_number() -> None:
    found, note = partners("here", ["left", "right"], ["right", "left"])
    assert found == [1, 0]
    assert note == "paired by name: left with left, …, right with right"


@pytest.mark.parametrize(
    ("poses", "others", "message"),
    [
        ("p1 p2 p3", "i0 i1 i2", "no partner for p3, and no partner for i0; rename or remove them"),
        ("p1 p2 p3", "i1 i3", "no partner for p2; rename or remove them"),
        ("p1 p01", "i1 i2", "no partner for i2; rename or remove them"),
        (
            "p1 p01",
            "i1 i01",
            "some have the same number; give each pair a name or number of its own",
        ),
        ("a b", "c d", "no partner for a, b, and no partner for c, d; rename or remove them"),
    ],
)
def test_sets_that_differ_are_refused(poses: str, others: str, message: str) -> None:
    with pytest.raises(StageError, match="^here: [0-9]+ poses") as error:
        partners("here", poses.split(), others.split())
    assert str(error.value).endswith(message)


def test_names_without_a_common_number_are_paired_in_order_with_a_warning(tmp_path: Path) -> None:
    place(tmp_path, *(f"frame_{k}.ply" for k in range(98, 103)))
    poses = PoseNames("p.csv", 5, names=[f"p{k}" for k in range(5)], ranked=True)
    found, (note,) = scans_of(tmp_path, poses)
    assert [at[0].stem for at in found] == [f"frame_{k}" for k in range(98, 103)]
    assert isinstance(note, Warn)
    assert note == (
        "poses and scans have no number in common, so they are paired in order: p0 with frame_98, "
        "…, p4 with frame_102"
    )
    with pytest.raises(StageError, match="differ in their numbers"):
        scans_of(tmp_path, replace(poses, ranked=False))


@pytest.mark.parametrize("first", [-1, 1, 4, 90])
def test_a_number_in_common_or_another_count_pairs_nothing_in_order(
    tmp_path: Path, first: int
) -> None:
    """One lost scan and one lost pose look alike: then no order is safe."""
    place(tmp_path, *(f"frame_{k}.ply" for k in range(abs(first), abs(first) + 5)))
    names = [f"p{k}" for k in range(4 if first == 90 else 5)]
    if first == -1:
        names = ["left", *names[1:]]
    with pytest.raises(StageError, match="differ in their numbers"):
        scans_of(tmp_path, PoseNames("p.csv", len(names), names=names, ranked=True))


def test_rows_without_names_say_with_what_they_were_paired() -> None:
    assert in_order("t.csv", 3, "poses", ["2.jpg", "9.jpg", "10.jpg"]).startswith(
        "poses without names are paired in order: row 1 with 2.jpg, …, row 3 with 10.jpg, without 3"
    )
    with pytest.raises(StageError, match="has 4 poses, but the folder has 3 scans, without 3, 4"):
        in_order("t.csv", 4, "poses", ["1.jpg", "2.jpg", "5.jpg"])


def test_numbers_that_all_names_share_tell_nothing() -> None:
    assert numbers_of(["cam0_07", "cam0_8"]) == [(7,), (8,)]
    assert numbers_of(["a", "b1"]) == [(), (1,)]
    assert numbers_of(["x1_2", "x2_1"]) == [(1, 2), (2, 1)]


def place(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_scans_are_found_beside_and_below_and_clouds_with_images(tmp_path: Path) -> None:
    numbers = range(8, 13)
    place(tmp_path, *(f"images/img_{k}.png" for k in numbers))
    place(tmp_path, *(f"clouds/c{k:04}.ply" for k in numbers))
    poses = PoseNames("poses/*.txt", 5, [], [f"pose_{k}" for k in numbers])
    found, notes = scans_of(tmp_path, poses)
    assert [[p.name for p in at] for at in found] == [
        [f"c{k:04}.ply", f"img_{k}.png"] for k in numbers
    ]
    assert len(notes) == 2
    place(tmp_path, *(f"drawn/out_{k}.png" for k in numbers))
    with pytest.raises(StageError, match=r"drawn/out_8.png and images/img_8.png could both"):
        scans_of(tmp_path, poses)


def test_a_cloud_and_an_image_of_one_number_lie_in_one_folder(tmp_path: Path) -> None:
    place(tmp_path, *(f"rgb_{k}.png" for k in range(9, 12)), *(f"xyz_{k}.pcd" for k in (9, 10, 11)))
    found, _ = scans_of(tmp_path, PoseNames("p.csv", 3))
    assert [[p.name for p in at] for at in found] == [
        [f"xyz_{k}.pcd", f"rgb_{k}.png"] for k in (9, 10, 11)
    ]
