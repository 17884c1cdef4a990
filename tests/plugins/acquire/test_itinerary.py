"""The stops of a live session: where the scanner stands is guessed first, and known soon."""

import numpy as np
import pytest

from flangeye.models.loading import load_model
from flangeye.models.targets import plate_of
from flangeye.motion.reach import Margins, Reach
from flangeye.plugin.stage import BoundPart
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    TARGET,
    CircleFeature,
    Observation,
    PoseFeature,
    Transform,
    by_frame,
)
from flangeye.types.geometry import invert, rigid, rotation_exp
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.world.scanner import CameraPose
from flangeye_plugins.acquire.itinerary import itinerary_of, view_of
from flangeye_plugins.plan import NextBestParams, next_best

ROBOT, SCANNER = load_model("robots", "ur5e"), load_model("scanners", "phoxi-m")
PLATE = plate_of(ROBOT)
BASE_T_CAMERA = CameraPose().matrix
GUESS = BASE_T_CAMERA @ rigid(rotation_exp(np.radians([4.0, -5.0, 0.0])), [0.02, -0.02, 0.03])
BOX = {"centre": ["0.55 m", "0 m", "0.35 m"], "size": ["0.9 m", "0.9 m", "0.7 m"]}
MARGINS = Margins(
    LimitsSection.model_validate({"box": BOX}).for_robot(ROBOT), np.radians(5.0), 0.05
)


def seen(name, base_T_flange, aside=0.0):
    """Return the flange at a pose (4, 4) as the scanner sees it, or something else beside it."""
    camera_T_flange = invert(BASE_T_CAMERA) @ base_T_flange
    circle = CircleFeature(
        camera_T_flange[:3, 3] + [aside, 0.0, 0.0], camera_T_flange[:3, 2], {},
        1e-8 * np.eye(3), 1e-8 * np.eye(3), 0.9,
    )  # fmt: skip
    return Observation(name, circle, by_frame(Transform(BASE, FLANGE, base_T_flange)))


def marked(name, base_T_flange, aside=0.0):
    """Return a marker on the flange as a camera measures it, to 0.2 mm and 0.2 deg."""
    rng = np.random.default_rng(int(name))
    flange_T_target = rigid(rotation_exp([0.1, -0.2, 1.0]), [0.03, -0.02, 0.04])
    noise = rigid(rotation_exp(rng.normal(0, np.radians(0.2), 3)), rng.normal(0, 2e-4, 3))
    pose = invert(BASE_T_CAMERA) @ base_T_flange @ flange_T_target @ noise
    pose[0, 3] += aside
    target = PoseFeature(Transform(CAMERA, TARGET, pose), np.diag([1e-5] * 3 + [4e-8] * 3))
    return Observation(name, target, by_frame(Transform(BASE, FLANGE, base_T_flange)))


def stops_seen(measured):
    """Return of 20 stops of a session, planned by a wrong guess, which the scanner sees."""
    session = itinerary_of(ROBOT, SCANNER, PLATE, GUESS, MARGINS, None)
    params = NextBestParams(count=20)
    session.plan(BoundPart(next_best, params), 1, seed=3)
    truth = Reach(ROBOT, SCANNER, BASE_T_CAMERA, PLATE.outer)
    inside = []
    session.outcomes = {}
    for stop in session.stops():
        pose = stop.pose.base_T_flange
        inside.append(truth.in_view(pose))
        if measured:
            session.outcomes[stop.id] = measured(stop.id, pose) if inside[-1] else None
    return inside


@pytest.mark.parametrize(("measured", "needed"), [(seen, 3), (marked, 5)])
def test_targets_that_were_seen_tell_the_plan_where_the_scanner_stands(measured, needed) -> None:
    guessed, told = stops_seen(None), stops_seen(measured)
    assert sum(guessed) < 0.8 * len(guessed)
    enough = np.flatnonzero(np.cumsum(told) == needed)[0]
    assert all(told[enough + 1 :])


def poses_before_the_scanner(count):
    rng = np.random.default_rng(0)
    return [
        rigid(rotation_exp([np.pi, 0.0, 0.0]) @ rotation_exp(rng.normal(0, 0.2, 3)), place)
        for place in rng.uniform([0.4, -0.2, 0.2], [0.7, 0.2, 0.5], (count, 3))
    ]


def test_what_does_not_fit_tells_the_plan_nothing() -> None:
    poses = poses_before_the_scanner(4)
    flanges = [seen(str(i), pose) for i, pose in enumerate(poses)]
    assert view_of(flanges) == pytest.approx(BASE_T_CAMERA, abs=1e-9)
    assert view_of(flanges[:2]) is None
    assert view_of([*flanges[:3], seen("3", poses[3], aside=0.1)]) is None


def test_markers_tell_where_the_camera_stands_wherever_they_are_on_the_flange() -> None:
    poses = poses_before_the_scanner(8)
    markers = [marked(str(i), pose) for i, pose in enumerate(poses)]
    assert view_of(markers) == pytest.approx(BASE_T_CAMERA, abs=0.01)
    assert view_of(markers[:4]) is None
    assert view_of([*markers[:7], marked("7", poses[7], aside=0.1)]) is None
