"""What a result says is of the sizes that its readers count on."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.result import TransformResult

SOUND: dict[str, Any] = {
    "matrix": np.eye(4).tolist(), "covariance": np.eye(6).tolist(), "about": [0.0, 0.0, 0.0],
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"matrix": np.eye(3).tolist()}, "'matrix' is not 4x4"),
        ({"covariance": [*np.eye(6).tolist()[:5], [0.0]]}, "'covariance' is not 6x6"),
        ({"covariance": np.eye(7).tolist()}, "'covariance' is not 6x6"),
        ({"about": [0.0]}, "'about' has not 3 coordinates"),
        ({"unobservable": [[1.0]]}, "a direction of 'unobservable' has not 6 components"),
    ],
)
def test_a_transform_of_other_sizes_is_no_result(changed: dict[str, Any], told: str) -> None:
    assert TransformResult.model_validate_json(json.dumps(SOUND)).sigma == [1.0] * 6
    with pytest.raises(ValidationError, match=told):
        TransformResult.model_validate_json(json.dumps(SOUND | changed))
