"""Where the tip rests in a joint, what holds it there, and how a leaning tool stands."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.models.finger import Finger
from flangeye.types.geometry import rotation_from_rpy
from flangeye_emulators.weld_world.groove import Groove, GrooveSection, Tip, TipContact
from flangeye_plugins.weld.checks import check_body, check_seat
from flangeye_plugins.weld.following.model_prior import body_of, model_prior_of
from flangeye_plugins.weld.frame import body_from, leaning
from flangeye_plugins.weld.joint import WeldJoint, edges_half_angle, joint_of
from flangeye_plugins.weld.path import Path
from tests.plugins.weld import cell
from tests.plugins.weld.bench import following
from tools.weld_bench import FINGER, try_condition
from tools.weld_conditions import CONDITIONS

SHORT = 0.07
RADIUS = 1.5e-3
LINE = Path(np.array([[0.0, 0, 0], [0.1, 0, 0]]))


def believed(**given):
    settings = following(**given)
    finger = Finger.model_validate(FINGER)
    return model_prior_of(finger, body_of(finger, settings), None, settings), settings


@pytest.mark.parametrize("half_angle", [30.0, 45.0, 60.0])
@pytest.mark.parametrize("lean", [-45.0, 0.0, 20.0])
def test_a_seated_ball_is_one_radius_away_from_both_walls(half_angle: float, lean: float) -> None:
    joint = WeldJoint(*np.radians([half_angle, lean]))
    across, up = joint.seat(RADIUS)
    left = -np.cos(joint.left) * across + np.sin(joint.left) * up
    right = np.cos(joint.right) * across + np.sin(joint.right) * up
    np.testing.assert_allclose([left, right], RADIUS)


@pytest.mark.parametrize(("half_angle", "lean"), [(0.7, 0.3), (0.5, -0.4), (np.pi / 4, -np.pi / 4)])
def test_a_seat_moves_with_either_wall_by_no_more_than_is_stated(
    half_angle: float, lean: float
) -> None:
    joint, step = WeldJoint(half_angle, lean), 1e-7
    seats = [WeldJoint(half_angle + step / 2, lean + s * step / 2).seat(RADIUS)[0] for s in (1, -1)]
    most = np.abs(np.array(seats) - joint.seat(RADIUS)[0]).max() / step
    assert joint.seat_slope(RADIUS) == pytest.approx(most, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "half_angle", "side", "gap", "walls"),
    [
        ("fillet", None, 1.0, 0.0, (0, 90)), ("lap", None, -1.0, 0.0, (90, 0)),
        ("corner", None, 1.0, 0.0, (45, 45)), ("groove", None, 1.0, 1e-3, None),
        ("fillet", np.radians(40), 1.0, 0.0, (40, 40)),  # the plan knows better
        ("butt", None, 1.0, 0.0, None), ("butt", None, 1.0, 2 * RADIUS, None),
        ("butt", None, 1.0, np.sqrt(2) * RADIUS, (45, 45)),
    ],
)  # fmt: skip
def test_the_walls_of_a_joint_follow_from_its_kind(kind, half_angle, side, gap, walls) -> None:
    joint = joint_of(kind, half_angle, side, RADIUS, gap)
    found = None if joint is None else np.degrees([joint.left, joint.right])
    assert found == (None if walls is None else pytest.approx(walls))


def test_a_ball_on_two_edges_climbs_as_steeply_as_in_its_groove() -> None:
    """About the right edge, with the ball's centre turned from where it touches both."""
    gap, step = 1e-3, 1e-9
    up, raised = (np.sqrt(RADIUS**2 - (gap / 2 - aside) ** 2) for aside in (0.0, step))
    steep = 1 / np.tan(edges_half_angle(gap, RADIUS))
    assert (raised - up) / step == pytest.approx(steep, rel=1e-4)


def test_a_leaning_tool_still_heads_from_its_torch_to_its_tip() -> None:
    body = body_from(np.array([-0.04, 0.003, -0.01]), 0.5, 0.2)
    assert body.torch[1] == pytest.approx(0.0, abs=1e-15)
    assert np.linalg.norm(body.torch) == pytest.approx(np.linalg.norm([0.04, 0.003, 0.01]))
    np.testing.assert_allclose(leaning(0.5, 0.0)[:, 2], [0, -np.sin(0.5), np.cos(0.5)])
    np.testing.assert_allclose(leaning(0.0, 0.2)[:, 2], [np.sin(0.2), 0, np.cos(0.2)])


def test_springs_balance_on_the_wall_of_a_leaning_finger() -> None:
    """Against the least energy, sought on a grid of places along the wall."""
    contact = TipContact(
        Groove(LINE, GrooveSection(np.pi / 4, 0.02, -np.pi / 4)), Tip(friction=0.0)
    )
    axes = leaning(0.4, 0.0)
    stiff = axes @ np.diag([1000.0, 1000.0, 2000.0]) @ axes.T
    rest = np.array([0.05, 0.0, 0.5e-3])
    contact.settle(np.array([0.05, -5e-3, 1e-3]), 0.0, axes)
    rest[1] = -4e-3  # away from the upright wall: the ball lies on the plate
    found = contact.settle(rest, 0.0, axes)
    places = np.linspace(-6e-3, -RADIUS, 20001)
    off = np.stack([0 * places, places - rest[1], np.full(len(places), RADIUS - rest[2])])
    least = places[np.einsum("ik,ij,jk->k", off, stiff, off).argmin()]
    np.testing.assert_allclose(found[1:], [least, RADIUS], atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("T-fillet, upright tool", marks=pytest.mark.slow),
        "T-fillet, pressed on the right, upright tool",
        pytest.param("T-fillet, tool leans 40 deg away, 10 deg forwards", marks=pytest.mark.slow),
        pytest.param(
            "T-fillet, plates at 91 deg, tool leans 1 deg more than set", marks=pytest.mark.slow
        ),
        pytest.param("lap joint, plate of 5 mm, upright tool", marks=pytest.mark.slow),
        "lap joint, plate of 5 mm, tool leans 20 deg away",
        "butt joint, square edges, root gap 2.2 mm",
        "corner joint, open, tool leans 10 deg forwards",
        pytest.param("torch led 1 mm to the left", marks=pytest.mark.slow),
    ],
)
def test_the_torch_is_on_the_seam_of_every_joint(name: str) -> None:
    found = try_condition(CONDITIONS[name], 0, SHORT, 16e-3)
    assert found.done, found.controller.reason
    assert np.sqrt(np.mean(found.errors**2)) < 0.1e-3
    assert found.bounded


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"joint": "butt", "root_gap": "1 mm"}, "lower 'deflection' to 0.76 mm or raise"),
        ({"joint": "fillet", "friction": 0.6}, "friction may hold the tip off the wall: .* 1.11"),
    ],
)
def test_a_joint_that_would_not_hold_the_tip_is_refused(given, message: str) -> None:
    with pytest.raises(StageError, match=message):
        check_seat(*believed(**given))


def test_a_torch_lifted_off_the_seam_by_a_leaning_tool_is_refused() -> None:
    prior, settings = believed(travel_angle="20 deg")
    body = body_of(Finger.model_validate(FINGER), settings)
    with pytest.raises(StageError, match="its torch .13.7 mm above the seam.*torch_up"):
        check_body(body, prior, settings)


def test_a_leaning_tool_on_an_arm_and_a_fillet_on_an_inclined_plate() -> None:
    """The simulated finger knows the joint; the weld is told its kind alone."""
    turned = rotation_from_rpy(*np.radians([12.0, -8.0, 20.0])) @ cell.HERE[:3, :3].T
    flat = cell.planned("v-straight", (1e-3, 2e-3, 0.0), 0.01, end=0.06)
    seam = replace(
        flat, points_in_base=_about(flat.points_in_base, turned),
        openings_in_base=flat.openings_in_base @ turned.T,
    )  # fmt: skip
    report, _ = cell.run(
        seam, joint="fillet", work_angle="25 deg", preload="1.2 mm", speed="10 mm/s",
        sensor={"plate": "20 mm", "rpy": ["12 deg", "-8 deg", "20 deg"]},
    )  # fmt: skip
    assert report.completed, report.reason
    line = _about(cell.true_line("v-straight", 0.06), turned)
    along = line[-1] - line[0]
    along /= np.linalg.norm(along)
    across = np.cross(turned @ cell.HERE[:3, 2], along)
    torch = report.true_torch - line[0]
    beside = (torch @ along > 0.01) & (torch @ along < 0.055)
    assert beside.sum() > 50
    assert np.sqrt(np.mean((torch @ across)[beside] ** 2)) < 0.1e-3


def _about(points, rotation):
    """Points (N, 3) turned about where the workpiece lies."""
    return (points - cell.HERE[:3, 3]) @ rotation.T + cell.HERE[:3, 3]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_finger_s_noise_is_that_across_and_along_it_and_a_plate_stands_on_the_pressed_side(
    side: str,
) -> None:
    settings = following(joint="fillet", side=side)
    known = {
        "rest": ["0 mm"] * 3, "rotation": ["0 deg"] * 3, "gain": np.eye(3).tolist(),
        "noise": ["0.01 mm", "0.02 mm", "0.06 mm"], "source": "a test",
    }  # fmt: skip
    finger = Finger.model_validate({**FINGER, "calibration": known})
    prior = model_prior_of(finger, body_of(finger, settings), None, settings)
    assert prior.noise == pytest.approx((0.02e-3, 0.06e-3))
    bare = Finger.model_validate({k: v for k, v in FINGER.items() if k != "calibration"})
    unknown = model_prior_of(bare, body_of(bare, settings), None, settings)
    assert unknown.noise == (10e-6, 60e-6)
    assert (unknown.lateral, unknown.axial) == (1000.0, 2000.0)
    sign = 1.0 if side == "left" else -1.0
    assert prior.joint is not None and not prior.two_walls
    assert [prior.joint.left, prior.joint.right][:: int(sign)] == pytest.approx([0.0, np.pi / 2])
    assert prior.flat(sign) == pytest.approx(np.tan(np.radians(1.0)))
