"""Which pairs of centres and TCPs agree."""

import numpy as np
import pytest

from flangeye.handeye.inliers import find_inliers, gate
from flangeye.maths.geometry import rotation_exp


@pytest.mark.parametrize("count", [9, 15, 30])
def test_exact_pairs_end_in_a_moment_and_all_agree(count: int) -> None:
    rng = np.random.default_rng(count)
    tcps = rng.uniform(-0.2, 0.2, (count, 3))
    turn, shift = rotation_exp(np.array([0.3, -2.0, 1.0])), np.array([0.6, 0.0, 1.0])
    centres = (tcps - shift) @ turn
    inliers, _ = find_inliers(centres, tcps, 1e-5)
    assert inliers.all()


def test_the_gate_keeps_a_thousandth_of_pairs_and_a_twentieth_of_sets() -> None:
    assert gate(8) == pytest.approx(0.999)
    assert gate(50) == pytest.approx(0.999)
    assert gate(500) ** 500 == pytest.approx(0.95, abs=2e-3)
