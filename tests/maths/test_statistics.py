"""The medians that everything robust asks for."""

from typing import Any

import numpy as np
import pytest

from flangeye.maths.statistics import median


@pytest.mark.parametrize("shape", [(1,), (2,), (7,), (8,), (3, 5), (3, 6), (2, 3, 4)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_medians_are_numpys(shape: tuple[int, ...], dtype: Any) -> None:
    values: Any = np.random.default_rng(0).normal(size=shape).astype(dtype)
    before = values.copy()
    assert (median(values) == np.median(values, axis=-1)).all()
    assert (values == before).all()
