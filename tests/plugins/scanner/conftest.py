"""A recording of a RealSense, for its tests and for the kit's."""

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pyrealsense2", reason="pip install 'flangeye[realsense]'")
    from tests.plugins.scanner.realsense_device import record

    path = tmp_path_factory.mktemp("realsense") / "cell.db3"
    record(path)
    return path
