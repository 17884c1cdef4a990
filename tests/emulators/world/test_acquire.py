"""``acquire.simulated`` as the engine sees it."""

import gc
import weakref
from functools import cache
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import plate_of, wrist_circle_of
from flangeye.plugin.stage import KINDS
from flangeye.types import CAMERA
from flangeye_emulators.acquire.simulated import SimulatedParams, acquire_simulated
from flangeye_emulators.world.arm import ArmErrors
from flangeye_emulators.world.scanner import CameraPose
from flangeye_plugins.plan import GridParams, grid

EXACT = ArmErrors(quality="exact")

SMALL = {"counts": (2, 2, 1)}


def acquire(robot="ur5", scanner="phoxi-m", seed=0, wrist=None, plan=None, **changes):
    model = load_model("robots", robot)
    flange = plate_of(model)
    flange = wrist_circle_of(model.flange, wrist) if wrist else flange
    settings = {"resolution": 0.1, "poses": grid.bind(GridParams(**(plan or SMALL)))} | changes
    params = SimulatedParams(**settings)
    return acquire_simulated(model, load_model("scanners", scanner), flange, seed, params)


@cache
def scanned(seed=0):
    """The captures of the smallest cell, made once."""
    return tuple(acquire(seed=seed))


def in_flange(capture, truth):
    """Return the scan's points in the reported flange frame, by the true camera pose."""
    camera_T_flange = truth.camera.inverse() @ capture.base_T_flange
    return camera_T_flange.inverse().apply(capture.cloud.points())


def test_it_is_an_acquire_stage() -> None:
    assert acquire_simulated.name == "acquire.simulated"
    assert set(acquire_simulated.gives) <= set(KINDS["acquire"].gives)


def test_captures_are_complete() -> None:
    found = scanned()
    assert acquire().total == len(found) == 5
    assert [c.id for c in found] == ["0000", "0001", "0002", "0003", "0004"]
    assert [c.role for c in found] == ["verification"] + 4 * ["calibration"]
    for capture in found:
        assert capture.cloud.frame == CAMERA
        assert capture.cloud.xyz.shape == (154, 206, 3)
        assert capture.cloud.xyz.dtype == np.float32
        assert capture.joints.shape == (6,)
    times = np.diff([c.time_ns for c in found])
    assert (times == 4_000_000_000).all()


def test_the_truth_is_the_papers_camera_pose() -> None:
    source = acquire().source
    expected = [[0, -1, 0, 0.6], [-1, 0, 0, -0.0125], [0, 0, -1, 1], [0, 0, 0, 1]]
    assert source.truth.camera.matrix == pytest.approx(np.array(expected), abs=1e-15)
    assert source.workspace.centre == pytest.approx([0.6, -0.0125, 0.3])
    assert source.workspace.size == pytest.approx([0.3, 0.3, 0.2])
    assert source.notes == ("simulated: ur5 before phoxi-m, 4 poses",)


def test_the_flange_is_where_the_robot_says() -> None:
    captures = acquire(arm=EXACT, noise=0.0, resolution=0.25)
    for capture in captures:
        points = in_flange(capture, captures.source.truth)
        radius = np.hypot(points[:, 0], points[:, 1])
        face = points[(radius > 0.018) & (radius < 0.029) & (np.abs(points[:, 2]) < 2e-3)]
        assert len(face) > 500
        assert np.median(np.abs(face[:, 2])) < 2e-6


def test_the_reported_pose_is_that_of_the_reported_joints() -> None:
    from flangeye.maths.kinematics import Arm

    arm = Arm(load_model("robots", "ur5"))
    for capture in scanned():
        assert capture.base_T_flange.matrix == pytest.approx(arm.flange(capture.joints), abs=1e-12)


def test_robot_errors_move_the_flange_by_tenths_of_a_millimetre() -> None:
    def heights(errors):
        captures = acquire(arm=errors, noise=0.0, resolution=0.15)
        for capture in captures:
            points = in_flange(capture, captures.source.truth)
            radius = np.hypot(points[:, 0], points[:, 1])
            near = (radius > 0.018) & (radius < 0.029) & (np.abs(points[:, 2]) < 3e-3)
            yield np.median(points[near, 2])

    exact, wrong = np.array(list(heights(EXACT))), np.array(list(heights(ArmErrors())))
    assert np.abs(exact).max() < 2e-6
    assert 2e-5 < np.abs(wrong).max() < 1e-3


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    first, again, other = scanned(), list(acquire()), scanned(seed=1)
    for one, two in zip(first, again, strict=True):
        assert one.cloud.xyz.tobytes() == two.cloud.xyz.tobytes()
        assert np.array_equal(one.base_T_flange.matrix, two.base_T_flange.matrix)
    assert not np.array_equal(first[1].base_T_flange.matrix, other[1].base_T_flange.matrix)
    assert first[1].cloud.xyz.tobytes() != other[1].cloud.xyz.tobytes()


def test_the_fingerprint_stands_for_everything() -> None:
    prints = [
        acquire().source.fingerprint,
        acquire(seed=1).source.fingerprint,
        acquire(noise=0.5).source.fingerprint,
        acquire(plan={"counts": (3, 1, 1)}).source.fingerprint,
    ]
    assert len(set(prints)) == len(prints)
    assert acquire().source.fingerprint == prints[0]


def test_nothing_is_scanned_before_it_is_asked_for_and_nothing_is_kept() -> None:
    captures = acquire(plan={"counts": (2, 2, 2)})
    alive = []
    for capture in captures:
        alive.append(weakref.ref(capture.cloud.xyz.base))
        del capture
        gc.collect()
        assert sum(ref() is not None for ref in alive) <= 1
    assert len(alive) == captures.total


def test_covered_flanges_are_outliers() -> None:
    captures = acquire(plan={"counts": (2, 2, 2)}, outliers=0.5, arm=EXACT)
    seen = []
    for capture in captures:
        points = in_flange(capture, captures.source.truth)
        radius = np.hypot(points[:, 0], points[:, 1])
        seen.append(bool(((np.abs(points[:, 2]) < 1e-3) & (radius < 0.03)).sum() > 50))
    assert seen[0], "a verification capture is never covered"
    assert seen[1:].count(False) == round(0.5 * (len(seen) - 1))


def test_a_robot_asked_for_its_wrist_circle_still_carries_its_plate() -> None:
    captures = acquire("ur10e", "azure-kinect", wrist=0.09, resolution=1.0, noise=0.0)
    points = in_flange(next(iter(captures)), captures.source.truth)
    radius = np.hypot(points[:, 0], points[:, 1])
    wrist = (radius > 0.036) & (radius < 0.043) & (np.abs(points[:, 2] + 6.5e-3) < 2e-3)
    plate = (radius > 0.018) & (radius < 0.022) & (np.abs(points[:, 2]) < 2e-3)
    assert wrist.sum() > 200 and plate.sum() > 50


@pytest.mark.parametrize(
    ("robot", "scanner", "plan"),
    [
        ("ur3e", "phoxi-m", {"centre": ("400 mm", "0 mm", "300 mm"), "size": ("100 mm",) * 3}),
        ("ur10e", "phoxi-m", {}),
        ("franka-panda", "phoxi-m", {}),
        ("aubo-i5", "phoxi-s", {"size": ("120 mm", "120 mm", "60 mm")}),
    ],
)
def test_other_cells_work(robot: str, scanner: str, plan: dict[str, Any]) -> None:
    captures = acquire(robot, scanner, plan=plan | {"counts": (2, 2, 2)}, resolution=0.05)
    assert captures.total >= 5
    assert np.isfinite(next(iter(captures)).cloud.xyz).any()


def test_verification_captures_may_be_left_out_or_be_several() -> None:
    none, two = (list(acquire(verification=n, resolution=0.02)) for n in (0, 2))
    assert [c.role for c in none] == 4 * ["calibration"]
    assert [c.role for c in two] == 2 * ["verification"] + 4 * ["calibration"]


def test_an_arm_that_is_too_short_is_told_so() -> None:
    with pytest.raises(StageError) as error:
        acquire("ur3e")
    assert str(error.value) == (
        "acquire.simulated: ur3e can show its flange to phoxi-m at 0 of 4 planned poses, 3 are "
        "needed (8 out of the arm's reach); move camera.position, or the plan's centre, or make "
        "its size or tilt smaller"
    )


def test_a_camera_that_looks_away_is_told_so() -> None:
    away = CameraPose(position=("600 mm", "0 mm", "1000 mm"), rpy=("0 deg", "0 deg", "0 deg"))
    with pytest.raises(StageError, match="0 of 4 planned poses, 3 are needed"):
        acquire(camera=away)


def test_a_middle_where_nothing_can_be_verified_is_told() -> None:
    # Corners that can be reached around a middle that cannot: the plan has poses, the check none.
    with pytest.raises(StageError, match="no pose for verification near the middle"):
        acquire(plan={"size": ("0 mm", "0 mm", "640 mm"), "counts": (1, 1, 9), "tilt": "0 deg",
                      "centre": ("600 mm", "0 mm", "560 mm")})  # fmt: skip


def test_the_recipes_default_plan_is_the_grid() -> None:
    class Lookup:
        def part(self, name):
            assert name == "plan.grid"
            return grid

    params = SimulatedParams.model_validate({}, context=Lookup())
    assert params.poses.params == GridParams()
    assert params.model_dump(mode="json")["poses"]["grid"]["counts"] == [3, 3, 2]
