"""``verify.icp``: the paper's check, equation (11): the scanned flange against its true shape."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from flangeye import Params, StageError, stage
from flangeye.files.clouds import FileUnit
from flangeye.files.paths import RecipeFile
from flangeye.maths.arm_correction import corrected_view
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.targets import Flange
from flangeye.types import HandEye, PoseError, Transform, Verification, VerificationView, Views
from flangeye.types.geometry import rotation_from_rpy, rotation_log, rpy_from_rotation
from flangeye.units import Angle, Length, param
from flangeye_plugins.verify.registration import (
    Registration,
    SampledSurface,
    read_surface,
    register,
    surface_of,
)


class CadCloud(Params):
    """A point cloud of the flange's CAD model."""

    file: RecipeFile
    """PCD, PLY, XYZ, CSV or NPY; rows that are not finite are left out."""
    unit: FileUnit
    """Unit of the file's coordinates."""
    offset: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    """Position of the file's origin in the flange's frame."""
    rpy: tuple[Angle, Angle, Angle] = param(("0 deg", "0 deg", "0 deg"))
    """Roll, pitch, yaw of the file's frame."""


class IcpSettings(Params):
    """Common settings of comparisons with the flange's shape."""

    cad: CadCloud | None = None
    """The flange's shape; by default made from its dimensions."""
    # Largest initial error from which ICP is started [m]
    reach: ClassVar[float] = 20e-3
    # Points further from the surface are not the flange, in the end [m]
    distance: ClassVar[float] = 1e-3


class IcpParams(IcpSettings):
    """Parameters of ``verify.icp``."""

    # Largest translation error at the flange that passes [m]
    max_translation: ClassVar[float] = 1e-3
    # Largest error of its axis that passes [rad]
    max_tilt: ClassVar[float] = float(np.radians(1))


@dataclass(frozen=True)
class ViewComparison:
    """One verification view against the flange's shape.

    Attributes:
        error: Motion from the measured to the predicted flange in ``camera``.
        registration: This motion in ``flange``, with the quality of the fit.
    """

    error: PoseError
    registration: Registration


@stage("verify.icp")
def verify_icp(
    calibration: HandEye,
    views: Views,
    flange: Flange,
    params: IcpParams,
    robot: RobotModel | None = None,
) -> Verification:
    """Register the flange seen in each verification view with its shape, point to plane.

    Equation (11) with corrected subscripts: the shape is predicted in ``camera`` as
    ``inverse(base_T_camera) @ base_T_flange @ shape``. The error is the motion that maps the
    measured cloud onto it; it is infinite if ICP fails. The view with the largest translation
    counts.

    The figures [m, rad] are in ``camera``: ``x, y, z`` are the translation at the flange;
    ``camera_x, camera_y, camera_z`` that at the camera's origin, as in the paper, where a rotation
    error is multiplied by the distance. ``roll, pitch, yaw`` are the rotation, ``tilt`` that of the
    axis and ``clocking`` that about it (only if the shape determines it; it includes errors of the
    flange's own orientation). ``rms`` and ``overlap`` are those of the fit; ``views`` is their
    number.

    Raises:
        StageError: There is no verification view.
    """
    surface = shape_of(flange, params)
    transform = calibration.base_T_camera.transform
    arm, correction = Arm(robot) if robot else None, calibration.as_reported().correction
    # The circle's place on the flange is corrected, as the robot's program will have it corrected
    # too.
    expected = [corrected_view(view, correction, arm) for view in require_views(views)]
    found = {view.id: compare(transform, view, surface, params) for view in expected}
    failed = [f"view {view}: {why}" for view, why in found.items() if isinstance(why, str)]
    if failed:
        return Verification(False, f"ICP failed, the error is infinite: {'; '.join(failed)}", {})
    compared = {view: seen for view, seen in found.items() if isinstance(seen, ViewComparison)}
    return _judge(compared, params)


def require_views(views: Views) -> Views:
    """Return the views; refuse an empty list.

    Raises:
        StageError: There are no verification views.
    """
    if not views:
        raise StageError(
            "no verification view: let the acquire step mark one or more captures as "
            "verification captures, or use verify.holdout, which needs none"
        )
    return views


def shape_of(flange: Flange, settings: IcpSettings) -> SampledSurface:
    """Return the flange's surface from its CAD cloud if given, else from its dimensions.

    Raises:
        StageError: The CAD cloud cannot be read.
    """
    return surface_of(flange) if settings.cad is None else _read(settings.cad)


@lru_cache(maxsize=4)
def _read(cad: CadCloud) -> SampledSurface:
    """Return a CAD cloud's surface, cached because solvers need it for every candidate."""
    return read_surface(cad.file, cad.unit, rotation_from_rpy(*cad.rpy), np.array(cad.offset))


def compare(
    base_T_camera: Transform, view: VerificationView, surface: SampledSurface, settings: IcpSettings
) -> ViewComparison | str:
    """Return one view registered with the surface, or the reason why ICP failed."""
    camera_T_flange = base_T_camera.inverse() @ view.base_T_flange
    measured = camera_T_flange.inverse().apply(view.flange.cloud.points())
    found = register(measured, surface, settings.reach, settings.distance)
    if isinstance(found, str):
        return found
    predicted = camera_T_flange.matrix
    # From a motion in the flange's axes to the same motion in the camera's
    motion = predicted @ found.motion @ np.linalg.inv(predicted)
    return ViewComparison(PoseError(motion, predicted[:3, 3], base_T_camera.rotation), found)


def _judge(compared: Mapping[str, ViewComparison], params: IcpParams) -> Verification:
    figures = {view: _figures(comparison) for view, comparison in compared.items()}
    errors = {view: found["translation"] for view, found in figures.items()}
    # The worst view and not the mean: the error of a matrix grows with the distance between views.
    worst = max(errors, key=lambda view: errors[view])
    tilt = max(found["tilt"] for found in figures.values())
    passed = errors[worst] <= params.max_translation and tilt <= params.max_tilt
    reason = (
        f"the flange is {errors[worst] * 1e3:.3f} mm and {np.degrees(tilt):.3f} deg from where it "
        f"should be, {'within' if passed else 'beyond'} the limits of "
        f"{params.max_translation * 1e3:g} mm and {np.degrees(params.max_tilt):g} deg"
    )
    units = dict.fromkeys(figures[worst], "m") | {"overlap": "share", "views": ""}
    units |= dict.fromkeys(("roll", "pitch", "yaw", "tilt", "clocking"), "rad")
    shown = {**figures[worst], "views": float(len(errors))}
    return Verification(passed, reason, shown, errors, units=units)


def _figures(comparison: ViewComparison) -> dict[str, float]:
    error, fit = comparison.error, comparison.registration
    at_flange = error.displacement()
    turns = rpy_from_rotation(error.motion[:3, :3])
    turn = rotation_log(fit.motion[:3, :3])  # in the flange's frame: its axis is z
    figures = {
        **dict(zip("xyz", at_flange.tolist(), strict=True)),
        "translation": float(np.linalg.norm(at_flange)),
        **dict(
            zip(("camera_x", "camera_y", "camera_z"), error.motion[:3, 3].tolist(), strict=True)
        ),
        "camera_translation": float(np.linalg.norm(error.motion[:3, 3])),
        **dict(zip(("roll", "pitch", "yaw"), turns.tolist(), strict=True)),
        "tilt": float(np.linalg.norm(turn[:2])),
        "rms": fit.rms,
        "overlap": fit.overlap,
    }
    return {**figures, "clocking": float(turn[2])} if fit.roll_seen else figures
