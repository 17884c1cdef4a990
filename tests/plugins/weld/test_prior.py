"""What one weld has found is what the next one expects."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flangeye.errors import RecipeError, StageError
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.prior import keep_posterior, with_prior
from tests.plugins.weld.cell import planned, run, weld_short, welded, welded_once
from tests.plugins.weld.test_probing import swept

BELIEF = ModelPrior(40e-3, half_angle=math.radians(40.0))


def test_without_a_file_nothing_changes(tmp_path) -> None:
    assert with_prior(BELIEF, None, "srm") is BELIEF
    assert with_prior(BELIEF, tmp_path / "prior.yaml", "srm") is BELIEF


def test_what_was_kept_is_expected_next(tmp_path) -> None:
    path = tmp_path / "prior.yaml"
    found = SweepFit(
        ahead=0.4e-3, ahead_sigma=0.03e-3, width=0.05e-3, width_sigma=0.02e-3,
        stamp=0.02, stamp_sigma=0.004,
    )  # fmt: skip
    keep_posterior(path, "srm", found)
    prior = with_prior(BELIEF, path, "srm")
    assert prior.ahead == pytest.approx(0.4e-3)
    assert prior.ahead_known == pytest.approx(2**0.5 * 0.03e-3)
    assert (prior.play, prior.play_sigma) == pytest.approx((0.05e-3, 2**0.5 * 0.02e-3))
    assert (prior.stamp, prior.stamp_sigma) == pytest.approx((0.02, 2**0.5 * 0.004))
    path.unlink()
    assert with_prior(BELIEF, path, "srm") is BELIEF


def test_many_welds_never_add_up_to_certainty(tmp_path) -> None:
    once, _ = swept(noise=60e-6)
    known = once
    for seed in range(12):
        keep_posterior(tmp_path / "prior.yaml", "srm", known)
        prior = with_prior(BELIEF, tmp_path / "prior.yaml", "srm")
        known, _ = swept(noise=60e-6, seed=seed, ahead=-prior.ahead, prior=prior)
    assert known.ahead_sigma > 0.6 * once.ahead_sigma


def test_another_finger_s_file_is_refused(tmp_path) -> None:
    keep_posterior(tmp_path / "prior.yaml", "other", SweepFit(ahead_sigma=1e-4))
    with pytest.raises(StageError, match="is of finger other, this one is srm"):
        with_prior(BELIEF, tmp_path / "prior.yaml", "srm")


def test_a_file_without_units_is_refused(tmp_path) -> None:
    (tmp_path / "prior.yaml").write_text("finger: srm\nahead: 0.4\n")
    with pytest.raises(RecipeError, match="prior.yaml:2"):
        with_prior(BELIEF, tmp_path / "prior.yaml", "srm")


def test_two_sweeps_know_more_than_one_and_are_as_right() -> None:
    true, off = 0.15e-3, []
    for seed in range(8):
        first, _ = swept(noise=60e-6, seed=seed, ahead=true)
        known = replace(BELIEF, ahead=first.ahead, ahead_sigma=first.ahead_sigma)
        # The tool is taken to be where the first sweep has found it: what is left is felt.
        second, _ = swept(noise=60e-6, seed=seed + 100, ahead=true - first.ahead, prior=known)
        assert second.ahead_sigma < first.ahead_sigma
        off.append((second.ahead - true) / second.ahead_sigma)
    assert np.sqrt(np.mean(np.square(off))) < 2.5


def test_a_tip_that_was_bent_since_is_no_surprise_that_is_averaged_away() -> None:
    known = replace(BELIEF, ahead=0.0, ahead_sigma=0.02e-3)
    found, _ = swept(noise=30e-6, ahead=0.8e-3, prior=known)
    assert isinstance(found, str)
    assert "it was bent or changed; delete the file" in found


def test_a_weld_writes_the_file_and_the_next_one_starts_from_it(tmp_path) -> None:
    first, _, kept = welded_once()
    assert first.completed
    assert any("is in prior.yaml: the next one starts from it" in note for note in first.notes)
    assert "Delete it to begin anew" in kept.decode()
    path = tmp_path / "prior.yaml"
    path.write_bytes(kept)
    seam = planned("v-straight", end=0.04)
    _, journal = run(seam, prior=path, sensor={"hidden": ("1 s", "60 s")})
    prior = dict(journal[:1])["start"]["prior"]
    assert prior["ahead_sigma"] < BELIEF.tip_sigma


def test_equal_welds_are_equal_and_a_file_that_cannot_be_written_costs_no_report(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    report, _ = weld_short(tmp_path / "file" / "prior.yaml")
    assert report.completed
    assert any("what the weld found is not kept" in note for note in report.notes)
    np.testing.assert_array_equal(report.torch, welded()[0].torch)
