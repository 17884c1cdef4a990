"""What each kind of error does to the poses of an arm that is not as its controller has it."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.handeye.bent import KINDS, LENGTH, SAG, TWIST, Bent, _levers
from flangeye.maths.geometry import hat, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model

ARM = Arm(load_model("robots", "ur5", None))
HOME = np.array([0.2, -1.4, 1.3, -1.2, -1.4, 0.3])
JOINTS = HOME + np.random.default_rng(0).uniform(-0.5, 0.5, (30, 6))
SIZE = 1e-4
OFF = np.array([0.0, 0.2, -0.3, 0.1, 0.25, -0.15])
BENT = Bent("arm", ARM, JOINTS - OFF, SIZE, OFF)


def twists(after, before):
    """Return (N, 6) from poses to poses, a turn and a shift of the origin."""
    turns = rotation_log(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2))
    return np.concatenate([turns, after[:, :3, 3] - before[:, :3, 3]], axis=1)


def by_kind():
    return dict(zip(KINDS, BENT.others, strict=True))


@pytest.mark.parametrize(
    "kind, which, step", [("lengths", 3, [0, LENGTH, 0]), ("twists", 2, [0, 0, TWIST])]
)
def test_links_that_are_off_move_the_flange_as_an_arm_so_built(kind, which, step) -> None:
    change = np.zeros((6, 3))
    change[which if kind == "twists" else which // 2] = np.multiply(SIZE, step)
    built = twists(ARM.altered(change).flange(JOINTS), ARM.flange(JOINTS))
    assert by_kind()[kind][:, :, which] == pytest.approx(built, abs=1e-3 * np.abs(built).max())


def test_joints_give_way_each_by_itself_and_all_together() -> None:
    sag = by_kind()["sag"]
    assert sag.shape == (30, 6, 7)
    assert sag[:, :, 6] == pytest.approx(sag[:, :, :6].sum(axis=2))
    # The base's axis stands upright: no weight turns it.
    assert np.abs(sag[:, :, 0]).max() < 1e-12 * SAG


def test_an_encoder_is_off_by_a_wave_of_any_phase() -> None:
    waves = by_kind()["encoders"]
    turned = replace(BENT, offsets=OFF + 0.4 * SIZE * np.eye(6)[2])
    at_sine = twists(turned.poses, BENT.poses) * np.sin(JOINTS[:, 2:3])
    assert waves[:, :, 2] == pytest.approx(at_sine, abs=1e-8)
    assert waves.shape == (30, 6, 12)


def test_the_smooth_rest_does_not_move_the_base() -> None:
    """What moves all poses alike is the base's place, not the arm's error."""
    smooth = by_kind()[KINDS[-1]]
    assert not smooth[:, :3].any()
    places = BENT.poses[:, :3, 3]
    still = np.broadcast_to(np.eye(3), (30, 3, 3))
    rigid = np.concatenate([-hat(places - places.mean(axis=0)), still], axis=2).reshape(-1, 6)
    told = rigid.T @ smooth[:, 3:].reshape(len(rigid), -1)
    assert np.abs(told).max() < 1e-9
    assert np.abs(smooth).max() > 0.1 * LENGTH * SIZE


def test_weight_beyond_a_joint_pulls_by_its_horizontal_lever() -> None:
    """Of an arm stretched along x: by the mean of the origins beyond, in metres; none along it."""
    joints = np.zeros((1, 6))
    origins, (axes, places) = ARM.frames(joints)[0, :, :3, 3], ARM.axes(joints)
    found = _levers(ARM, joints)[0]
    for i in range(6):
        far = np.mean([origins[k] for k in range(len(origins)) if k > i], axis=0) - places[0, i]
        # A downward weight turns a joint by its moment about the axis.
        assert found[i] == pytest.approx(-axes[0, i] @ np.cross(far, [0, 0, -1.0]), abs=1e-12)
    assert found[1] == pytest.approx(np.abs(found).max()) or found[1] == -np.abs(found).max()
    assert np.abs(found[1:3]).min() > 0.1


def test_kinds_of_errors_are_as_large_beside_a_zero_of_one_radian_as_is_said() -> None:
    """Lengths 0.2 m, twists 0.2 rad, waves 0.4 rad, and 2 rad a metre of lever."""
    kinds = by_kind()
    columns = ARM.jacobian(JOINTS)
    levers = _levers(ARM, JOINTS)
    assert kinds["sag"][:, :, :6] == pytest.approx(SIZE * 2.0 * columns * levers[:, None])
    cosines = kinds["encoders"][:, :, 6:]
    assert cosines == pytest.approx(SIZE * 0.4 * columns * np.cos(JOINTS)[:, None])
    for kind, which, step in (("lengths", 5, [0, 0.2, 0]), ("twists", 3, [0, 0, 0.2])):
        change = np.zeros((6, 3))
        change[2 if kind == "lengths" else 3] = 1e-6 * np.array(step)
        built = twists(ARM.altered(change).flange(JOINTS), ARM.flange(JOINTS)) * SIZE / 1e-6
        assert kinds[kind][:, :, which] == pytest.approx(built, abs=1e-4 * np.abs(built).max())


def test_zeros_that_are_off_turn_the_joints_where_they_are_but_the_first() -> None:
    for k in range(5):
        turned = ARM.flange(JOINTS + SIZE * np.eye(6)[k + 1])
        assert BENT.twists[:, :, k] == pytest.approx(twists(turned, BENT.poses), abs=2e-8)
    moved = BENT.moved(np.array([1.0, -2.0, 3.0, 0.0, 0.5]))
    assert moved.offsets == pytest.approx(OFF + SIZE * np.array([0, 1, -2, 3, 0, 0.5]))
