"""The page of configurations other than the default: drawn in frames that fit them."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.types import Pair
from flangeye.types.geometry import invert, rigid, rotation_from_rpy
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.report import page
from flangeye.workflow.report.cell import cell_drawing
from flangeye.workflow.report.facts import facts_of
from flangeye.workflow.report.page import image_view, missed_view
from flangeye.workflow.report.space import workspace_drawing

EYE = rigid(rotation_from_rpy(0.1, -0.2, 1.5), np.array([0.06, 0.01, 0.04]))
TARGET = rigid(rotation_from_rpy(0.0, 0.1, 0.3), np.array([0.5, 0.05, 0.0]))
NOTHING = t.PointCloud(t.CAMERA, np.zeros((0, 3), np.float32))
CORNERS = np.array([[100, 80, 0.1, 0], [200, 80, 0, 0.1], [200, 160, -0.2, 0], [100, 160, 0, 0]])


def logged(path, carrier=t.FLANGE, solved=True, hidden=()):
    """Log an eye in the hand that looks at a marker, and a calibration of its truth."""
    rng = np.random.default_rng(0)
    recorder = Recorder(path, {"recipe.resolved.yaml": "title: T"}, full_clouds=False)
    recorder.flangeye_run_started(source=t.Source("x"), total=8)
    pairs = []
    for i in range(8):
        pose = rigid(rotation_from_rpy(np.pi, *rng.uniform(-0.3, 0.3, 2)), rng.uniform(0.2, 0.6, 3))
        flange = t.Transform(t.BASE, t.FLANGE, pose)
        image = t.Image(np.full((240, 320), 10 * i, np.uint8), np.diag([500.0, 500.0, 1.0]))
        capture = t.Capture(f"{i}", NOTHING, t.by_frame(flange), image=image)
        seen = t.Transform(t.CAMERA, t.TARGET, invert(pose @ EYE) @ TARGET)
        feature = t.PoseFeature(seen, 1e-8 * np.eye(6), {}, CORNERS)
        recorder.flangeye_captured(step="0.acquire.x", capture=capture, seconds=0.1)
        given: dict[str, Any] = {"capture": f"{i}", "seconds": 0.1}
        if i in hidden:
            why = "4 corners found, at least 6 are needed"
            recorder.flangeye_capture_rejected(t.Rejection(f"{i}", "fit.x", why))
            continue
        recorder.flangeye_stage_finished(step="1.fit.x", value=feature, **given)
        pairs.append(Pair(t.Observation(f"{i}", feature, t.by_frame(flange)), np.zeros(3), i > 0))
    if solved:
        found = t.TransformEstimate(
            t.Transform(carrier, t.CAMERA, EYE), 1e-8 * np.eye(6), np.zeros(3)
        )
        value = t.HandEye(found, tuple(pairs), "solve.x")
        recorder.flangeye_stage_finished(step="2.solve.x", capture=None, value=value, seconds=0.1)
    recorder.close()
    return facts_of(read_run(path))


def columns(trace):
    raw = [base64.b64decode(trace[axis]["bdata"]) for axis in "xyz"]
    return np.array([np.frombuffer(column, "<f4") for column in raw]).T / 1e3


def test_the_workspace_of_an_eye_in_the_hand_is_drawn_in_the_flanges_frame(tmp_path: Path) -> None:
    drawing = workspace_drawing(logged(tmp_path / "r.mcap"))
    assert drawing.frame == "the frame flange"
    (used,) = [x for x in drawing.figure["data"] if x.get("name") == "target, used"]
    assert len(columns(used)) == 7
    assert (np.linalg.norm(columns(used), axis=1) > 0.1).all()


def test_what_stands_still_lies_in_one_place_when_the_camera_moves(tmp_path: Path) -> None:
    drawing = cell_drawing(logged(tmp_path / "r.mcap"))
    assert drawing.frame == "the robot's base"
    seen = {x["name"]: columns(x) for x in drawing.figure["data"] if "name" in x}
    centres = seen["target where it was seen"]
    assert np.allclose(centres, TARGET[:3, 3], atol=1e-6)
    assert np.ptp(seen["camera at every sighting"], axis=0).min() > 0.05


def test_a_camera_on_a_link_is_drawn_in_the_links_frame(tmp_path: Path) -> None:
    drawing = cell_drawing(logged(tmp_path / "r.mcap", carrier="link3"))
    assert drawing.frame == "the frame link3"


def test_the_image_shows_the_corners_and_what_the_pose_misses(tmp_path: Path) -> None:
    view = image_view(logged(tmp_path / "r.mcap"))
    assert view.id == "1"  # the first that was used
    assert view.corners[0] == (100, 80)
    x, y, width, height = view.box
    assert x < 100 < 200 < x + width
    assert y < 80 < 160 < y + height
    assert view.misses[2][2] < 200  # the third corner's line leads to the left
    assert view.data.startswith("data:image/jpeg;base64,")
    assert view.summary.startswith("Capture 1: 4 corners, 0.087 px rms")
    assert "at most 0.200 px" in view.summary


@pytest.mark.parametrize("solved", [True, False])
def test_the_page_is_made(tmp_path: Path, solved: bool) -> None:
    text = page.render(logged(tmp_path / "r.mcap", solved=solved).log)
    assert text.partition('id="image"')[2].count("<circle cx=") == 4
    assert "The target in the image" in text


def test_an_image_without_its_target_is_shown_with_the_reason(tmp_path: Path) -> None:
    facts = logged(tmp_path / "r.mcap", hidden=(2, 5))
    view = missed_view(facts)
    assert (view.id, view.box) == ("2", (-0.5, -0.5, 320.0, 240.0))
    assert view.summary == (
        "Capture 2, set aside: 4 corners found, at least 6 are needed. 1 more captures were rejected by the fit."
    )
    assert "An image without its target" in page.render(facts.log)
    assert missed_view(logged(tmp_path / "s.mcap")) is None
