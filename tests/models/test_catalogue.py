"""The arms of data/robots against what their makers publish apart from their models: the reach."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names

FLANGE = None
REACH = {  # mm by the data sheet; of which point: the flange or the origin of a joint's frame; from
    # which axis, 0 being the first one
    "abb-irb1200-5-90": (901, 5, 0),
    "aubo-i10": (1350, 5, 2),
    "aubo-i5": (886.5, 6, 2),
    "denso-vs060": (605, 5, 0),
    "doosan-m1013": (1300, FLANGE, 2),
    "fanuc-lrmate200id": (717, 5, 0),
    "kinova-gen3": (902, FLANGE, 2),
    "kuka-iiwa14-r820": (820, 6, 2),
    "kuka-kr10-r1100-2": (1101, 5, 0),
    "kuka-kr6-r900": (901.5, 5, 0),
    "staubli-tx2-60": (670, FLANGE, 0),
    "techman-tm5-900": (946, 5, 2),
    "ur10": (1300, 6, 2),
    "ur20": (1750, 6, 2),
    "ur30": (1300, 6, 2),
    "yaskawa-gp7": (927, 5, 0),
    "yaskawa-hc10": (1200, 4, 0),
}
ELSEWHERE = {  # compared with published poses or chains in test_kinematics.py, or below
    "ur3", "ur3e", "ur5", "ur5e", "ur10e", "ur16e", "franka-panda", "franka-fr3",
    "abb-gofa-crb15000-5", "fanuc-crx10ial", "ufactory-xarm6",
}  # fmt: skip


def farthest(arm, of, start):
    """Return how far a point gets from an axis, across it [mm]."""

    def near(joints):
        directions, points = arm.axes(joints)
        end = arm.flange(joints)[:3, 3] if of is FLANGE else points[of - 1]
        axis = max(start, 1) - 1
        return -np.linalg.norm(np.cross(end - points[axis], directions[axis]))

    bounds = list(zip(arm.lower, arm.upper, strict=True))
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, (8, arm.n))
    found = [minimize(near, np.clip(s, arm.lower, arm.upper), bounds=bounds) for s in starts]
    return -1e3 * min(f.fun for f in found)


@pytest.mark.parametrize("name", REACH)
def test_the_reach_is_the_data_sheets(name: str) -> None:
    published, of, start = REACH[name]
    assert farthest(Arm(load_model("robots", name)), of, start) == pytest.approx(published, abs=1.5)


def test_every_arm_is_compared_with_something() -> None:
    assert set(model_names("robots")) == REACH.keys() | ELSEWHERE


def test_crx_reaches_its_1418_mm_stretched() -> None:
    flange = Arm(load_model("robots", "fanuc-crx10ial")).flange(np.radians([0, 0, 90, 0, 0, 0]))
    assert 1e3 * np.linalg.norm(flange[:3, 3]) == pytest.approx(1418, abs=1.5)


def test_gofa_reaches_its_950_mm_with_the_wrist_straight() -> None:
    arm = Arm(load_model("robots", "abb-gofa-crb15000-5"))
    joints = np.radians([0, 90, -np.degrees(np.arctan2(470, 190)) + 0.0, 0, 0, 0])
    axis_6 = arm.axes(joints)[1][5] - arm.flange(joints)[:3, :3] @ [0, 0, 0.101]
    assert 1e3 * np.hypot(*axis_6[:2]) == pytest.approx(950, abs=1.5)


@pytest.mark.parametrize(
    ("name", "position"),
    [
        ("ur3", (-456.9, -194.25, 66.55)),
        ("ur16e", (-838.4, -290.7, 60.85)),
        ("ufactory-xarm6", (207, 0, 112)),
    ],
)
def test_the_flange_at_zero(name: str, position: tuple[Any, ...]) -> None:
    """UR: sums of the published lengths. xArm6: what its controller shows at zero."""
    flange = Arm(load_model("robots", name)).flange(np.zeros(6))
    assert 1e3 * flange[:3, 3] == pytest.approx(position, abs=0.1)


def test_an_fr3_is_as_long_as_a_panda() -> None:
    panda, fr3 = (load_model("robots", f"franka-{name}") for name in ("panda", "fr3"))
    joints = np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])
    assert np.array_equal(Arm(panda).flange(joints), Arm(fr3).flange(joints))
    assert np.degrees(Arm(fr3).upper[3]) == pytest.approx(-8.7, abs=0.1)


@pytest.mark.parametrize("kind", ["robots", "scanners"])
def test_every_model_is_read_and_says_its_source(kind: Any) -> None:
    for name in model_names(kind):
        model = load_model(kind, name)
        assert model.model == name
        assert len(model.source) > 40
