"""Whether a flat part is the flange, by its size, rim, bore, plate and tilt."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.maths.planes import Plane
from flangeye.models.loading import load_model
from flangeye.models.targets import wrist_circle_of
from flangeye.types.geometry import basis_of_plane
from flangeye_plugins.segment import flange as choice
from flangeye_plugins.segment.discs import (
    Disc,
    DiscLimits,
    PlanarPiece,
    compare,
    incidence,
    of_size,
    rim_ratio,
    ring_shares,
    width,
)
from flangeye_plugins.segment.flange import SegmentParams, _piece, _scatter, choose
from flangeye_plugins.segment.grid import Grid
from flangeye_plugins.segment.scale import check_scale
from tests.plugins.bounds import check_bound
from tests.plugins.segment.test_choice import BORE, UR5

WRIST = wrist_circle_of(load_model("robots", "ur10e").flange, 0.09)
PITCH = 1e-3
AT = np.array([0.0, 0.0, 0.6])
FACING = Plane(AT, np.array([0.0, 0.0, -1.0]), 1e-5)
LIMITS = DiscLimits(incidence=np.radians(55), coverage=0.3, crease=0.8e-3)


def ring(inner, outer, height=0.0, arc=2 * np.pi) -> np.ndarray:
    """Return (N, 3) points of a ring that faces the scanner, so high before the plane."""
    ticks = np.arange(-outer, outer + PITCH / 2, PITCH / 2)
    flat = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    reach, angle = np.hypot(*flat.T), np.arctan2(flat[:, 1], flat[:, 0]) % (2 * np.pi)
    flat = flat[(reach <= outer) & (reach >= inner) & (angle <= arc)]
    return AT + np.column_stack([flat, np.full(len(flat), -height)])


def disc(points, plane=FACING, flange=UR5) -> Disc:
    part = PlanarPiece(plane, points.astype(np.float32), np.arange(len(points)))
    return of_size(part, (10, 20), PITCH, flange)


def compared(points, nearby=None, flange=UR5, **limits) -> Disc:
    nearby = points if nearby is None else nearby
    return compare(
        disc(points, flange=flange), points, nearby, PITCH, flange, LIMITS._replace(**limits)
    )


def test_the_width_is_the_largest_over_all_directions() -> None:
    corners = np.array([[0.0, 0.0], [0.06, 0.0], [0.0, 0.08], [0.06, 0.08]])
    assert width(corners) == pytest.approx(0.1, rel=0.004)  # within 5 deg of the diagonal
    for angle in np.radians([0, 35, 90, 125, 170]):
        line = np.outer([-0.05, 0.05], [np.cos(angle), np.sin(angle)])
        assert width(line) == pytest.approx(0.1, rel=0.004)


@pytest.mark.parametrize("turn", [0.0, 20.0, 70.0])
def test_the_incidence_is_the_angle_to_the_line_of_sight(turn: float) -> None:
    sight = np.array([0.2, -0.1, 0.7]) / np.linalg.norm([0.2, -0.1, 0.7])
    normal = -np.cos(np.radians(turn)) * sight + np.sin(np.radians(turn)) * basis_of_plane(sight)[0]
    assert np.degrees(incidence(0.6 * sight, normal)) == pytest.approx(turn, abs=1e-6)


def test_what_faces_the_scanner_has_no_incidence_whatever_is_rounded() -> None:
    for centre in np.random.default_rng(0).uniform(0.1, 1.0, (300, 3)):
        assert incidence(centre, -centre / np.linalg.norm(centre)) < 1e-7


def test_a_part_is_of_the_flanges_size_or_its_width_is_its_flaw() -> None:
    whole = disc(ring(0, UR5.rim))
    assert whole.flaw is None and whole.rank == 0 and whole.seen == 0
    assert whole.across == pytest.approx(2 * UR5.rim, abs=PITCH)
    assert whole.centre == pytest.approx(AT, abs=PITCH)
    largest, smallest = 2 * UR5.outer + 4 * PITCH, UR5.rim / 4
    along = basis_of_plane(FACING.normal)[0]
    for wide, fits in (
        (largest - 1e-4, True), (largest + 1e-4, False),
        (smallest + 1e-4, True), (smallest - 1e-4, False),
    ):  # fmt: skip
        flaw = disc(AT + np.outer([-wide / 2, 0, wide / 2], along)).flaw
        assert flaw == (None if fits else f"{1e3 * wide:.0f} mm across")


@pytest.mark.parametrize(("arc", "share"), [(2 * np.pi, 1.0), (np.pi, 0.5)])
def test_the_rims_centre_and_what_is_seen_of_it_and_of_the_bore(arc: float, share: float) -> None:
    flat = ring(BORE, UR5.rim, arc=arc)[:, :2]
    start = np.array([2e-3, 3e-3])
    centre, shares = ring_shares(flat, start, PITCH, UR5)
    assert np.linalg.norm(centre) < 0.6e-3
    assert shares == pytest.approx([share, share], abs=0.07)
    _, shares = ring_shares(ring(0, UR5.rim)[:, :2], start, PITCH, UR5)
    assert shares == [1.0, 0.0]
    _, shares = ring_shares(ring(BORE, UR5.rim - 8 * PITCH)[:, :2], 0 * start, PITCH, UR5)
    assert shares[0] < 0.3


def test_a_disc_of_another_size_is_told_by_its_likelihood() -> None:
    """30 % of its edge may lie on the flange's rim about some centre; all of it on its own."""
    start = np.zeros(2)
    ratio, other = rim_ratio(ring(BORE, UR5.rim)[:, :2], start, PITCH, UR5.rim)
    assert other is None and ratio > 50
    flat = ring(BORE, 0.8 * UR5.rim)[:, :2]
    aside = np.array([0.2 * UR5.rim, 0.0])  # where the flange's rim touches it
    ratio, other = rim_ratio(flat, aside, PITCH, UR5.rim)
    assert other == pytest.approx(0.8 * UR5.rim, abs=PITCH)
    assert ratio < -50
    found = compared(ring(BORE, 0.8 * UR5.rim), coverage=0.01)
    assert found.rank == 1 and found.flaw is not None
    assert "has a rim of 48.6 mm rather than a rim of 61.0 mm (log likelihood" in found.flaw
    half = rim_ratio(ring(BORE, UR5.rim, arc=0.7 * np.pi)[:, :2], start, PITCH, UR5.rim)
    assert half[0] > 5


def test_an_edge_of_no_circle_is_no_rim_however_much_of_it_is_near_one() -> None:
    """Three of ten sectors on the rim, as the coverage asks, the others anywhere inside it."""
    rng = np.random.default_rng(20)
    flat = ring(BORE, UR5.rim)
    angle = np.arctan2(flat[:, 1], flat[:, 0]) % (2 * np.pi)
    ends = UR5.rim * np.where(rng.random(48) < 0.7, rng.uniform(0.45, 0.9, 48), 1.0)
    cut = flat[np.linalg.norm(flat[:, :2], axis=1) < ends[(angle * 48 / (2 * np.pi)).astype(int)]]
    found = compared(cut, coverage=0.01)
    assert found.ratio <= 0
    assert found.flaw is not None and "a rim of 61.0 mm (log likelihood ratio" in found.flaw


def test_what_fits_has_no_flaw_and_got_farthest() -> None:
    found = compared(ring(BORE, UR5.rim))
    assert (found.flaw, found.rank) == (None, 4)
    assert found.seen == pytest.approx(1.0, abs=0.02)
    assert found.centre == pytest.approx(AT, abs=0.5e-3)


def test_a_disc_says_what_is_wrong_with_it() -> None:
    half = compared(ring(BORE, UR5.rim, arc=np.pi), coverage=0.8)
    assert half.rank == 1 and half.flaw is not None
    assert half.flaw.endswith("% of a rim of 61.0 mm, at least 80% is needed")
    blind = compared(ring(0, UR5.rim))
    assert (blind.rank, blind.flaw) == (
        1, "a disc 61 mm across has 0% of a bore of 33.0 mm, at least 30% is needed",
    )  # fmt: skip
    aside = np.array([0.4, 0.0, 0.0])
    steep = compared(ring(BORE, UR5.rim) + aside, incidence=np.radians(30))
    assert (steep.rank, steep.flaw) == (3, "incidence 34 deg over the limit of 30 deg")


@pytest.mark.parametrize(
    ("height", "flaw"),
    [(1.0, None), (0.55, None), (1.45, None), (0.4, 0.4), (1.6, 1.6), (-1.0, -1.0)],
)
def test_before_a_wrist_circle_stands_its_plate(height: float, flaw: float | None) -> None:
    """Within half its thickness, from where it has ended to the rim."""
    thickness = 1e3 * WRIST.details.thickness
    circle = ring(0.87 * WRIST.rim, WRIST.rim)
    plate = ring(0, 0.7 * WRIST.rim, height=height * WRIST.details.thickness)
    found = compared(circle, np.concatenate([circle, plate]), WRIST)
    said = None if flaw is None else (
        f"a disc 90 mm across has no plate {thickness:.1f} mm in front of it; its middle is {flaw * thickness:.1f} mm out"
    )  # fmt: skip
    assert (found.flaw, found.rank) == (said, 4 if flaw is None else 2)


def test_a_plate_stands_before_its_circle_wherever_the_disc_has_its_plane() -> None:
    thickness = WRIST.details.thickness
    circle = ring(0.87 * WRIST.rim, WRIST.rim)
    nearby = np.concatenate([circle, ring(0, 0.7 * WRIST.rim, height=thickness)])
    for behind in (-0.4, 0.4):
        plane = FACING._replace(point=AT + [0, 0, behind * thickness])
        found = disc(circle, plane, WRIST)
        assert compare(found, circle, nearby, PITCH, WRIST, LIMITS).flaw is None


def test_what_stands_out_by_more_than_twice_the_plate_is_none() -> None:
    thickness = WRIST.details.thickness
    circle, plate = ring(0.87 * WRIST.rim, WRIST.rim), ring(0, 0.7 * WRIST.rim, height=thickness)
    cable = ring(0, 0.7 * WRIST.rim, height=2.1 * thickness)
    nearby = np.concatenate([circle, plate, cable, cable + [0, 0, 1e-4]])
    assert compared(circle, nearby, WRIST).flaw is None


def test_a_plate_that_is_not_seen_is_not_missed() -> None:
    circle = ring(0.87 * WRIST.rim, WRIST.rim)
    assert compared(circle, flange=WRIST).flaw is None
    plate = ring(0.55 * WRIST.rim, 0.6 * WRIST.rim)  # of no height: there is none
    for rim, middle, flaw in ((10, 10, True), (10, 9, False), (9, 10, False)):
        found = compared(circle, np.concatenate([circle[:rim], plate[:middle]]), WRIST)
        assert (found.flaw is not None) is flaw


def scored(seen: float, x: float = 0.0) -> Disc:
    return disc(ring(0, WRIST.rim), flange=WRIST)._replace(
        seen=seen, rank=4, centre=AT + [x, 0.0, 0.0]
    )


@pytest.mark.parametrize(
    ("discs", "chosen"),
    [
        ([scored(0.9), scored(0.53, 0.2)], 0.9),
        ([scored(0.3), scored(0.8, 0.2)], 0.8),
        ([scored(0.5), scored(0.9, 0.04)], 0.9),  # at one place
        ([scored(0.21)], 0.21),
        ([scored(0.9), scored(0.95, 0.2)._replace(flaw="steep")], 0.9),
    ],
)
def test_the_disc_that_is_seen_clearly_best_is_the_flange(discs: Any, chosen: float) -> None:
    found = choose(discs, lambda d: np.full((1, 3), d.seen, np.float32), WRIST)
    assert not isinstance(found, str), found
    assert found[0].seen == chosen
    assert found[1][0, 0] == np.float32(chosen)  # its own points


@pytest.mark.parametrize(
    ("discs", "said"),
    [
        ([], "no flat surface in sight"),
        ([scored(0.9), scored(0.6, 0.2)],
         "2 discs look like the flange: at (0, 0, 600) mm and (200, 0, 600) mm; hide all but "
         "one, or narrow near and far"),
        ([scored(0.1)], "a disc 90 mm across with a bore has no threaded holes"),
        ([scored(0.1)._replace(flaw="low", rank=1), scored(0.2)._replace(flaw="high", rank=2)],
         "high"),
        ([scored(0.1)._replace(flaw="one", rank=1), scored(0.2)._replace(flaw="better", rank=1)],
         "better"),
        ([scored(0)._replace(across=a, flaw=f"{a:.2f}", rank=0) for a in (0.04, 0.16, 0.3)],
         "no plane of the flange's size: nearest candidate 0.16, flange 90 mm"),
    ],
)  # fmt: skip
def test_why_none_is_the_flange(discs: Any, said: str) -> None:
    assert choose(discs, lambda d: np.zeros((1, 3), np.float32), WRIST) == said


def test_a_face_whose_holes_cannot_be_told_is_taken_for_want_of_another() -> None:
    blank = disc(ring(0, UR5.rim))._replace(rank=4)
    found = choose([blank], lambda d: np.zeros((0, 3), np.float32), UR5)
    assert not isinstance(found, str) and found[0] is blank


@pytest.mark.parametrize(
    ("depth", "unit"),
    [(29.9, None), (30.1, "unit mm"), (0.01, None), (0.0101, None), (0.0099, "unit m")],
)
def test_a_depth_is_between_a_centimetre_and_thirty_metres(depth: float, unit: str | None) -> None:
    xyz = np.full((500, 600, 3), np.nan)
    xyz[::2] = [1e-4, 50.0, depth]
    if unit is None:
        check_scale(xyz, "a")
        return
    with pytest.raises(StageError, match=f"state {unit} where"):
        check_scale(xyz, "a")


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("near", "-1 mm", "0 mm"), ("far", "0 mm", "1 mm"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(name: str, refused: Any, taken: Any) -> None:
    check_bound(SegmentParams, name, refused, taken)


def test_what_is_flat_scatters_by_noise_and_a_plate_whose_step_noise_hides() -> None:
    step = WRIST.details.thickness
    hides = step / (5 * np.sqrt(6))
    for flange, noise, scatter in (
        (UR5, 5e-5, 3e-4),  # no scanner is better over a whole face
        (UR5, 4e-4, 1.2e-3),
        (UR5, 1.1 * hides, 3.3 * hides),
        (WRIST, 0.9 * hides, 2.7 * hides),
        (WRIST, 1.1 * hides, 3.3 * hides + step),
    ):
        assert _scatter(flange, noise) == pytest.approx(scatter)


@pytest.mark.parametrize(("side", "points"), [(4.6, 5), (1.0, 3)])
def test_patches_are_squares_of_three_points_at_least(side: float, points: int) -> None:
    depth = 0.5 * UR5.rim / (1e-3 * side)
    view = Grid(np.full((20, 30, 3), depth, np.float32), 1e-3, None)
    patch = _piece(view, np.arange(600), UR5).patches(np.arange(600)).reshape(20, 30)
    rows, columns = np.indices((20, 30)) // points
    assert len(np.unique(patch)) == len(np.unique(rows)) * len(np.unique(columns))
    for r, c in ((0, 0), (1, 2)):
        assert len(np.unique(patch[(rows == r) & (columns == c)])) == 1


def test_holes_are_looked_for_in_the_discs_plane_about_its_centre(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three times its scatter before and behind, wherever the plane has its own point."""
    plane = Plane(AT + [0.1, -0.2, 0.0], np.array([0.0, 0.0, -1.0]), 1e-4)
    at = np.array([[0.02, 0.01, 2.9e-4], [-0.03, 0.0, -2.9e-4], [0.0, 0.0, 3.2e-4], [0, 0, -1.0]])
    seen: list[Any] = []

    def holes(flat: Any, flange: Any) -> Any:
        seen.append(flat)
        return SimpleNamespace(score=0.7)

    monkeypatch.setattr(choice, "match_holes", holes)
    one = disc(ring(BORE, UR5.rim))._replace(plane=plane, centre=AT)
    assert choice._hole_score(one, (AT + at).astype(np.float32), UR5) == 0.7
    (flat,) = seen
    assert np.linalg.norm(flat, axis=1) == pytest.approx([np.hypot(0.02, 0.01), 0.03], abs=1e-6)
    monkeypatch.setattr(choice, "match_holes", lambda *_: None)
    assert choice._hole_score(one, AT[None].astype(np.float32), UR5) == choice.BLANK
