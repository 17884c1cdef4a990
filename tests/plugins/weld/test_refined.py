"""The seam as it was felt, held against dense normal distributions and against known seams."""

import numpy as np
import pytest

from flangeye_plugins.weld.following.refined import CORRELATIONS, PRIOR, SIZES, RefinedPath, _Field
from flangeye_plugins.weld.path import PATH_SPACING, Path
from tests.plugins.weld.bench import curved, misplaced, straight

ALL = 100_000


def felt(seam, along, noise=10e-6, plan=None, seed=0):
    """Return what is believed of a seam that was felt at places, and the random numbers after."""
    rng, found = (
        np.random.default_rng(seed),
        RefinedPath(Path(curved(0.1)) if plan is None else plan, 0.05),
    )
    found.noise = noise
    for s in np.asarray(along).tolist():
        found.add(s, float(seam(s)) + noise * rng.standard_normal(), 0.2)
    found.renew(-0.05, ALL)
    return found


def level(along, noise=10e-6):
    """Return what is believed of a straight seam of 0.12 m that was felt where it was planned."""
    return felt(lambda s: 0.0, along, noise, Path(straight(0.12)))


def matern(apart, size, length):
    r = np.sqrt(5.0) * np.abs(apart) / length
    return size**2 * (1 + r + r**2 / 3) * np.exp(-r)


def dense(model, places, offsets, noise, at):
    """Mean and variance at a place of the plan's motion and a field, by one normal distribution."""
    path = Path(straight(0.12))
    x = np.concatenate([places, [at]])
    points, _ = path.evaluate(x)
    rows = np.column_stack([0 * x, 1 + 0 * x, points[:, 0]])
    size, length = model
    both = (rows * PRIOR**2) @ rows.T + matern(x[:, None] - x, 0.3e-3 * size, length)
    gain = np.linalg.solve(both[:-1, :-1] + noise**2 * np.eye(len(places)), both[:-1, -1])
    return gain @ offsets, both[-1, -1] - gain @ both[:-1, -1]


@pytest.mark.parametrize("at", [2.25e-3, 20.25e-3, 31.25e-3, 45e-3])
def test_each_filter_is_the_dense_distribution_before_among_and_beyond_what_was_felt(at) -> None:
    """Places behind the tip are interpolated between those that are kept: they are asked there."""
    rng = np.random.default_rng(3)
    places = np.sort(rng.uniform(6e-3, 40e-3, 30))
    offsets = 1e-3 + 0.2e-3 * np.sin(places / 5e-3)
    found = RefinedPath(Path(straight(0.12)), 0.05)
    found.noise = 30e-6
    for s, offset in zip(places.tolist(), offsets.tolist(), strict=True):
        found.add(s, offset, 0.0)
    found.renew(-0.05, ALL)
    means, variances = found._each(at)
    models = [(size, length) for size in SIZES for length in CORRELATIONS]
    for i, model in enumerate(models):
        mean, variance = dense(model, places, offsets, 30e-6, at)
        assert means[i] == pytest.approx(mean, abs=3e-6)
        assert variances[i] == pytest.approx(variance, rel=0.02, abs=1e-12)


def test_a_field_s_transition_has_the_covariance_of_its_kind() -> None:
    field = _Field(np.array([1e-3]), np.array([12e-3]))
    for way in (0.0, 0.4e-3, 9e-3):
        joint = field.over(np.array([way]))[0, 0] @ field.stationary[0]
        assert joint[0, 0] == pytest.approx(matern(way, 1e-3, 12e-3))


@pytest.mark.parametrize("noise", [10e-6, 100e-6])
@pytest.mark.parametrize(
    "seam",
    [
        pytest.param(lambda s: 2e-3 + 0 * s, id="shifted"),
        pytest.param(lambda s: 3e-3 * np.sin(np.pi * s / 0.1), id="bowed"),
        pytest.param(lambda s: 1e-3 * np.sin(2 * np.pi * s / 15e-3), id="wavy"),
    ],
)
def test_what_is_stated_of_the_seam_is_what_it_is_off_by(seam, noise) -> None:
    off = []
    for seed in range(4):
        found = felt(seam, np.arange(5e-3, 80e-3, 5e-4), noise, seed=seed)
        places = [0.0, 2e-3, *np.arange(10e-3, 80e-3, 7e-3), 83e-3, 86e-3]
        off += [(found.offset(s) - seam(s)) / np.sqrt(found.variance(s)) for s in places]
    assert np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.abs(off).max() < 4.0


def test_what_is_felt_later_smooths_what_the_tip_has_passed_until_the_torch_has_too() -> None:
    found = level(np.arange(5e-3, 30e-3, 1e-3), 0.1e-3)
    before = found.variance(29e-3)
    for s in np.arange(30e-3, 60e-3, 1e-3).tolist():
        found.add(s, 0.0, 0.0)
    found.renew(28e-3, ALL)
    assert found.variance(29e-3) < 0.8 * before


def test_a_cycle_takes_in_a_few_places_and_samples_and_the_same_comes_of_it() -> None:
    slow, fast = (RefinedPath(Path(straight(0.12)), 0.05) for _ in range(2))
    for found in (slow, fast):
        for s in np.arange(5e-3, 40e-3, 5e-4).tolist():
            found.add(s, 1e-3, 0.0)
    fast.renew(-0.05, ALL)
    slow.renew(-0.05, 2)
    assert slow._at < 7e-3
    for _ in range(200):
        slow.renew(-0.05, 2)
    assert slow.offset(30e-3) == fast.offset(30e-3) and slow.variance(30e-3) == fast.variance(30e-3)


def test_before_anything_was_felt_the_plan_stands_and_is_off_by_five_millimetres() -> None:
    found = RefinedPath(Path(straight(0.12)), 0.05)
    assert found.empty and found.offset(0.05) == 0.0 and found.angle(0.05, 0.7) == 0.7
    assert found.variance(0.05) == pytest.approx(25e-6)


def test_a_doubt_adds_to_what_is_stated_four_millimetres_to_both_sides() -> None:
    found = RefinedPath(Path(straight(0.12)), 0.05)
    for s in np.arange(5e-3, 80e-3, 5e-4).tolist():
        found.add(s, 0.0, 0.0, 1e-7 if abs(s - 0.05) < 1e-4 else 0.0)
    found.renew(-0.05, ALL)
    assert found.variance(0.053) > 1e-7 > 20 * found.variance(0.056)


def test_an_earlier_weld_is_recalled_as_it_was_believed() -> None:
    first = felt(lambda s: 1e-3 + 0.01 * s, np.arange(5e-3, 60e-3, 5e-4))
    again = RefinedPath(Path(curved(0.1)), 0.05)
    again.recall(first.samples())
    for s in (0.01, 0.03, 0.05):
        assert again.offset(s) == pytest.approx(first.offset(s), abs=10e-6)
    assert again.angle(0.03, 0.0) == 0.2
    assert first.samples()[:, 3].sum() == 110


def test_across_a_seam_that_leaves_its_plan_is_a_right_angle_to_the_seam() -> None:
    found = felt(lambda s: 0.3 * s, np.arange(0.0, 0.08, 5e-4), plan=Path(straight(0.12)))
    point, normal = found.frame(0.04)
    assert point == pytest.approx([0.04, 0.012], abs=20e-6)
    assert normal == pytest.approx(np.array([-0.3, 1.0]) / np.hypot(0.3, 1.0), abs=2e-3)
    assert found.slope(0.04) == pytest.approx(0.3, abs=2e-3)


def test_what_is_felt_again_behind_the_tip_is_left_out() -> None:
    found = felt(lambda s: 0 * s, np.arange(5e-3, 40e-3, PATH_SPACING))
    before = found.offset(0.02)
    found.add(0.02, 9e-3, 0.0)
    found.renew(-0.05, ALL)
    assert found.offset(0.02) == before


def test_where_nothing_was_felt_the_plan_is_moved_onto_what_was() -> None:
    true, plan = Path(curved()), Path(misplaced(curved(), (1e-3, 2e-3, 0.0), np.deg2rad(1.0)))
    refined = RefinedPath(plan, 0.05)
    for s in np.concatenate([np.arange(0.03, 0.05, 2e-4), np.arange(0.07, 0.09, 2e-4)]):
        place = plan.at(float(s))
        foot = true.foot(place.point, float(s))
        for _ in range(3):  # the true seam across the plan
            at = true.at(foot)
            foot -= float((at.point - place.point) @ place.tangent) / float(
                at.tangent @ place.tangent
            )
        offset = float((true.at(foot).point - place.point) @ place.normal)
        refined.add(float(s), offset, 0.0)
    refined.renew(-0.05, 100_000)
    for s in (0.02, 0.04, 0.06, 0.08, 0.1):
        point, normal = refined.frame(s)
        foot = true.foot(point, s)
        assert np.linalg.norm(true.at(foot).point - point) < 0.05e-3
        assert normal @ true.at(foot).normal > np.cos(np.deg2rad(0.5))


@pytest.mark.parametrize("bow", [-3e-3, 3e-3])
def test_a_plan_whose_shape_is_wrong_is_stated_beyond_what_was_felt(bow: float) -> None:
    """A bow that shift and turn nearly explain leads the plan elsewhere beyond its last sample."""
    length = Path(curved(0.1)).length

    def bowed(s):
        return bow * np.sin(np.pi * s / length)

    found = felt(bowed, np.arange(5e-3, length - 10e-3, 2e-4), 30e-6)
    for s in np.arange(length - 10e-3, length, 1e-3):
        off = abs(found.offset(s) - bowed(s))
        assert off < 4 * np.sqrt(found.variance(s)) < 4e-3


def test_waves_felt_in_two_short_pieces_are_not_taken_for_a_plan_turned_far() -> None:
    """A turn by 16 deg and a shift by 35 mm explain both; between them the wave goes on."""

    def wave(s):
        return -1.3e-3 * np.cos(2 * np.pi * (s - 10.5e-3) / 28e-3) - 0.9e-3

    found = felt(wave, [*np.arange(6e-3, 13e-3, 0.6e-3).tolist(), 27.5e-3, 28e-3], 60e-6)
    for s in np.arange(14e-3, 27e-3, 1e-3):
        assert abs(found.offset(s) - wave(s)) < 4 * np.sqrt(found.variance(s))


def test_what_was_felt_at_two_places_says_little_of_the_rest() -> None:
    few, many = (level(np.arange(0.0, end, 2e-4)) for end in (1e-3, 40e-3))
    assert few.variance(11e-3) > 20 * many.variance(50e-3)
