"""Parameters whose fixed values, which no recipe sets, are others."""

from typing import Any, TypeVar

from flangeye import Params
from flangeye.units import SI

Model = TypeVar("Model", bound=Params)


def fixed(model: type[Model], **values: Any) -> Model:
    """Return parameters with options, and with others in place of the class's fixed values [SI]."""
    own = {
        name: value.si if isinstance(value, SI) else value
        for name, value in values.items()
        if name not in model.model_fields
    }
    assert all(hasattr(model, name) for name in own), own
    options = {name: value for name, value in values.items() if name not in own}
    return type(model.__name__, (model,), own)(**options)
