"""The true world of a weld: each of its parts does what it is told, and the controller sees none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.errors import RecipeError
from flangeye.files.paths import bundled
from flangeye.models.model import read_model
from flangeye.motion.seam_following import Command, ToolPose
from flangeye_emulators.weld_world.groove import Gap, Groove, GrooveSection, Tip, TipContact
from flangeye_emulators.weld_world.truth import (
    ArmTruth,
    ClockTruth,
    FingerTruth,
    HeatTruth,
    Tack,
    ToolTruth,
    WeldTruth,
    WorkpieceTruth,
)
from flangeye_emulators.weld_world.world import (
    ArmError,
    ArmResponse,
    ImageQueue,
    SeamDistortion,
    TrueFinger,
    TrueTool,
    true_groove,
)
from flangeye_plugins.weld.path import Path
from tools.weld_bench import SECTION, try_condition
from tools.weld_conditions import CONDITIONS, Condition

LINE = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
TORCH = np.array([-40e-3, 0.0, 0.0])
RNG = np.random.default_rng


def pose(x=0.0, y=0.0, z=0.0, time=0.0, angle=0.0):
    return ToolPose(time, np.array([x, y, z]), angle)


def test_the_arm_follows_late_and_lagging() -> None:
    truth = ArmTruth(lag=0.1, dead_time=0.05)
    arm = ArmResponse(truth, pose(), 10e-3)
    travelled = []
    for _ in range(100):
        arm.go(Command(np.array([0.01, 0.0, 0.0]), 0.0))
        travelled.append(arm.pose.position[0])
    assert travelled[4] == 0.0
    assert travelled[5] > 0.0
    # At constant speed it is behind by lag plus dead time.
    assert 0.01 - travelled[-1] == pytest.approx(0.01 * 0.15, rel=0.05)


def test_the_arm_is_not_where_it_says() -> None:
    backlash = ArmError(ArmTruth(backlash=0.1e-3), RNG(0))
    ways = [0.0, 1e-3, 2e-3, 1.95e-3, 1e-3]
    off = [backlash.true_pose(pose(y=y)).position[1] - y for y in ways]
    np.testing.assert_allclose(off, [0, -5e-5, -5e-5, 0, 5e-5], atol=1e-12)
    sag = ArmError(ArmTruth(sag=0.5e-3, scale=1e-3), RNG(0))
    sag.true_pose(pose())
    moved = sag.true_pose(pose(x=0.1)).position
    np.testing.assert_allclose(moved, [0.1001, 0.0, -0.5e-3], atol=1e-12)
    wave = ArmError(ArmTruth(wave=0.3e-3), RNG(0))
    aside = [wave.true_pose(pose(x=x)).position[1] for x in np.linspace(0, 0.16, 400)]
    assert np.ptp(aside) == pytest.approx(0.6e-3, rel=0.01)


def test_the_tool_is_where_the_world_has_it() -> None:
    tool = TrueTool(ToolTruth(tip=(1e-3, 0.0, 2e-3), torch=(0.0, 0.5e-3)), TORCH)
    np.testing.assert_allclose(
        tool.rest(pose(angle=np.pi / 2), np.eye(3)), [0, 1e-3, 2e-3], atol=1e-12
    )
    np.testing.assert_allclose(tool.torch(pose(), np.eye(3)), [-40e-3, 0.5e-3, 2e-3], atol=1e-12)
    turned = TrueTool(ToolTruth(yaw=np.pi / 180), TORCH)
    assert turned.torch(pose(), np.eye(3))[1] == pytest.approx(-40e-3 * np.sin(np.pi / 180))


def test_the_finger_shows_less_and_later_than_it_feels() -> None:
    play = TrueFinger(FingerTruth(play=0.4e-3))
    shown = [
        play.shown(t, np.array([0.0, y, 0.0]))[1] for t, y in enumerate([1e-3, -1e-3, -0.7e-3])
    ]
    np.testing.assert_allclose(shown, [0.8e-3, -0.8e-3, -0.8e-3])
    gain = TrueFinger(FingerTruth(gain=0.1, drift=0.6, rest=(0.0, 0.1e-3, 0.0)))
    assert gain.shown(0.0, np.zeros(3))[1] == pytest.approx(0.1e-3)
    assert gain.shown(10.0, np.array([0, 1e-3, 0]))[1] == pytest.approx(0.1e-3 + 1.2e-3)
    soft = TrueFinger(FingerTruth(creep=0.1))
    values = [soft.shown(t, np.array([0, 1e-3, 0]))[1] for t in range(100)]
    assert values[0] == pytest.approx(1e-3)
    assert values[-1] == pytest.approx(1.1e-3, rel=1e-3)
    loop = TrueFinger(FingerTruth(hysteresis=0.2))
    up = loop.shown(0.0, np.array([0, 3e-3, 0]))[1]
    loop.shown(1.0, np.array([0, 6e-3, 0]))
    assert loop.shown(2.0, np.array([0, 3e-3, 0]))[1] - up == pytest.approx(0.4e-3)


def test_images_are_late_lost_and_wrongly_stamped() -> None:
    truth = ClockTruth(rate=100, latency=0.05, jitter=0.0, stamp=0.02, dropped=0)
    shutter: ImageQueue[str] = ImageQueue(truth, RNG(0))
    assert shutter.due(0.0)
    assert not shutter.due(0.005)
    shutter.expose(1.0, "image")
    assert shutter.arrived(1.04) is None
    assert shutter.arrived(1.06) == (1.02, "image")
    lossy: ImageQueue[int] = ImageQueue(ClockTruth(dropped=0.5), RNG(0))
    for i in range(200):
        lossy.expose(float(i), i)
    assert 70 < sum(lossy.arrived(1e9) is not None for _ in range(200)) < 130


def test_the_workpiece_is_not_its_cad() -> None:
    truth = WorkpieceTruth(
        wave=1e-3, wave_length=20e-3, bow=2e-3, root_gap=1e-3, tacks=(Tack(50e-3),)
    )
    groove = true_groove(Path(LINE), SECTION, truth, RNG(0))
    aside = groove.root.points[:, 1]
    assert 2e-3 < aside.max() < 3e-3
    low, high = groove.relief.at(0.02)[0], groove.relief.at(0.054)[0]
    assert low == pytest.approx(-0.5e-3 / np.tan(SECTION.half_angle))
    assert high - low == pytest.approx(1e-3)
    rough = true_groove(Path(LINE), SECTION, WorkpieceTruth(spatter=0.1e-3), RNG(0))
    assert np.std(rough.relief.fill) == pytest.approx(0.1e-3 * 0.8, rel=0.2)


def test_heat_moves_the_seam_as_a_whole_and_near_the_torch() -> None:
    whole = SeamDistortion(HeatTruth(shift=2e-3), 0.1)
    assert whole.at(0.05, -0.01) == 0.0
    assert whole.at(0.09, 0.05) == pytest.approx(1e-3)
    near = SeamDistortion(HeatTruth(local=1e-3), 0.1)
    assert near.at(0.05, 0.05) == pytest.approx(1e-3)
    assert near.at(0.09, 0.05) < 0.05e-3


def test_friction_holds_a_tip_on_a_wall_and_on_the_face() -> None:
    groove = Groove(Path(LINE), SECTION)
    seat = 1.5e-3 / np.sin(SECTION.half_angle)

    def settled(friction, ways, height):
        contact = TipContact(groove, Tip(friction=friction))
        return [contact.settle(np.array([0.1, y, height]))[1] for y in ways]

    assert settled(0.0, [2e-3], seat - 0.3e-3)[-1] > settled(0.2, [2e-3], seat - 0.3e-3)[-1] > 0
    back_and_forth = settled(0.2, [3e-3, 2.9e-3], seat - 0.3e-3)
    assert back_and_forth[0] == back_and_forth[1]  # it sticks
    on_face = settled(0.2, [14e-3, 14.15e-3], SECTION.depth + 1e-3)
    assert on_face[0] == 14e-3
    # Pressed by 0.5 mm, 1 N: friction holds it until the spring across is displaced by 0.2 mm.
    assert on_face[1] == 14e-3


@pytest.mark.parametrize(
    ("name", "rms"),
    [
        ("tool yaw 1 deg", 0.698e-3),
        pytest.param("torch 0.5 mm aside", 0.5e-3, marks=pytest.mark.slow),
    ],
)
def test_the_torch_is_scored_where_it_truly_is(name: str, rms: float) -> None:
    told = CONDITIONS[name]
    trial = try_condition(Condition(told.truth, {}, (0.0, 0.0)), seed=0, length=0.06, period=16e-3)
    assert np.sqrt(np.mean(trial.errors**2)) == pytest.approx(rms, rel=0.1)


def test_a_world_is_a_file_of_its_own(tmp_path) -> None:
    """As the bundled ones are; with units, and nothing in it that no world has."""
    known = {path.stem: read_model(path, WeldTruth) for path in bundled("data").glob("worlds/*")}
    assert len(known) == 6 and all(each.clock.rate == 15.0 for each in known.values())
    assert known["tip_astray"].tool.tip == (1.5e-3, 0.8e-3, -1e-3)
    assert known["wall_missing"].workpiece.gaps == (Gap(90e-3, 110e-3, 1),)
    own = tmp_path / "own.yaml"
    own.write_text("arm: {lag: 0.1 s}\nworkpiece: {tacks: [{start: 30 mm}], half_angle: 2 deg}\n")
    truth = read_model(own, WeldTruth)
    assert truth.arm == ArmTruth(lag=0.1) and truth.finger == FingerTruth()
    assert truth.workpiece == WorkpieceTruth(half_angle=np.radians(2.0), tacks=(Tack(30e-3),))
    for wrong, told in (
        ("arm: {lagg: 1 s}", r"own.yaml:1: arm.lagg: unknown key 'lagg'; did you mean 'lag'?"),
        ("arm: {lag: 60}", "has no unit: a duration needs one"),
        ("workpiece: {gaps: [{start: 1 mm, end: 2 mm, side: 0}]}", "side"),
        ("workpiece: {tacks: [{begin: 1 mm}]}", r"'begin' \(allowed: start, height\)"),
    ):
        own.write_text(wrong)
        with pytest.raises(RecipeError, match=told):
            read_model(own, WeldTruth)


NARROW = GrooveSection(np.pi / 6, 8e-3)
SEAT = 1.5e-3 / np.sin(np.pi / 6)


def energy(tip, position, rest):
    off = position - rest
    return tip.lateral * off[1] ** 2 + tip.axial * off[2] ** 2


@given(st.floats(-3e-3, 3e-3), st.floats(-3e-3, 4e-3))
def test_the_tip_takes_the_place_of_least_energy_between_the_walls(
    across: float, up: float
) -> None:
    tip = Tip(friction=0.0)
    contact = TipContact(Groove(Path(LINE), NARROW), tip)
    rest = np.array([0.06, across, SEAT + up])
    found = contact.settle(rest)
    y = np.linspace(-5e-3, 5e-3, 2001)
    floor = SEAT + np.abs(y) / np.tan(NARROW.half_angle)
    height = np.maximum(floor, rest[2])
    least = (tip.lateral * (y - rest[1]) ** 2 + tip.axial * (height - rest[2]) ** 2).min()
    assert found[2] >= SEAT + abs(found[1]) / np.tan(NARROW.half_angle) - 1e-9
    assert energy(tip, found, rest) <= least + 1e-9


def test_the_tip_lags_by_friction_and_no_more() -> None:
    tip = Tip(friction=0.1)
    contact = TipContact(Groove(Path(LINE), NARROW), tip)
    for x in np.arange(0.02, 0.03, 1e-4):
        found = contact.settle(np.array([x, 1e-3, SEAT - 1e-3]))
    normal = np.hypot(tip.lateral * 1e-3, tip.axial * 1e-3)
    assert x - found[0] == pytest.approx(0.1 * normal / tip.lateral, rel=1e-6)


def test_outside_the_workpiece_and_on_its_face_the_tip_is_free() -> None:
    contact = TipContact(Groove(Path(LINE), NARROW), Tip())
    np.testing.assert_array_equal(contact.settle(np.array([-0.01, 0, 0.0])), [-0.01, 0, 0])
    on_top = contact.settle(np.array([0.05, 8e-3, 5e-3]))
    np.testing.assert_allclose(on_top[1:], [8e-3, 8e-3 + 1.5e-3], atol=1e-9)
