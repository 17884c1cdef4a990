"""Points, as every scanner gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import core_schema

from flangeye.types.arrays import Singles

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in one frame, unorganised (N, 3) or organised (H, W, 3); a missing point is NaN.

    Single precision: at one metre it resolves 0.06 um, a thousandth of the best scanner's noise.

    Attributes:
        frame: Frame the points are expressed in.
        xyz: (N, 3) or (H, W, 3) positions [m], float32.
    """

    frame: str
    xyz: Singles

    def __init__(self, frame: str, xyz: ArrayLike) -> None:
        xyz = np.asarray(xyz, dtype=np.float32)
        if xyz.ndim not in (2, 3) or xyz.shape[-1] != 3:
            raise ValueError(f"a cloud is (N, 3) or (H, W, 3), not {xyz.shape}")
        view = xyz.view()
        view.setflags(write=False)
        object.__setattr__(self, "frame", frame)
        object.__setattr__(self, "xyz", view)

    @property
    def organised(self) -> bool:
        """Whether neighbours in the array are neighbours in the scanner's image."""
        return self.xyz.ndim == 3

    def points(self) -> Singles:
        """Return the (M, 3) points that are finite."""
        flat = self.xyz.reshape(-1, 3)
        return flat[np.isfinite(flat).all(axis=1)]

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        # Points never travel as JSON: the log writes them as foxglove.PointCloud.
        return core_schema.is_instance_schema(cls)

    @classmethod
    def __get_pydantic_json_schema__(cls, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"description": "On the channel named like this one with /cloud added."}
