"""What a look behind the torch says of errors that nothing else measures, with known truth."""

import numpy as np
import pytest

from flangeye_plugins.weld.following.bias import CONTRADICTIONS, Bias, Trail

PRIOR, HEAT, LENGTH, SIGMA = 0.3e-3**2, 0.1e-3, 40e-3, 0.05e-3


@pytest.fixture
def bias() -> Bias:
    return Bias(PRIOR, HEAT, LENGTH)


def looked(bias, truth, count=100, step=0.5e-3, seed=0, sigma=SIGMA):
    rng = np.random.default_rng(seed)
    for i in range(count):
        bias.look(i * step, truth + sigma * rng.standard_normal(), sigma, 0.0)
    return (count - 1) * step


def test_without_a_look_the_files_are_believed(bias: Bias) -> None:
    assert not bias.looked
    assert bias.value == 0.0
    assert bias.variance(0.0) == bias.variance(1.0) == PRIOR


def test_one_look_counts_as_its_sigma_says(bias: Bias) -> None:
    bias.look(0.01, 0.4e-3, SIGMA, 0.12e-3**2)
    noise = SIGMA**2 + 0.12e-3**2
    gain = PRIOR / (PRIOR + noise)
    assert bias.value == pytest.approx(gain * 0.4e-3)
    assert bias.variance(0.01) == pytest.approx((1 - gain) * PRIOR + SIGMA**2)


@pytest.mark.parametrize("truth", [0.5e-3, -0.8e-3, 0.0])
def test_it_comes_to_the_truth(bias: Bias, truth: float) -> None:
    last = looked(bias, truth)
    assert bias.value == pytest.approx(truth, abs=0.04e-3)
    assert SIGMA**2 < bias.variance(last) < PRIOR / 10


def test_many_looks_on_one_spot_are_no_better_than_one() -> None:
    once, often = Bias(PRIOR, 0.0, LENGTH), Bias(PRIOR, 0.0, LENGTH)
    once.look(0.0, 0.2e-3, SIGMA, 0.1e-3**2)
    for i in range(200):
        often.look(i * 1e-6, 0.2e-3, SIGMA, 0.1e-3**2)
    assert often.variance(0.0) == pytest.approx(once.variance(0.0), rel=0.01)
    once.look(LENGTH, 0.2e-3, SIGMA, 0.1e-3**2)  # a tool's length on it is another one
    assert once.variance(LENGTH) < 0.8 * often.variance(0.0)


def test_a_place_that_was_looked_at_says_nothing_new(bias: Bias) -> None:
    last = looked(bias, 0.3e-3)
    before = bias.value, bias.variance(last)
    bias.look(last, -0.3e-3, SIGMA, 0.0)
    bias.look(last - 0.01, -0.3e-3, SIGMA, 0.0)
    assert (bias.value, bias.variance(last)) == before


def test_the_torch_is_ahead_of_what_was_looked_at(bias: Bias) -> None:
    last = looked(bias, 0.3e-3)
    ahead = bias.variance(last + LENGTH) - bias.variance(last)
    assert ahead == pytest.approx(HEAT**2)
    assert bias.variance(last + 100.0) == pytest.approx(PRIOR + bias.value**2)


def test_where_there_was_no_look_for_long_the_next_one_counts_as_the_first_did(bias: Bias) -> None:
    looked(bias, 0.0, sigma=1e-9)
    bias.look(1000.0, 0.4e-3, SIGMA, 0.0)
    assert bias.value == pytest.approx(PRIOR / (PRIOR + SIGMA**2) * 0.4e-3, rel=1e-3)


def test_it_follows_a_bias_that_changes_as_it_is_stated_to(bias: Bias) -> None:
    rng = np.random.default_rng(3)
    step, off = 0.5e-3, []
    truth = 0.0
    for i in range(2000):
        truth += HEAT * np.sqrt(step / LENGTH) * rng.standard_normal()
        bias.look(i * step, truth + SIGMA * rng.standard_normal(), SIGMA, 0.0)
        off.append((bias.value - truth) / np.sqrt(bias.variance(i * step)))
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.0
    assert np.abs(off).max() < 4.0


def test_spatter_is_passed_over(bias: Bias) -> None:
    last = looked(bias, 0.1e-3)
    before = bias.value
    for i in range(1, CONTRADICTIONS):
        bias.look(last + i * 1e-4, 1.5e-3, SIGMA, 0.0)
    assert bias.value == before
    assert not bias.doubt
    bias.look(last + 1e-3, 0.1e-3, SIGMA, 0.0)
    bias.look(last + 2e-3, 1.5e-3, SIGMA, 0.0)
    assert not bias.doubt


def test_looks_that_all_contradict_the_files_are_told(bias: Bias) -> None:
    looked(bias, 2e-3, CONTRADICTIONS, sigma=1e-6)
    assert bias.value == 0.0
    assert "sees the bead +2.00 mm" in bias.doubt
    assert "allow 1.20 mm: calibrate the tool" in bias.doubt


def test_small_steps_do_not_lead_beyond_what_the_files_state() -> None:
    bias = Bias(PRIOR, 10 * HEAT, LENGTH)
    for i in range(400):
        bias.look(i * 0.5e-3, i * 0.01e-3, SIGMA, 0.0)
    assert "calibrate the tool" in bias.doubt
    assert bias.value < 4 * np.sqrt(PRIOR + SIGMA**2)


def test_a_trail_tells_where_the_torch_was_and_how_far_aside() -> None:
    trail = Trail()
    assert trail.place_at(1.0) is None
    assert trail.passing(0.0) is None
    for i in range(11):
        trail.pass_by(1.0 + i, i * 1e-3, i * 1e-5, i * 1e-9)
    trail.pass_by(12.0, 10.1e-3, 1.0, 1.0)  # too near to the last
    assert trail.place_at(0.9) is None
    assert trail.place_at(3.5) == pytest.approx(2e-3)
    assert trail.place_at(2.0) == pytest.approx(1e-3)
    assert trail.place_at(99.0) == pytest.approx(10e-3)
    assert trail.passing(-1e-6) is None
    assert trail.passing(4.4e-3) == (4e-5, 4e-9)


def test_what_a_look_contradicts_is_told_with_what_was_known_before(bias: Bias) -> None:
    last = looked(bias, 0.4e-3)
    for i in range(1, 6):
        bias.look(last + i * 1e-4, -0.9e-3, SIGMA, 0.0)
    known = f"{bias.value * 1e3:+.2f} mm were expected"
    assert bias.value > 0.3e-3 and known in bias.doubt and "bead -0.90 mm" in bias.doubt
