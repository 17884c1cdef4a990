"""A finger's calibration, a pivot and a tag's pose, from readings that are made up: no images."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import SensorFrame
from flangeye.errors import StageError
from flangeye.types import Floats, Image
from flangeye.types.geometry import nearest_rotation, rigid, rotation_exp
from flangeye_plugins.weld.finger_camera import FingerReader
from flangeye_plugins.weld.touch.calibration import HeldReading, calibrate
from flangeye_plugins.weld.touch.pivot import pivot
from flangeye_plugins.weld.touch.tag_observation import TagDetector, TagReading
from flangeye_plugins.weld.touch.tip_displacement import Interpreter
from tests.plugins.weld.bench import refused
from tests.plugins.weld.cell import FINGER

GAIN = np.array([[1.2, 0.1, 0.0], [-0.1, 1.1, 0.05], [0.0, 0.1, 1.4]])
REST = np.array([1e-3, -2e-3, 30e-3])


def reading(place: Any, turn: Any = (0.0, 0.0, 0.1)) -> TagReading:
    return TagReading(np.array(place), np.array(turn), np.eye(3) * 1e-10, 1.0, np.zeros((4, 2)))


def held(tip: Any, off: Any = (0.0, 0.0, 0.0), force: Any = None) -> HeldReading:
    """A reading of a tip that is displaced so, but for what it is off by [m, N]."""
    tip = np.array(tip)
    tag = REST + np.linalg.solve(GAIN, tip - off)
    return HeldReading(reading(tag), tip, None if force is None else np.array(force))


def moves(size: float = 2e-3, up: float = 2e-3) -> list[Floats]:
    axes = np.eye(3) * [size, size, up]
    return [sign * axis for axis in axes for sign in (1.0, -1.0, 0.5, -0.5)]


RESTS = [reading(REST + [x, 0.0, 0.0], (0.0, 0.0, 0.1 + 100 * x)) for x in
         1e-5 * np.tile([1.0, -1.0, 2.0, -2.0, 0.0], 2)]  # fmt: skip


def test_the_tip_goes_by_the_gain_of_what_the_tag_does_from_its_mean_rest() -> None:
    found = calibrate(RESTS, [held(tip) for tip in moves()], "a test")
    assert np.array(found.gain) == pytest.approx(GAIN)
    assert np.array(found.rest) == pytest.approx(REST)
    assert np.array(found.rotation) == pytest.approx([0.0, 0.0, 0.1], abs=1e-6)
    scatter = np.std(1e-5 * np.array([1.0, -1.0, 2.0, -2.0, 0.0]))
    assert np.array(found.noise) == pytest.approx(np.abs(GAIN[:, 0]) * scatter, abs=1e-12)
    assert found.lateral is None and found.axial is None and found.source == "a test"


def test_ten_readings_at_rest_and_ten_held_are_needed() -> None:
    some = [held(tip) for tip in moves()]
    calibrate(RESTS[:10], some[:10] + some[8:], "")
    for rest, count in ((9, 12), (10, 9)):
        with pytest.raises(StageError, match=f"seen {rest} times at rest and {count} times held"):
            calibrate(RESTS[:rest], some[-count:], "")
    calibrate(RESTS, some[-10:], "")


@pytest.mark.parametrize(
    ("left", "told"),
    [(0.19e-3, None), (0.22e-3, "0.2[012] mm of the tip's motion unexplained, at")],
)
def test_a_tip_stays_in_its_mark_to_two_tenths(left: float, told: str | None) -> None:
    """The rms of what no gain explains; off to one side and the other at the same place."""
    some = [held(tip, (0.0, sign * left, 0.0)) for tip in moves() for sign in (1.0, -1.0)]
    with refused(told):
        calibrate(RESTS, some, "")


@pytest.mark.parametrize(
    ("up", "told"), [(0.21e-3, None), (0.19e-3, "did not move the finger along all three axes")]
)
def test_a_finger_is_moved_along_each_axis_by_a_tenth_of_the_others(
    up: float, told: str | None
) -> None:
    with refused(told):
        calibrate(RESTS, [held(tip) for tip in moves(2e-3, up)], "")


def test_stiffness_is_force_over_displacement_and_half_a_newton_says_some() -> None:
    """Across it is the mean of both axes; what the sensor shows at rest counts nothing."""
    stiff, bias = np.array([900.0, 1100.0, 2500.0]), np.array([3.0, -4.0, 5.0])
    some = [held(tip, force=bias - stiff * tip) for tip in moves()]
    aside = [np.array([1e-3, 0.6e-3, -0.8e-3]) + tip for tip in moves()]
    uneven = calibrate(RESTS, [held(tip, force=bias - stiff * tip) for tip in aside], "")
    assert (uneven.lateral, uneven.axial) == pytest.approx((1000.0, 2500.0))
    found = calibrate(RESTS, some, "")
    assert (found.lateral, found.axial) == pytest.approx((1000.0, 2500.0))
    for most, known in ((0.49, False), (0.51, True)):
        weak = [held(tip, force=-tip * most / 2e-3) for tip in moves()]
        found = calibrate(RESTS, weak, "")
        assert (found.lateral is not None) == known == (found.axial is not None)
    mixed = [*some, held([0.0, 0.0, 1e-3])]  # one without a force says nothing of it
    assert calibrate(RESTS, mixed, "").axial == pytest.approx(2500.0)


def test_a_displacement_is_the_gain_s_and_its_covariance_too() -> None:
    calibration = calibrate(RESTS, [held(tip) for tip in moves()], "a test")
    interpreter = Interpreter(FINGER.model_copy(update={"calibration": calibration}))
    tip = np.array([1e-3, -2e-3, 0.5e-3])
    found = interpreter.feel(held(tip).reading, 7)
    assert found.displacement == pytest.approx(tip) and found.time_ns == 7
    assert found.covariance == pytest.approx(GAIN @ GAIN.T * 1e-10)
    assert found.rotation == pytest.approx(np.zeros(3), abs=1e-6)
    mirrored = nearest_rotation(np.diag([1.0, 1.0, -0.2]))
    assert np.linalg.det(mirrored) == pytest.approx(1.0)
    turn = rotation_exp(np.array([0.1, 0.2, 0.3]))
    assert nearest_rotation(turn @ np.diag([2.0, 1.0, 0.5])) == pytest.approx(turn)


# --- pivots ---------------------------------------------------------------------------------------

POINT, MARK = np.array([2e-3, -1e-3, 180e-3]), np.array([0.5, 0.1, 0.2])


def turned_by(degrees: float, count: int = 8) -> list[Floats]:
    """Turns about axes all round the flange's x and y, by so much each."""
    ways = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return [rotation_exp(np.radians(degrees) * np.array([np.cos(a), np.sin(a), 0.0])) for a in ways]


def poses(turns: list[Floats], off: Any = None) -> list[Floats]:
    shifts = np.zeros((len(turns), 3)) if off is None else off
    return [rigid(r, MARK - r @ POINT + o) for r, o in zip(turns, shifts, strict=True)]


def test_a_pivot_s_rms_and_covariance_are_those_of_least_squares() -> None:
    rng, turns = np.random.default_rng(0), turned_by(25.0)
    off = 0.2e-3 * rng.standard_normal((8, 3))
    found = pivot("tip", poses(turns, off))
    rows = np.hstack([np.vstack(turns), np.tile(-np.eye(3), (8, 1))])
    said = -np.concatenate([p[:3, 3] for p in poses(turns, off)])
    solved, left, *_ = np.linalg.lstsq(rows, said, rcond=None)
    rms = np.sqrt(left[0] / (24 - 6))
    assert found.point == pytest.approx(solved[:3]) and found.mark == pytest.approx(solved[3:])
    assert found.rms == pytest.approx(rms)
    assert found.covariance == pytest.approx(rms**2 * np.linalg.inv(rows.T @ rows)[:3, :3])
    # Nobody brings a point to its mark better than 0.05 mm.
    exact = pivot("tip", poses(turns))
    assert exact.covariance == pytest.approx((0.05e-3 / rms) ** 2 * found.covariance)
    assert exact.rms < 1e-9


def test_a_finger_s_displacement_is_taken_off_a_pivot() -> None:
    turns = turned_by(25.0)
    moved = 1e-3 * np.random.default_rng(1).standard_normal((8, 3))
    off = [-r @ d for r, d in zip(turns, moved, strict=True)]
    found = pivot("tip", poses(turns, off), list(moved))
    assert found.point == pytest.approx(POINT) and found.mark == pytest.approx(MARK)


def test_five_poses_are_needed_and_a_turn_of_twelve_degrees_about_two_axes() -> None:
    pivot("tip", poses(turned_by(25.0, 5)))
    with pytest.raises(StageError, match="4 poses, at least 5 are needed"):
        pivot("tip", poses(turned_by(25.0, 4)))
    # About axes all round, each direction across is turned by the root of a half of that.
    just = np.degrees(np.arcsin(np.sin(np.radians(12.0)) * np.sqrt(2.0)))
    pivot("tip", poses(turned_by(1.03 * just)))
    with pytest.raises(StageError, match="tilt it about"):
        pivot("tip", poses(turned_by(0.95 * just)))
    with pytest.raises(StageError, match="each to both sides, by 18 deg or more"):
        pivot("tip", poses(turned_by(5.0)))


@pytest.mark.parametrize(
    ("off", "told"), [(0.9, None), (1.15, r"in pose 5 it was 1\.1\d mm away .* limit 1 mm; did")]
)
def test_a_pose_that_is_off_by_a_millimetre_was_not_at_the_mark(
    off: float, told: str | None
) -> None:
    turns = turned_by(25.0)
    left = np.zeros((8, 3))
    left[4] = [0.0, 0.0, 1e-3]
    # What least squares leaves of it in that pose; so much more is put in.
    rows = np.hstack([np.vstack(turns), np.tile(-np.eye(3), (8, 1))])
    hat = rows @ np.linalg.pinv(rows)
    stays = np.linalg.norm((np.eye(24) - hat)[12:15] @ left.ravel())
    with refused(told):
        pivot("tip", poses(turns, left * off * 1e-3 / stays))


# --- the tag's pose -------------------------------------------------------------------------------

MATRIX = np.array([[400.0, 0, 160.0], [0, 400.0, 120.0], [0, 0, 1.0]])


def seen_from(rotation: Any, translation: Any) -> Floats:
    side = FINGER.tag.side / 2
    square = side * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    there = square @ rotation_exp(np.array(rotation)).T + translation
    pixels = there @ MATRIX.T
    return pixels[:, :2] / pixels[:, 2:]


TURN, PLACE = (3.0, 0.1, 0.05), np.array([0.5e-3, -0.3e-3, 30e-3])


def posed(corners: Floats, detector: Any = None) -> Any:
    return (detector or TagDetector(FINGER))._pose(corners, MATRIX, np.zeros(5))


def test_a_tag_s_pose_is_that_of_its_corners() -> None:
    exact = posed(seen_from(TURN, PLACE))
    assert exact.translation == pytest.approx(PLACE, abs=1e-7)
    assert rotation_exp(exact.rotation) == pytest.approx(rotation_exp(np.array(TURN)), abs=1e-4)
    assert exact.confidence == pytest.approx(1.0, abs=1e-3)


def test_corners_that_are_off_by_a_pixel_are_worth_nothing() -> None:
    """By a pattern that no pose explains in full: its rms is what is left."""
    corners, odd = seen_from(TURN, PLACE), np.array([[1.0, 0], [-1, 0], [1, 0], [-1, 0]])
    worth = [posed(corners + size * odd).confidence for size in (0.0, 0.3, 0.6, 3.0)]
    assert worth[0] > worth[1] > worth[2] > worth[3] == 0.0
    assert 1 - worth[2] == pytest.approx(2 * (1 - worth[1]), rel=0.05)
    found = posed(corners + 0.6 * odd)
    left = seen_from(found.rotation, found.translation) - (corners + 0.6 * odd)
    assert 1 - found.confidence == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-3)


def test_a_tag_s_covariance_is_that_of_corners_that_scatter_by_a_tenth_of_a_pixel() -> None:
    corners, rng = seen_from(TURN, PLACE), np.random.default_rng(0)
    detector = TagDetector(FINGER)
    places = list[Floats]()
    for _ in range(300):
        detector._last = None if not places else detector._last
        places.append(posed(corners + 0.1 * rng.standard_normal((4, 2)), detector).translation)
    sigma = np.sqrt(np.diag(posed(corners).covariance))
    assert np.std(places, axis=0) == pytest.approx(sigma, rel=0.15)
    rough = posed(corners + 0.6 * np.array([[1.0, 0], [-1, 0], [1, 0], [-1, 0]]))
    error = 1 - rough.confidence
    assert np.sqrt(np.diag(rough.covariance)) == pytest.approx(sigma * error / 0.1, rel=0.1)


class Shown:
    """Shows tags of such numbers, each somewhere else."""

    def __init__(self, ids: list[int] | None) -> None:
        self.ids = ids
        four = np.arange(8.0).reshape(1, 4, 2)
        self.corners = [four + 10 * i for i in range(len(ids or []))]

    def tags(self, grey: Any) -> Any:
        return self.corners, None if self.ids is None else np.array(self.ids), None


@pytest.mark.parametrize(
    ("ids", "found"), [([7], 0), ([3, 7], 1), ([7, 7], None), ([3], None), (None, None)]
)
def test_one_tag_and_no_other_is_taken_for_the_finger_s(
    ids: list[int] | None, found: int | None
) -> None:
    detector: Any = TagDetector(FINGER)
    shown = Shown(ids)
    detector._detector = SimpleNamespace(detectMarkers=shown.tags)
    image = Image(np.zeros((20, 30), np.uint8), MATRIX)
    corners = detector._corners(image.pixels)
    if found is None:
        assert corners is None and detector.find(image) is None
    else:
        assert corners == pytest.approx(shown.corners[found][0])


def test_a_tag_that_is_seen_with_three_tenths_of_confidence_is_felt() -> None:
    """Its corners are then off by 0.7 px at most; what is worth less is not a touch."""
    image, corners = Image(np.zeros((60, 90), np.uint8), MATRIX), np.full((4, 2), 30.0)
    for confidence, felt in ((0.29, False), (0.3, True), (0.31, True)):
        reader: Any = FingerReader(FINGER)
        seen = TagReading(REST, np.zeros(3), np.eye(3), confidence, corners)
        reader._detector = SimpleNamespace(find=lambda piece, seen=seen: seen)
        found = reader.read(SensorFrame(image, 5))
        assert (found.feeling is not None) == felt and found.time_ns == 5
        assert reader.read(SensorFrame(image, 6)).piece.corner == (14, 14)  # there it is looked for
        reader._detector = SimpleNamespace(find=lambda piece: None)
        assert reader.read(SensorFrame(image, 7)).feeling is None
        assert reader.read(SensorFrame(image, 8)).piece.corner == (0, 0)
