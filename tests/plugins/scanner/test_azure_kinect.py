"""The Azure Kinect driver on recordings that the SDK's own recorder wrote."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, FrameDropped, Scanner, settings_file
from flangeye.models.loading import load_model
from flangeye_plugins.scanner import azure_kinect as driver
from flangeye_plugins.scanner.azure_kinect import (
    AzureKinectParams,
    scanner_azure_kinect,
)
from flangeye_plugins.scanner.opened import DepthView
from tests.plugins.fixed import fixed
from tests.plugins.scanner.mkv import COLUMNS, ROWS, Recorder

KINECT = load_model("scanners", "azure-kinect")


def refused(params, model=None):
    with pytest.raises(DeviceError) as error:
        scanner_azure_kinect(model, params)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture(scope="session")
def kinect(tmp_path_factory: Any) -> Iterator[Any]:
    """A Python of its own with pyk4a, as the driver's hint says, and its recorder."""
    folder = tmp_path_factory.mktemp("kinect")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--quiet", "--python", python, "install"]
    done = subprocess.run([*command, "pyk4a-bundle", "numpy<2"], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"pyk4a-bundle cannot be installed: {done.stderr.strip().splitlines()[-1]}")
    (libraries,) = folder.rglob("pyk4a_bundle.libs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLANGEYE_PROGRAM_PYK4A", str(python))
        yield SimpleNamespace(python=str(python), recorder=Recorder(libraries))


def tilted(at=800):
    """A plane whose depth grows by a tenth of a millimetre a column, with a hole [mm]."""
    depth = np.broadcast_to(at + 0.1 * np.arange(COLUMNS), (ROWS, COLUMNS)).copy()
    depth[100:110, 100:110] = 0
    return depth


SDK_CLOUD = """
import json, os, sys, pyk4a
out = os.fdopen(os.dup(1), "w"); os.dup2(2, 1)
playback = pyk4a.PyK4APlayback(sys.argv[1]); playback.open()
cloud = playback.get_next_capture().depth_point_cloud[::50, ::50]
out.write(json.dumps(cloud.reshape(-1, 3).tolist()))
"""


@pytest.mark.slow
def test_a_recording_is_played_in_metres(kinect: Any, tmp_path: Path) -> None:
    path = tmp_path / "depth.mkv"
    kinect.recorder.write(path, [tilted(800 + i) for i in range(3)])
    params = AzureKinectParams(recording=path, python="pyk4a")
    with scanner_azure_kinect(KINECT, params) as scanner:
        assert isinstance(scanner, Scanner)
        assert scanner.name == "Azure Kinect depth.mkv"
        assert scanner.facts["unit"] == "mm"
        assert scanner.facts["depth mode"] == "NFOV_UNBINNED"
        scans = [scanner.expose()() for _ in range(3)]
        with pytest.raises(DeviceError) as error:
            scanner.expose()
    assert str(error.value) == "scanner.azure_kinect: the recording has ended"
    for index, scan in enumerate(scans):
        depth = scan.cloud.xyz[..., 2]
        assert scan.cloud.xyz.shape == (ROWS, COLUMNS, 3)
        assert np.isnan(depth[105, 105])
        assert depth[288, 320] == np.float32((832 + index) / 1000)
        assert scan.image is None
    # The SDK rounds its own points to millimetres.
    of_sdk = np.array(json.loads(subprocess.check_output([kinect.python, "-c", SDK_CLOUD, path])))
    xyz = np.nan_to_num(scans[0].cloud.xyz[::50, ::50]).reshape(-1, 3)
    assert np.abs(xyz - of_sdk * 1e-3)[of_sdk.any(axis=1)].max() < 0.51e-3
    assert of_sdk.any(axis=1).sum() > 100


@pytest.mark.slow
def test_colour_is_given_as_the_depth_camera_sees_it(kinect: Any, tmp_path: Path) -> None:
    colour = np.zeros((720, 1280, 4), np.uint8)
    colour[..., 0], colour[..., 1], colour[..., 2], colour[..., 3] = 10, 20, 200, 255
    kinect.recorder.write(tmp_path / "both.mkv", [tilted()], [colour])
    params = AzureKinectParams(recording=tmp_path / "both.mkv", python="pyk4a")
    with scanner_azure_kinect(KINECT, params) as scanner:
        assert scanner.facts["colour"] == "COLOR_BGRA32"
        image = scanner.expose()().image
    assert image.pixels.shape == (ROWS, COLUMNS, 3)
    assert tuple(image.pixels[288, 320]) == (200, 20, 10)
    assert image.camera_matrix[0, 0] == pytest.approx(0.49 * 1024, rel=1e-6)
    assert not image.distortion.any()


@pytest.mark.slow
def test_what_is_no_recording_and_no_camera_is_said(kinect: Any, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mkv"
    broken.write_text("no recording")
    params = AzureKinectParams(recording=broken, python="pyk4a")
    assert refused(params) == (f"scanner.azure_kinect: K4AException: Cannot open file {broken}")
    assert refused(AzureKinectParams(python="pyk4a")) == (
        "scanner.azure_kinect: LookupError: 0 Azure Kinects are connected"
    )
    kinect.recorder.write(tmp_path / "far.mkv", [tilted()])
    params = AzureKinectParams(recording=tmp_path / "far.mkv", python="pyk4a")
    far = KINECT.model_copy(update={"near": 40.0, "far": 90.0})
    scanner = scanner_azure_kinect(far, params)
    with scanner, pytest.raises(DeviceError, match="but azure-kinect sees 40.000 to 90.000 m"):
        scanner.expose()()


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Let a few lines of Python stand for the process that holds the camera."""

    def stand_in(code):
        (tmp_path / "host.py").write_text(
            "import json, sys, os\n"
            "def say(**answer): print(json.dumps(answer), flush=True)\n" + code
        )
        monkeypatch.setattr(driver, "HOST", tmp_path / "host.py")

    return stand_in


def test_a_missing_sdk_is_said_with_what_to_do() -> None:
    assert refused(AzureKinectParams()) == (
        "scanner.azure_kinect: ModuleNotFoundError: No module named 'pyk4a'; pyk4a-bundle needs "
        "NumPy 1: make it a Python of its own (python -m venv kinect; kinect/bin/pip install "
        "pyk4a-bundle 'numpy<2') and name it on this machine: kinect = "
        f'"/whole/path/to/kinect/bin/python" under [programs] in {settings_file()}'
    )


def test_a_missing_recording_or_python_is_said(tmp_path: Path) -> None:
    path = tmp_path / "none.mkv"
    assert refused(AzureKinectParams(recording=path)) == (
        f"scanner.azure_kinect: no recording at {path}"
    )
    assert refused(AzureKinectParams(python="other")) == (
        "scanner.azure_kinect: this machine's settings have no entry 'other' (entries: none); a recipe may not "
        f'choose programs or libraries: write other = "/its/path" under [programs] in {settings_file()}'
    )


def test_an_abort_of_the_sdk_does_not_end_the_run(host: Callable[..., Any]) -> None:
    host("sys.stderr.write('terminate called\\n'); sys.stderr.flush(); os.abort()")
    assert refused(AzureKinectParams()) == (
        "scanner.azure_kinect: the SDK has ended its process (exit -6: terminate called)"
    )
    host("say(facts={'serial': '7'})\ninput()\nos.abort()")
    scanner = scanner_azure_kinect(None, AzureKinectParams())
    for _ in range(2):
        with pytest.raises(DeviceError) as error:
            scanner.expose()
        assert str(error.value) == "scanner.azure_kinect: the SDK has ended its process (exit -6)"
    scanner.close()
    scanner.close()


def test_a_camera_that_falls_silent_is_said(host: Callable[..., Any]) -> None:
    host("say(facts={'serial': '7'})\nimport time; time.sleep(60)")
    scanner = scanner_azure_kinect(None, fixed(AzureKinectParams, timeout=1e-3))
    with scanner, pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == (
        "scanner.azure_kinect: no frame in time; is the camera still connected?"
    )


def test_a_capture_without_depth_is_dropped(host: Callable[..., Any]) -> None:
    host(
        "say(facts={'serial': '7'})\nfor _ in sys.stdin: say(error='a capture without a depth image', dropped=True)"
    )
    scanner = scanner_azure_kinect(None, AzureKinectParams())
    with scanner, pytest.raises(FrameDropped, match="a capture without a depth image"):
        scanner.expose()


def test_a_camera_lost_in_the_middle_of_a_frame_is_said(host: Callable[..., Any]) -> None:
    host("say(facts={'serial': '7'})\ninput()\nsay(depth=[4, 4], calibration={})\nprint('x')")
    scanner = scanner_azure_kinect(None, AzureKinectParams())
    with scanner, pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == "Azure Kinect 7: lost in the middle of a frame (exit 0)"


BESIDE = {
    "matrix": [[600.0, 0, 640], [0, 600, 360], [0, 0, 1]],
    "distortion": [0.0] * 8,
    "rotation": np.eye(3).tolist(),
    "translation": [-0.032, 0.0, 0.0],
}
BENT = [0.4, -2.0, 1e-3, -2e-4, 1.4, 0.3, -1.9, 1.3]


def view(distortion):
    return DepthView([[500.0, 0, 320], [0, 500, 288], [0, 0, 1]], distortion, BESIDE)


def test_points_fall_on_the_pixels_they_came_from() -> None:
    """Distorted as OpenCV defines it, written out here, every point returns to its pixel."""
    xyz = view(BENT).points(np.full((ROWS, COLUMNS), 800)).astype(float)
    x, y = (xyz[..., i] / xyz[..., 2] for i in (0, 1))
    k1, k2, p1, p2, k3, k4, k5, k6 = BENT
    r2 = x**2 + y**2
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = 500 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + 320
    v = 500 * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + 288
    middle = np.s_[200:376, 220:420]
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    assert np.abs(u - columns)[middle].max() < 0.02
    assert np.abs(v - rows)[middle].max() < 0.02


def test_colour_falls_where_the_colour_camera_saw_it() -> None:
    """A point 1 m ahead is 32 mm aside for the colour camera: 19.2 of its pixels."""
    colour = np.zeros((720, 1280, 4), np.uint8)
    colour[..., 0] = np.arange(1280) // 8
    plain = view([0.0] * 8)
    image = plain.coloured(plain.points(np.full((ROWS, COLUMNS), 1000)), colour)
    for column in (100, 320, 500):
        seen = (column - 320) / 500 * 600 + 640 - 19.2
        assert abs(image.pixels[288, column, 2] - seen / 8) < 1.1
    assert not image.pixels[..., :2].any()
