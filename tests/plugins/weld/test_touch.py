"""The tag in the image, and what it says of the tip."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.errors import StageError
from flangeye.models.finger import Finger
from flangeye.types import Image
from flangeye_emulators.finger.sensor import FingerCamera, typical_compliance
from flangeye_plugins.sensor import (
    ImageFolderParams,
    McapParams,
    OpenCVParams,
    sensor_image_folder,
    sensor_mcap,
    sensor_opencv,
)
from flangeye_plugins.weld.touch.tag_observation import TagDetector
from flangeye_plugins.weld.touch.tip_displacement import Interpreter
from tests.plugins.weld.cell import FINGER

COMPLIANCE = typical_compliance()


class Eye:
    """A camera over a tip that can be put anywhere."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.camera = FingerCamera(FINGER, rng)
        self.detector = TagDetector(FINGER)

    def image(self, displacement):
        return self.camera.image(*COMPLIANCE.tag(np.array(displacement)))

    def reading(self, displacement):
        return self.detector.find(self.image(displacement))


def displacements(count, size, seed=1):
    return np.random.default_rng(seed).uniform(-size, size, (count, 3))


def test_the_noise_of_the_tip_in_the_plane_is_below_20_um() -> None:
    eye, interpreter = Eye(), Interpreter(FINGER)
    felt = [interpreter.feel(r, 0) for _ in range(60) if (r := eye.reading([2e-3, 0, 1e-3]))]
    assert len(felt) > 50
    spread = np.std([f.displacement for f in felt], axis=0)
    assert spread[:2].max() < 20e-6
    # What is predicted of the noise holds it, and is not an exaggeration.
    predicted = np.sqrt(np.diag(felt[0].covariance))
    assert (spread[:2] < 2 * predicted[:2]).all()
    assert predicted[:2].max() < 40e-6


def test_the_displacement_is_that_of_the_tip() -> None:
    eye, interpreter = Eye(), Interpreter(FINGER)
    for wanted in displacements(20, 2e-3):
        felt = interpreter.feel(eye.reading(wanted), 0)
        np.testing.assert_allclose(felt.displacement[:2], wanted[:2], atol=0.05e-3)
        np.testing.assert_allclose(felt.displacement[2], wanted[2], atol=0.15e-3)
        lean = COMPLIANCE.tilt * np.array([-wanted[1], wanted[0], 0.0])
        np.testing.assert_allclose(felt.rotation, lean, atol=np.deg2rad(1.0))
        assert felt.confidence > 0.7


def test_another_tag_or_none_is_no_reading() -> None:
    eye = Eye()
    assert eye.reading([1.0, 0.0, 0.0]) is None
    other = FINGER.model_copy(update={"tag": FINGER.tag.model_copy(update={"id": 8})})
    assert TagDetector(other).find(eye.image([0, 0, 0])) is None


def test_a_colour_image_reads_like_a_grey_one() -> None:
    grey = Eye().image([0, 0, 0])
    colour = Image(np.repeat(grey.pixels[..., None], 3, axis=2), grey.camera_matrix)
    same = TagDetector(FINGER).find(colour)
    np.testing.assert_allclose(same.translation, TagDetector(FINGER).find(grey).translation)


@pytest.mark.parametrize(
    ("tag", "told"),
    [
        ({"dictionary": "DICT_9X9", "side": "12 mm"}, "OpenCV has no ArUco dictionary 'DICT_9X9'"),
        ({"id": 50, "side": "12 mm"}, "DICT_4X4_50 has 50 tags, there is no tag 50"),
    ],
)
def test_a_tag_that_does_not_exist(tag: dict[str, Any], told: str) -> None:
    data = FINGER.model_dump(mode="json", exclude={"tag", "calibration"}) | {"tag": tag}
    with pytest.raises(StageError) as error:
        TagDetector(Finger.model_validate(data))
    assert str(error.value) == f"finger srm: {told}"


# --- calibration ----------------------------------------------------------------------------------


def test_a_finger_that_was_never_calibrated() -> None:
    with pytest.raises(StageError) as error:
        Interpreter(FINGER.model_copy(update={"calibration": None}))
    assert str(error.value) == (
        "finger srm is not calibrated: run 'flangeye tactile calibrate' first"
    )


# --- sensors --------------------------------------------------------------------------------------


class Clock:
    def __init__(self):
        self.now = 5_000_000_000

    def state(self):
        return SimpleNamespace(time_ns=self.now)


@pytest.fixture
def folder(tmp_path: Path) -> Any:
    import cv2

    eye = Eye()
    for i, place in enumerate(displacements(3, 1e-3)):
        cv2.imwrite(str(tmp_path / f"{i:03}.png"), eye.image(place).pixels)
    return tmp_path


def test_a_folder_of_images_comes_in_its_own_time(folder: Any) -> None:
    clock = Clock()
    with sensor_image_folder.function(FINGER, clock, 0, ImageFolderParams(path=folder)) as sensor:
        first = sensor.frame()
        assert first.time_ns == clock.now
        assert sensor.frame() is None
        clock.now += 33_000_000
        assert sensor.frame().time_ns == clock.now
        clock.now += 33_000_000
        assert TagDetector(FINGER).find(sensor.frame().image) is not None
        with pytest.raises(DeviceError, match="the recording has ended"):
            sensor.frame()


def test_folders_without_images(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="holds no image; known: .png"):
        sensor_image_folder.function(FINGER, Clock(), 0, ImageFolderParams(path=tmp_path))
    with pytest.raises(StageError, match="is not a folder"):
        sensor_image_folder.function(FINGER, Clock(), 0, ImageFolderParams(path=tmp_path / "x"))


def test_images_of_another_size(folder: Any) -> None:
    lens = FINGER.camera.model_copy(update={"width": 640})
    other = FINGER.model_copy(update={"camera": lens})
    with pytest.raises(
        DeviceError, match="an image of 320 x 240, but finger srm is calibrated for 640"
    ):
        sensor_image_folder.function(other, Clock(), 0, ImageFolderParams(path=folder)).frame()


def test_opencv_opens_what_it_can(folder: Any) -> None:
    # No recipe may name a file here; OpenCV reads one as it reads a camera.
    params = OpenCVParams.model_construct(device=str(folder / "%03d.png"), latency=0.015)
    with sensor_opencv.function(FINGER, Clock(), 0, params) as sensor:
        frame = None
        with pytest.raises(DeviceError, match="gives no more images; is it still connected"):
            while True:
                frame = sensor.frame() or frame
        assert TagDetector(FINGER).find(frame.image) is not None


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match="OpenCV cannot open it; is it there, and free"):
        sensor_opencv.function(FINGER, Clock(), 0, OpenCVParams(device="/dev/video99"))


def test_a_log_without_images(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"")
    with pytest.raises(StageError, match="holds no images of a finger"):
        sensor_mcap.function(FINGER, Clock(), 0, McapParams(path=path))
