"""Only the part of an image that holds the tag is read, with the same result."""

from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, SensorFrame
from flangeye.types import Image, Seed
from flangeye_plugins.weld.finger_camera import CameraJob, FingerReader, SteppedReader
from flangeye_plugins.weld.touch.tag_observation import (
    TAG_MARGIN,
    ImageRegion,
    RegionOfInterest,
    cut,
)
from tests.plugins.weld.cell import FINGER
from tests.plugins.weld.test_camera_process import Camera, state
from tests.plugins.weld.test_look import Looker, nobody
from tests.plugins.weld.test_touch import Eye, displacements

CORNERS = np.array([[100.0, 60.5], [180.0, 60.0], [180.2, 140.0], [100.0, 140.0]])


def blank(height=240, width=320):
    return Image(np.zeros((height, width), np.uint8), FINGER.camera.matrix)


def test_the_first_look_is_at_the_whole_image() -> None:
    whole = blank()
    (piece,) = RegionOfInterest().pieces(whole)
    assert piece.corner == (0, 0)
    assert piece.image is whole


def test_then_around_the_tag_and_at_the_whole_only_if_it_is_gone() -> None:
    gaze = RegionOfInterest()
    gaze.follow(ImageRegion(blank(), (0, 0)), CORNERS)
    near, whole = gaze.pieces(blank())
    assert near.corner == (100 - TAG_MARGIN, 60 - TAG_MARGIN)
    assert near.image.pixels.shape == (
        140 + TAG_MARGIN - near.corner[1],
        181 + TAG_MARGIN - near.corner[0],
    )
    assert whole.corner == (0, 0)
    gaze.follow(near, CORNERS - near.corner + [5.0, 0.0])
    moved, _ = gaze.pieces(blank())
    assert moved.corner == (105 - TAG_MARGIN, 60 - TAG_MARGIN)
    gaze.follow(moved, None)
    assert len(list(gaze.pieces(blank()))) == 1


def test_a_tag_at_the_edge_is_cut_there() -> None:
    gaze = RegionOfInterest()
    gaze.follow(ImageRegion(blank(), (0, 0)), CORNERS - [95.0, 55.0])
    near, _ = gaze.pieces(blank())
    assert near.corner == (0, 0)
    gaze.follow(ImageRegion(blank(), (0, 0)), CORNERS + [130.0, 90.0])
    near, _ = gaze.pieces(blank())
    assert near.image.pixels.shape[1] == 320 - near.corner[0]
    assert near.image.pixels.shape[0] == 240 - near.corner[1]


def test_a_piece_keeps_its_place_in_the_camera() -> None:
    piece = cut(blank(), (30, 20), (130, 100))
    assert piece.image.pixels.shape == (80, 100)
    np.testing.assert_allclose(
        piece.image.camera_matrix[:2, 2], FINGER.camera.matrix[:2, 2] - [30, 20]
    )


def test_what_is_felt_is_the_same_from_the_piece_as_from_the_whole() -> None:
    eye, reader = Eye(), FingerReader(FINGER)
    for i, place in enumerate(np.linspace([0, -1e-3, 0], [5e-4, 2e-3, 1e-3], 10)):
        image = eye.image(place)
        part, whole = (
            reader.read(SensorFrame(image, i)),
            FingerReader(FINGER).read(SensorFrame(image, i)),
        )
        assert (part.piece.image.pixels.size < 0.6 * image.pixels.size) == (i > 0)
        np.testing.assert_allclose(part.feeling.displacement, whole.feeling.displacement, atol=1e-6)


def test_a_tag_that_jumped_is_found_in_the_same_image() -> None:
    eye, reader = Eye(), FingerReader(FINGER)
    reader.read(SensorFrame(eye.image([0, -1.5e-3, 0]), 0))
    sight = reader.read(SensorFrame(eye.image([0, 2.5e-3, 0]), 1))
    assert sight.feeling.displacement[1] == pytest.approx(2.5e-3, abs=0.05e-3)
    assert sight.piece.corner == (0, 0)


def test_a_piece_is_read_again_as_it_was_read() -> None:
    eye, reader, again = Eye(), FingerReader(FINGER), FingerReader(FINGER)
    for i, place in enumerate([*displacements(5, 1e-3), [1.0, 0, 0], [0, 0, 0]]):
        sight = reader.read(SensorFrame(eye.image(place), i))
        redone = again.reread(sight.piece, sight.time_ns)
        if sight.feeling is None:
            assert redone.feeling is None
        else:
            np.testing.assert_array_equal(redone.feeling.displacement, sight.feeling.displacement)


class Closing(Camera):
    """Notes that it was closed."""

    closed: list[str] = []

    def close(self) -> None:
        self.closed.append("camera")


class ClosingLook(Looker):
    """Notes that it was closed."""

    def profile(self):
        return None if self._robot.state().time_ns == 1 else super().profile()

    def close(self) -> None:
        Closing.closed.append("look")


def closing(look: Any = None) -> CameraJob:
    camera: Any = Closing
    return CameraJob(camera, FINGER, state(1), Seed(0), look)


def test_in_the_loop_the_camera_sees_what_the_arm_was_told_last_and_is_closed() -> None:
    Closing.closed.clear()
    with SteppedReader(closing()) as reader:
        assert reader.behind is None and reader.profiles() == [] and reader.seen() == []
        reader.tell(state(5))
        assert [sight.time_ns for sight in reader.seen()] == [5]
        assert reader.seen() == [] and reader.true_torch() is None
    assert Closing.closed == ["camera"]


def test_in_the_loop_a_look_behind_the_torch_is_taken_too_and_closed_first() -> None:
    Closing.closed.clear()
    with SteppedReader(closing(ClosingLook)) as reader:
        assert reader.behind == 0.02 and reader.profiles() == []
        reader.tell(state(5))
        assert [look.time_ns for look in reader.profiles()] == [5]
    assert Closing.closed == ["look", "camera"]
    Closing.closed.clear()
    with pytest.raises(DeviceError, match="cannot be reached"):
        SteppedReader(closing(nobody))
    assert Closing.closed == ["camera"]  # it was open already
