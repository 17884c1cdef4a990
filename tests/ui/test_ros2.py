"""The Cell page in a terminal in which ROS 2 is sourced: what runs is chosen by a click; in realtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("nicegui", reason="nicegui is not installed")

from tests.plugins.ros2 import installed
from tests.plugins.ros2.cell import TOWARDS, Camera, Controller, peers
from tests.ui.conftest import ended, serve
from tests.ui.test_ui import opened

pytestmark = [pytest.mark.realtime, pytest.mark.ros2]


def test_what_runs_is_chosen_by_a_click(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed.require()
    env = installed.environment(installed.free_domain())
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    served = serve(tmp_path)
    try:
        page = opened(browser, served)
        page.get_by_text("Does it run under ROS 2?").click()
        look = page.get_by_role("button", name="Find running devices")
        look.click()
        page.get_by_text("The scans: none runs").wait_for()
        cameras = [
            Camera(env, "depth", namespace="/left"),
            Camera(env, "zivid", namespace="/right", resolution=0.4),
        ]
        with peers(Controller(env, joints=TOWARDS), *cameras):
            look.click()
            page.get_by_role("radio", name="/right/points: PointCloud2, silent, by camera").click()
            depths = page.get_by_text("/left/image_rect_raw: Image, ")
            assert " Hz, frame optical_frame, by camera" in depths.inner_text()
            assert "Hz, by controller_manager" in page.get_by_text("/joint_states: ").inner_text()
            page.get_by_text("--scanner phoxi-m --robot /robot_description --trigger").wait_for()
            page.get_by_role("button", name="Write the recipe").click()
            page.get_by_text("ur5e: base_link to tool0, 6 joints").wait_for()
            page.get_by_text("The recipe is valid.").wait_for()
        recipe = yaml.safe_load((tmp_path / "cell.yaml").read_text())
        topics = {"cloud": "/right/points", "trigger": "/right/capture"}
        assert recipe["scanner"]["driver"]["ros2"] == topics
        assert recipe["robot"]["driver"]["ros2"]["trajectory"] == Controller.topic
        assert (tmp_path / recipe["robot"]["urdf"]).exists()
        assert page.problems == []
    finally:
        ended(served)
