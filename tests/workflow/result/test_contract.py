"""What a result says is of the sizes that its readers count on."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.workflow.result.contract import TransformResult, WorkspaceResult

SOUND: dict[str, Any] = {
    "matrix": np.eye(4).tolist(), "covariance": np.eye(6).tolist(), "about": [0.0, 0.0, 0.0],
}  # fmt: skip


def test_a_workspace_of_two_coordinates_is_no_result() -> None:
    with pytest.raises(ValidationError, match="centre\n.* at least 3 items"):
        WorkspaceResult(centre=[0.0, 1.0], size=[1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"matrix": np.eye(3).tolist()}, "'matrix' is not 4x4"),
        ({"covariance": [*np.eye(6).tolist()[:5], [0.0]]}, "'covariance' is not 6x6"),
        ({"covariance": np.eye(7).tolist()}, "'covariance' is not 6x6"),
        ({"covariance": (-np.eye(6)).tolist()}, "a variance below 0, or a correlation beyond 1"),
        ({"covariance": (2 - np.eye(6)).tolist()}, "a variance below 0, or a correlation beyond"),
        ({"matrix": np.full((4, 4), 1e300).tolist()}, "is not a rigid transform"),
        ({"about": [0.0]}, "about\n.* at least 3 items"),
        ({"unobservable": [[1.0]]}, "a direction of 'unobservable' has not 6 components"),
    ],
)
def test_a_transform_of_other_sizes_is_no_result(changed: dict[str, Any], told: str) -> None:
    assert TransformResult.model_validate_json(json.dumps(SOUND)).sigma == [1.0] * 6
    with pytest.raises(ValidationError, match=told):
        TransformResult.model_validate_json(json.dumps(SOUND | changed))
