"""Parameters at the ends of what a recipe may state."""

from collections.abc import Mapping
from typing import Any

import pytest
from pydantic import ValidationError

from flangeye import Params


def check_bound(
    model: type[Params], name: str, refused: Any, taken: Any, given: Mapping[str, Any] = {}
) -> None:
    """Check that a parameter may be ``taken`` and not ``refused``, the others as ``given``."""
    model.model_validate({**given, name: taken})
    with pytest.raises(ValidationError, match=f"{name}\n"):
        model.model_validate({**given, name: refused})
