"""Whether the tip still sits: a line through what was felt before, and how well it is known."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.types import Floats
from flangeye_plugins.weld.consistency import Seating, _newest_from, _Trail

RNG = np.random.default_rng(0)


def drawn(scatter: float = 1e-4) -> tuple[Floats, Floats]:
    """Return samples of a seam that goes aside and up, and five that are beyond them."""
    before = np.column_stack([np.linspace(0.0, 0.03, 25), np.zeros((25, 2))])
    before[:, 1:] = before[:, :1] * [0.1, -0.05] + scatter * RNG.standard_normal((25, 2))
    newest = np.column_stack([np.linspace(0.045, 0.047, 5), RNG.normal(0.0, 1e-3, (5, 2))])
    return before, newest


def test_the_newest_are_held_against_a_line_as_well_as_it_is_known_there() -> None:
    """The variance of the mean of so many predictions by least squares."""
    before, newest = drawn()
    at, count = newest[:, 0].mean(), len(before)
    for axis, (off, sigma) in zip((1, 2), _newest_from(before, newest), strict=True):
        slope, height = np.polyfit(before[:, 0], before[:, axis], 1)
        assert off == pytest.approx(newest[:, axis].mean() - (slope * at + height))
        left = before[:, axis] - (slope * before[:, 0] + height)
        variance = (left**2).mean()
        middle = before[:, 0].mean()
        spread = ((before[:, 0] - middle) ** 2).sum()
        share = 1 / 5 + 1 / count + (at - middle) ** 2 / spread
        assert sigma == pytest.approx(np.sqrt(variance * share))


def test_a_line_is_no_steeper_than_a_plan_is_wrong() -> None:
    before, newest = drawn(scatter=0.0)
    (aside, _), (lifted, _) = _newest_from(before, newest, (0.02, 0.01))
    ahead = newest[:, 0].mean() - before[:, 0].mean()
    mean = newest.mean(axis=0) - before.mean(axis=0)
    assert aside == pytest.approx(mean[1] - 0.02 * ahead)
    assert lifted == pytest.approx(mean[2] + 0.01 * ahead)
    exact = before.copy()
    assert _newest_from(exact, exact[-5:])[0] == pytest.approx((0.0, 0.0), abs=1e-9)


def test_samples_are_kept_until_they_are_far_behind_and_seen_between_8_and_45_mm() -> None:
    trail = _Trail(0.05)
    for i in range(3000):
        trail.add(1e-4 * i, float(i), -float(i))
    rows = trail.rows
    assert rows[-1].tolist() == [1e-4 * 2999, 2999.0, -2999.0]
    assert 0.0499 < rows[-1, 0] - rows[0, 0] <= 0.05 and len(rows) in (500, 501)
    away = 1e-4 * 2999 - trail.behind(1e-4 * 2999)[:, 0]
    assert away.min() == pytest.approx(8e-3, abs=1.1e-4) and away.min() > 8e-3
    assert away.max() == pytest.approx(45e-3, abs=1.1e-4) and away.max() < 45e-3
    trail.clear()
    assert len(trail.rows) == 0


def judged(aside: float, lifted: float, side: float = 1.0, flat: float = 1.0) -> str | None:
    """Return what is said of a tip that is aside and lifted at the end of a quiet seam [m]."""
    seating, said = Seating(side, flat), None
    for i in range(120):
        off = (aside, lifted) if i >= 115 else (0.0, 0.0)
        said = seating.judge(i * 2e-4, off[0], off[1])
        assert i >= 115 or said is None
    return said


@pytest.mark.parametrize(
    ("aside", "lifted", "side", "flat", "told"),
    [
        (0.0, 3.1e-3, 1.0, 1.0, "lifted out of the groove by 3.1 mm"),
        (0.0, 2.9e-3, 1.0, 1.0, None),
        (0.36e-3, 0.2e-3, 1.0, 1.0, "climbs the wall: 0.4 mm aside, 0.2 mm up"),
        (0.34e-3, 0.2e-3, 1.0, 1.0, None),  # too little aside
        (0.36e-3, 0.36e-3 * 0.34, 1.0, 1.0, None),  # too flat for a tip that climbs
        (0.36e-3, 0.36e-3 * 0.36, 1.0, 1.0, "climbs the wall: 0.4 mm aside, 0.1 mm up"),
        (0.36e-3, 0.36e-3 * 0.36, 1.0, 0.5, None),  # the wall is twice as steep
        (0.36e-3, 0.36e-3 * 0.72, 1.0, 0.5, "climbs the wall: 0.4 mm aside, 0.3 mm up"),
        (-0.5e-3, 0.4e-3, 1.0, 1.0, None),  # away from the pressed wall
        (-0.5e-3, 0.4e-3, -1.0, 1.0, "climbs the wall: 0.5 mm aside, 0.4 mm up"),
    ],
)  # fmt: skip
def test_a_tip_is_out_of_its_groove_that_is_lifted_or_climbs_its_wall(
    aside: float, lifted: float, side: float, flat: float, told: str | None
) -> None:
    said = judged(aside, lifted, side, flat)
    assert (told in said) if told and said else said is told


def test_nothing_is_said_of_a_tip_with_fewer_than_ten_samples_behind_it() -> None:
    for count, told in ((9, False), (10, True)):
        seating = Seating(1.0, 1.0)
        for i in range(count):
            seating.judge(1e-4 * i, 0.0, 0.0)
        said = [seating.judge(0.012 + 1e-4 * i, 0.0, 5e-3) for i in range(5)]
        assert (said[-1] is not None) == told
        seating.forget()
        assert seating.judge(0.02, 0.0, 9e-3) is None and seating.doubt == 0.0


def test_a_tip_is_doubted_by_the_lesser_of_what_it_went_aside_and_what_it_climbed() -> None:
    for aside, lifted, flat, doubt in (
        (0.2e-3, 0.5e-3, 1.0, 0.2e-3), (0.3e-3, 0.07e-3, 1.0, 0.2e-3), (0.3e-3, 0.07e-3, 0.5, 0.1e-3),
        (-0.2e-3, 0.5e-3, 1.0, 0.0),
    ):  # fmt: skip
        seating = Seating(1.0, flat)
        for i in range(120):
            seating.judge(i * 2e-4, *((aside, lifted) if i >= 119 else (0.0, 0.0)))
        # One of the newest five is aside; held against a line that knows no scatter.
        assert seating.doubt == pytest.approx(doubt / 5, rel=1e-6)


def test_a_tip_is_higher_for_long_when_it_was_so_for_two_centimetres_of_its_own_way() -> None:
    """Wherever on the seam it began, and by more than joints are uneven and plans tilted."""
    began = 0.2
    seating = Seating(1.0, 1.0)
    seating.seated(np.array([[began + 1e-5 * i, 0.0, 0.0] for i in range(40)]))
    felt = list[tuple[float, float]]()
    for away in np.arange(0.0, 0.03, 0.3e-3).tolist():
        assert seating.judge(began + away, 0.0, 2e-3) is None
        felt.append((away, seating.risen))
    assert all(risen == 0.0 for away, risen in felt if away < 19.9e-3)
    assert all(risen > 0.0 for away, risen in felt if away > 20.5e-3)
    # What the plan may be tilted by to the middle of those two centimetres is not told.
    away, risen = felt[-1]
    assert risen == pytest.approx((2e-3 - 0.02 * (away - 0.01)) / 0.35, rel=0.01)


@pytest.mark.parametrize(("count", "doubted"), [(9, False), (10, True)])
def test_a_tip_is_doubted_against_ten_samples_behind_it(count: int, doubted: bool) -> None:
    seating = Seating(1.0, 1.0)
    for i in range(count):
        seating.judge(1e-4 * i, 0.0, 0.0)
    seating.judge(0.012, 0.2e-3, 0.2e-3)
    assert (seating.doubt > 0.0) == doubted


def test_after_a_gap_the_tip_is_held_against_what_was_felt_before_it() -> None:
    """What is lifted and aside there may have climbed; how far behind it was seated matters not."""
    for gap, doubted in ((0.03, True), (0.05, False)):
        seating = Seating(1.0, 1.0)
        for i in range(100):
            seating.judge(1e-4 * i, 0.0, 0.0)
        seating.forget()
        for i in range(5):
            assert seating.judge(0.01 + gap + 1e-4 * i, 0.2e-3, 0.2e-3) is None
        assert (seating.doubt > 0.15e-3) == doubted


@pytest.mark.parametrize("seed", range(4))
def test_of_a_noisy_tip_many_samples_say_that_it_climbs(seed: int) -> None:
    """Five of them do not: their mean height is known to 0.15 mm, and it has risen by 0.5 mm."""
    rng = np.random.default_rng(seed)
    seating, doubts = Seating(1.0, 0.84), []
    for i in range(375):
        s = i * 0.16e-3
        off = (0.85e-3, 0.5e-3) if s > 0.036 else (0.0, 0.0)
        seating.judge(s, *(off + rng.normal(0.0, [0.05e-3, 0.33e-3])))
        if s > 0.040:  # once many were felt there
            doubts.append(seating.doubt)
    assert np.mean(np.array(doubts) > 0.3e-3) > 0.95


def doubts_after(aside: float, lifted: float, scatter: float, swept: bool = False) -> Floats:
    """Return rows (K, 2) of arc length and doubt [m] of a tip that goes aside and up at 36 mm.

    Args:
        aside: Towards the wall [m].
        lifted: Above the plan [m].
        scatter: Of its height, one standard deviation [m].
        swept: Whether it has only been in the sweep before, and goes aside 1 mm after it.
    """
    rng, rows = np.random.default_rng(4), list[tuple[float, float]]()
    seating = Seating(1.0, 0.84)
    begin = 0.035 if swept else 0.0
    if swept:
        seating.seated(
            np.column_stack([np.full(200, begin), rng.normal(0.0, [0.05e-3, scatter], (200, 2))])
        )
    for s in np.arange(begin, 0.096, 0.16e-3).tolist():
        off = (aside, lifted) if s > 0.036 else (0.0, 0.0)
        seating.judge(s, *(off + rng.normal(0.0, [0.05e-3, scatter])))
        rows.append((s, seating.doubt))
    return np.array(rows)


@pytest.mark.parametrize("swept", [False, True])
def test_a_noisy_tip_that_has_climbed_is_doubted_for_long(swept: bool) -> None:
    """What was felt meanwhile does not say where the seam is: 20 mm after it nearly all is doubted."""
    rows = doubts_after(0.85e-3, 0.4e-3, 0.33e-3, swept)
    after = rows[(rows[:, 0] > 0.038) & (rows[:, 0] < 0.058), 1]
    assert np.mean(after > 0.6e-3) > 0.95


@pytest.mark.parametrize(("scatter", "ruled_out"), [(0.15e-3, True), (0.8e-3, False)])
def test_a_noisy_tip_goes_aside_with_the_seam_where_its_height_rules_out_that_it_climbs(
    scatter: float, ruled_out: bool
) -> None:
    """It would rise by a third of a millimetre; 25 heights are known to a fifth of their scatter."""
    rows = doubts_after(0.85e-3, 0.0, scatter)
    soon = (rows[:, 0] > 0.041) & (rows[:, 0] < 0.05)  # the line is known well there
    doubt = np.median(rows[soon, 1])
    assert doubt == pytest.approx(0.0 if ruled_out else 0.85e-3, abs=0.1e-3)


def test_a_noisy_tip_that_is_a_little_aside_is_followed() -> None:
    """Less than leaves the seam: a plan that is off must not keep the line as it was for ever."""
    rows = doubts_after(0.3e-3, 0.0, 0.8e-3)
    assert np.median(rows[(rows[:, 0] > 0.04) & (rows[:, 0] < 0.044), 1]) > 0.2e-3
    assert np.median(rows[rows[:, 0] > 0.09, 1]) < 0.1e-3


@pytest.mark.parametrize("back", [False, True])
def test_a_noisy_tip_that_rose_for_certain_is_doubted_until_it_comes_down(back: bool) -> None:
    """However long that lasts, and wherever the seam leads meanwhile."""
    rng, seating, doubts = np.random.default_rng(4), Seating(1.0, 0.84), []
    for s in np.arange(0.0, 0.14, 0.16e-3).tolist():
        up = 0.036 < s < (0.1 if back else 1.0)
        wave = 0.0 if back or s < 0.05 else 1.5e-3 * np.sin(s / 8e-3)
        off = (0.85e-3 * up + wave, 0.8e-3 * up)
        seating.judge(s, *(off + rng.normal(0.0, [0.05e-3, 0.33e-3])))
        doubts.append(seating.doubt)
    if back:
        assert np.median(doubts[-100:]) < 0.1e-3
    else:
        assert min(doubts[-100:]) > 0.6e-3


@pytest.mark.parametrize("slope", [-0.06, 0.0, 0.06])
def test_a_noisy_tip_that_climbs_is_doubted_however_the_plan_is_turned(slope: float) -> None:
    """Away from the wall by more than plans are off, the seam would hide how far aside it went."""
    rng, seating = np.random.default_rng(4), Seating(1.0, 0.84)
    doubts = []
    for s in np.arange(0.0, 0.045, 0.16e-3).tolist():
        off = (0.85e-3, 0.4e-3) if s > 0.036 else (0.0, 0.0)
        seating.judge(s, *(off + rng.normal([slope * s, 0.0], [0.05e-3, 0.33e-3])))
        doubts.append(seating.doubt)
    assert np.mean(np.array(doubts[-40:]) > 0.6e-3) > 0.9


def test_a_quiet_tip_that_goes_aside_at_its_height_is_hardly_doubted() -> None:
    rows = doubts_after(0.4e-3, 0.0, 0.05e-3)
    assert np.mean(rows[:, 1] > 0.1e-3) < 0.05
