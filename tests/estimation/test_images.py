"""Printed targets in rendered images, from the recipe of somebody who has never done this."""

from pathlib import Path

import pytest

from flangeye import StageError
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner

HAND = "camera: {position: [60 mm, 0 mm, 40 mm], rpy: [0 deg, 0 deg, 90 deg]}, resolution: 0.5"
CHARUCO = "fit.charuco: {columns: 7, rows: 5, square: 30 mm, marker: 22 mm}"


def run(tmp_path, acquire, fit, solve="solve.robust", scanner=""):
    """Run a recipe for an eye in the hand; return its result."""
    path = tmp_path / "recipe.yaml"
    path.write_text(
        f"title: T\nrobot: {{model: ur5}}\n{scanner}"
        "configuration: {name: eye-in-hand, place: unknown}\nsteps:\n"
        f"  - acquire.simulated_images: {{{acquire}}}\n  - {fit}\n  - {solve}\n"
    )
    registry = load_registry()
    runner = Runner(load_recipe(path, registry), registry, ArchivePath())
    return runner.run()


def reasons(result):
    """Return why captures were set aside."""
    return [each.reason for each in result.observations if not each.used]


@pytest.mark.parametrize(
    "turn", [90, 180, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (0, 270))]
)
def test_a_board_is_never_taken_for_itself_turned(tmp_path: Path, turn: int) -> None:
    seen = run(
        tmp_path,
        f"poses: 8, {HAND.replace('90 deg', f'{90 + turn} deg')}, covered: 0, board: checkerboard",
        "fit.checkerboard: {columns: 8, rows: 5, square: 25 mm}",
    )
    assert seen.truth.rms_over_workspace < 3e-3
    assert all(each.used for each in seen.observations)


def test_a_board_with_a_hand_before_it_is_found_by_what_is_left(tmp_path: Path) -> None:
    seen = run(tmp_path, f"poses: 10, {HAND}, covered: 1", CHARUCO)
    assert sum(each.used for each in seen.observations) >= 6
    assert seen.truth.rms_over_workspace < 3e-3


def test_a_covered_checkerboard_is_set_aside_and_never_taken_one_square_off(tmp_path: Path) -> None:
    seen = run(
        tmp_path,
        f"poses: 16, {HAND}, covered: 0.5, board: checkerboard",
        "fit.checkerboard: {columns: 8, rows: 5, square: 25 mm}",
    )
    assert 8 <= len(reasons(seen)) <= 10  # one or two are cut off by the image besides
    assert all("checkerboard" in r or "squares" in r for r in reasons(seen))


def test_a_board_of_more_squares_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        StageError, match=r"no capture can be used; .*4 were rejected by fit.checkerboard: "
    ):
        run(
            tmp_path,
            f"poses: 4, {HAND}, board: checkerboard, covered: 0",
            "fit.checkerboard: {columns: 7, rows: 4, square: 25 mm}",
        )


SMALL = "board: marker, covered: 0, spread: 9 deg"
OF_SMALL = "fit.aruco: {size: 100 mm, dictionary: APRILTAG_36h11, id: 7}"


def test_small_markers_seen_frontally_are_set_aside_for_their_second_pose(tmp_path: Path) -> None:
    seen = run(tmp_path, f"poses: 14, {HAND}, {SMALL}, distance: 1.6 m", OF_SMALL)
    aside = [reason for reason in reasons(seen) if "fit the corners alike" in reason]
    assert aside
    assert seen.truth.rms_over_workspace < 5 * seen.expected_error.rms


def test_with_depth_the_same_markers_have_one_pose(tmp_path: Path) -> None:
    seen = run(
        tmp_path,
        f"poses: 8, depth: true, resolution: 0.12, {SMALL}, distance: 600 mm, "
        "camera: {position: [60 mm, 0 mm, 40 mm]}",
        OF_SMALL,
        scanner="scanner: {model: phoxi-m}\n",
    )
    assert not any("alike" in reason for reason in reasons(seen))
    assert sum(each.used for each in seen.observations) >= 7


def test_a_print_of_another_size_is_named_by_the_arms_motion(tmp_path: Path) -> None:
    wrong = CHARUCO.replace("30 mm", "29.1 mm").replace("22 mm", "21.34 mm")
    seen = run(tmp_path, f"poses: 10, {HAND}", wrong)
    assert seen.refused.startswith("the arm's motion shows that the target is 1.0")
    factor = float(seen.refused.split("target is ")[1].split()[0])
    assert factor == pytest.approx(30 / 29.1, abs=2e-3)
    assert seen.refused.endswith("or the camera's focal length wrong by as much")
    assert seen.advice.startswith("measure the print (size_limit allows more")


def test_a_print_that_is_right_is_never_called_wrong(tmp_path: Path) -> None:
    assert run(tmp_path, f"poses: 10, {HAND}", CHARUCO).refused is None


def test_the_size_may_be_off_where_that_is_asked_for(tmp_path: Path) -> None:
    wrong = CHARUCO.replace("30 mm", "29.1 mm").replace("22 mm", "21.34 mm")
    seen = run(tmp_path, f"poses: 10, {HAND}", wrong, "solve.robust: {size_limit: 0.1}")
    assert seen.refused is None


def test_depth_without_a_scanner_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StageError) as refused:
        run(tmp_path, f"{HAND}, depth: true", CHARUCO)
    assert str(refused.value).endswith(
        "acquire.simulated_images: depth needs the recipe's 'scanner' section: {model: …}"
    )
