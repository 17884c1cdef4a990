"""Arms that are as bad as real ones: how much, in which shape, and nobody is told."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.loading import load_model
from flangeye.models.targets import flange_of, load_standard
from flangeye.types import BASE, CAMERA, FLANGE, TARGET, Source, Transform, Truth
from flangeye_emulators.acquire.moments import CameraView
from flangeye_emulators.acquire.planned_session import plan_session
from flangeye_emulators.acquire.simulated import SimulatedParams, acquire_simulated
from flangeye_emulators.acquire.simulated_poses import SimulatedMarkerParams
from flangeye_emulators.world.arm import REAL, ArmErrors, ErrorSizes, ImperfectArm
from flangeye_emulators.world.scanner import CameraPose
from flangeye_plugins.plan import GridParams, grid

HOME = np.radians([0, -90, 90, -90, -90, 0])
VIEW = CameraView(0.65, 0.3, 2.0, (0.9, 0.7), 0.9)
EYE_IN_HAND = Configuration("eye-in-hand", FLANGE, BASE)


def session_joints(seed=0, count=27, spread=0.3):
    """Joints over about 0.3 m, as a session visits them."""
    return HOME + np.random.default_rng(seed).uniform(-spread, spread, (count, 6))


def left_over(measured, reported):
    """Return (N, 3) what the best rigid motion leaves of points (Arun et al. 1987)."""
    a, b = measured - measured.mean(axis=0), reported - reported.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
    return a @ turn.T - b


CELLS = {
    "ur5": ("phoxi-m", {}, {}),
    "aubo-i5": (
        "phoxi-s",
        {"position": ("500 mm", "0 mm", "800 mm")},
        {"size": ("150 mm", "200 mm", "70 mm")},
    ),
}


@cache
def workspace_joints(robot):
    """Joints all over the workspace of a simulated cell: those of its truth."""
    scanner, camera, box = CELLS[robot]
    model = load_model("robots", robot)
    params = SimulatedParams(
        arm=ArmErrors(quality="real"), camera=CameraPose(**camera),
        poses=grid.bind(GridParams(counts=(2, 2, 1), **box)), verification=0,
    )  # fmt: skip
    flange = flange_of(model.flange, load_standard(model.flange.standard))
    captures = acquire_simulated(model, load_model("scanners", scanner), flange, 0, params)
    return np.array([seen.joints for seen in captures.source.truth.unseen])


def rms_left(errors, seed, robot="ur5"):
    arm = ImperfectArm(load_model("robots", robot), 1.0, np.random.default_rng(seed), errors)
    joints = workspace_joints(robot)
    there = arm.flange(arm.angles(joints))[:, :3, 3]
    left = left_over(there, arm.reported(joints)[:, :3, 3])
    return np.sqrt((left**2).sum(axis=1).mean())


@pytest.mark.parametrize("robot", ["ur5", "aubo-i5"])
def test_a_real_arm_leaves_what_published_recordings_leave(robot: str) -> None:
    left = [rms_left(ArmErrors(quality="real"), seed, robot) for seed in range(30)]
    assert 0.35e-3 < np.median(left) < 0.7e-3
    assert np.median([rms_left(ArmErrors(), seed, robot) for seed in range(30)]) < 0.2e-3


def test_what_it_leaves_is_smooth() -> None:
    """Second powers of the place tell most of it; of independent noise they told a sixth."""
    model, joints = load_model("robots", "ur5"), workspace_joints("ur5")
    shares = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        arm = ImperfectArm(model, 1.0, rng, ArmErrors(quality="real"))
        reported = arm.reported(joints)[:, :3, 3]
        left = left_over(arm.flange(arm.angles(joints))[:, :3, 3], reported)
        u = (reported - reported.mean(axis=0)) / 0.15
        powers = np.column_stack([np.ones(len(u)), u, u**2, u * np.roll(u, 1, axis=1)])
        told = powers @ np.linalg.lstsq(powers, left, rcond=None)[0]
        shares.append((told**2).sum() / (left**2).sum())
    assert np.median(shares) > 0.4


@pytest.mark.parametrize("name", ErrorSizes._fields)
def test_each_error_moves_the_arm_and_none_the_report(name: Any) -> None:
    errors = ErrorSizes(0.0)._replace(**{name: getattr(REAL, name)})
    model, joints = load_model("robots", "ur5"), session_joints()
    arm = ImperfectArm(model, 1.0, np.random.default_rng(0), errors)
    moved = np.linalg.norm(
        (arm.flange(arm.angles(joints)) - arm.reported(joints))[:, :3, 3], axis=1
    )
    assert 1e-5 < moved.max() < 5e-3
    assert np.array_equal(arm.reported(joints), Arm(model).flange(joints))


def test_sag_lowers_the_flange_and_more_the_farther_out() -> None:
    model = load_model("robots", "ur5")
    errors = ErrorSizes(zeros=0.0, sag=2e-3)
    arm = ImperfectArm(model, 1.0, np.random.default_rng(0), errors)
    stretched, folded = np.zeros((1, 6)), HOME[None]

    def drop(joints):
        return (arm.reported(joints) - arm.flange(arm.angles(joints)))[0, 2, 3]

    assert 0.2e-3 < drop(stretched) < 3e-3
    assert 0 < drop(folded) < drop(stretched)


def test_backlash_depends_on_the_way_there() -> None:
    arm = ImperfectArm(
        load_model("robots", "ur5"), 1.0, np.random.default_rng(0),
        ErrorSizes(zeros=0.0, backlash=0.2e-3),
    )  # fmt: skip
    visits = HOME + np.array([[-0.1], [0.0], [0.1], [0.0]]) * np.ones(6)
    upwards, downwards = arm.angles(visits)[[1, 3]]
    assert downwards - upwards == pytest.approx(np.full(6, 0.2e-3))


def test_no_scale_is_a_perfect_arm() -> None:
    model = load_model("robots", "franka-panda")
    arm = ImperfectArm(model, 0.0, np.random.default_rng(0), ArmErrors(quality="real"))
    joints = np.random.default_rng(0).uniform(-1, 1, (5, 7))
    assert np.array_equal(arm.flange(arm.angles(joints)), arm.reported(joints))


def planned(errors, configuration=EYE_IN_HAND, **changes):
    params = SimulatedMarkerParams(poses=12, arm=errors, **changes)
    rng = np.random.default_rng(3)
    return plan_session(load_model("robots", "ur5"), None, configuration, (params, VIEW), rng)


def test_a_session_of_any_configuration_keeps_what_it_reports() -> None:
    kind, real = planned(ArmErrors()), planned(ArmErrors(quality="real"))
    assert np.array_equal(kind.reported[FLANGE], real.reported[FLANGE])
    off = np.linalg.norm((real.each(FLANGE) - real.reported[FLANGE])[:, :3, 3], axis=1)
    assert 0.5e-3 < off.max() < 10e-3
    assert not kind.unseen
    assert len(real.unseen) == 60


def test_poses_that_took_no_part_show_the_arms_error_at_the_work() -> None:
    session = planned(ArmErrors(quality="real"))
    camera, place = session.actual[CAMERA].place, session.actual[TARGET].place
    for seen in session.unseen[:5]:
        mapped = seen.base_T_flange.matrix @ camera @ seen.feature.camera_T_target.matrix
        assert 1e-5 < np.linalg.norm((mapped - place)[:3, 3]) < 10e-3


def test_a_link_that_carries_the_camera_is_off_too() -> None:
    on_link = Configuration("eye-on-arm", "link3", FLANGE, ORIGIN)
    session = planned(ArmErrors(quality="real"), on_link, distance="500 mm")
    assert np.abs(session.each("link3") - session.reported["link3"]).max() > 1e-4


def test_four_axes_have_no_joints_to_be_wrong() -> None:
    with pytest.raises(StageError, match="simulated for an arm of four axes; leave 'arm' out"):
        planned(ArmErrors(quality="real"), motion="four_axes")


def test_a_size_replaces_that_of_the_quality() -> None:
    model = load_model("robots", "ur5")
    sizes = ArmErrors(quality="real", zeros="4 mrad").sizes(model)
    assert sizes == REAL._replace(zeros=4e-3)
    assert ArmErrors().sizes(model) == ErrorSizes(model.joint_accuracy)


def test_truth_at_the_work_goes_through_the_log() -> None:
    from pydantic import TypeAdapter

    unseen = planned(ArmErrors(quality="real")).unseen[:1]
    camera = Transform(FLANGE, "camera", np.eye(4))
    source = Source("", truth=Truth(camera, unseen=unseen))
    adapter = TypeAdapter(Source)
    back = adapter.validate_json(adapter.dump_json(source))
    seen = back.truth.unseen[0]
    assert seen.feature.camera_T_target.child == TARGET
    assert seen.joints == pytest.approx(unseen[0].joints)
