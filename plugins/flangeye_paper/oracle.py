"""``error.oracle_as_in_paper``: the cost of section 3.1, which knows what it is looking for."""

from __future__ import annotations

from collections.abc import Sequence

from flangeye import part
from flangeye.models.targets import Flange
from flangeye.types import Observation, PoseError, Transform, Views
from flangeye_paper.paper_cell import BASE_T_CAMERA, CENTRE, errors_of


@part("error.oracle_as_in_paper")
def error_oracle(
    base_T_camera: Transform, kept: Sequence[Observation], views: Views, flange: Flange | None
) -> PoseError:
    """The distance from the simulation's own truth (17): no method, an emulation of section 3.1.

    The paper writes ``e = H^ H_true`` for the error that Algorithm 1 minimises in simulation: the
    algorithm picks its poses by looking at the answer. No real cell offers that.
    """
    at = BASE_T_CAMERA[:3, :3].T @ (CENTRE - BASE_T_CAMERA[:3, 3])
    return PoseError(errors_of(base_T_camera.matrix), at, base_T_camera.rotation)
