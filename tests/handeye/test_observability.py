"""What poses can tell: centres in a mirror are told from centres with noise."""

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.handeye.observability import require_right_handed, robust_sigma, telling
from flangeye.maths.geometry import kabsch, rotation_exp


def test_centres_that_fit_in_a_mirror_only_are_refused() -> None:
    rng = np.random.default_rng(0)
    tcps = rng.uniform(-0.2, 0.2, (8, 3))
    centres = (tcps - [0.6, 0.0, 1.0]) @ rotation_exp(np.array([2.0, 0.3, -0.4]))
    noise = 1e-4 * rng.standard_normal((8, 3))
    require_right_handed(centres + noise, tcps)
    require_right_handed(centres + 100 * noise, tcps)  # noise alone is no mirror
    for axis in range(3):
        mirrored = (centres + noise) * np.where(np.arange(3) == axis, -1.0, 1.0)
        with pytest.raises(StageError, match=r"only when mirrored \(0.1 mm rms instead of"):
            require_right_handed(mirrored, tcps)


def test_the_noise_that_residuals_show_is_the_noise_of_one_coordinate() -> None:
    rng, sigma, count = np.random.default_rng(1), 1e-3, 6
    found = []
    for _ in range(600):
        centres = rng.uniform(-0.2, 0.2, (count, 3))
        tcps = centres + sigma * rng.standard_normal((count, 3))
        rotation, shift = kabsch(centres, tcps)
        found.append(robust_sigma(tcps - centres @ rotation.T - shift))
    assert np.mean(found) == pytest.approx(sigma, rel=0.06)


def test_as_few_motions_are_named_as_show_what_is_weak() -> None:
    known, limits = np.diag([4.0, 0.0, 0.0, 0.0]), np.ones(4)
    motions = {"first": np.diag([9.0, 0, 0, 0]), "second": np.diag([0, 9.0, 0, 0]),
               "third": np.diag([0, 9.0, 9.0, 0])}  # fmt: skip
    chosen, left = telling(known, limits, motions)
    assert chosen == ["third"]
    assert np.abs(left.moves).argmax(axis=0).tolist() == [3]
    assert telling(np.diag([4.0] * 4), limits, motions)[0] == []
    assert telling(known, limits, {})[0] == []
