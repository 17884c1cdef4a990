"""Measurements of a target in one capture, and reasons why a capture is rejected."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from flangeye.types.arrays import Array, Floats, freeze
from flangeye.types.frames import (
    CAMERA,
    TARGET,
    FrameMismatchError,
    Motion,
    PosedMeasurement,
    Poses,
    Transform,
)
from flangeye.types.scans import FlangeCloud


@dataclass(frozen=True, eq=False)
class CircleFeature:
    """A circle fitted to the flange, or a sphere fitted to one mounted on it, in ``camera``.

    Attributes:
        centre: (3,) centre of the circle [m].
        normal: (3,) unit normal of the face, towards the scanner; None where only centres exist.
        radii: Fitted radii by name, for example ``{"rim": .., "bore": ..}`` [m].
        covariance: (3, 3) covariance of the centre [m^2].
        normal_covariance: (3, 3) covariance of the normal, singular along it; None with the normal.
        arc_coverage: Share of the rim's circumference that was seen, 0 to 1; 0 if not known.
        roll: Angle of the hole pattern about the normal [rad], or None when not visible.
        centre_in_flange: (3,) where the arm carries that centre, in ``flange`` [m]: its origin,
            unless a target is mounted on it.
    """

    centre: Array
    normal: Array | None
    radii: Mapping[str, float]
    covariance: Array
    normal_covariance: Array | None
    arc_coverage: float
    roll: float | None = None
    centre_in_flange: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        freeze(self, centre=(3,), covariance=(3, 3), centre_in_flange=(3,))
        if self.normal is not None or self.normal_covariance is not None:
            freeze(self, normal=(3,), normal_covariance=(3, 3))

    @property
    def centre_covariance(self) -> Floats:
        """Covariance (3, 3) of the centre [m^2]; every feature has one."""
        return self.covariance


@dataclass(frozen=True, eq=False)
class PoseFeature:
    """A target whose full pose was measured, such as a marker.

    Attributes:
        camera_T_target: Pose of the target; its target's z points towards the scanner.
        covariance: (6, 6), order (rotation [rad], translation [m]), left perturbation in
            ``camera``, the translation taken at the target's origin.
        figures: Measures of the fit's quality, by name, in SI units and pixels.
        corners: (N, 4) the target's corners in the image, right and down, and what has to be
            added to come to where the pose has them [px]; none where it was found otherwise.
        shared: (6, k) what one standard deviation of each of k errors that all captures of a
            session share, such as the camera's, does to the pose, in the covariance's order.
    """

    camera_T_target: Transform
    covariance: Array
    figures: Mapping[str, float] = field(default_factory=dict)
    corners: Array = field(default_factory=lambda: np.zeros((0, 4)))
    shared: Array = field(default_factory=lambda: np.zeros((6, 0)))

    def __post_init__(self) -> None:
        corners = np.reshape(self.corners, (-1, 4))  # JSON writes (0, 4) as (0,)
        object.__setattr__(self, "corners", corners)
        shared = np.reshape(self.shared, (6, -1))
        object.__setattr__(self, "shared", shared)
        freeze(self, covariance=(6, 6), corners=corners.shape, shared=shared.shape)

    @property
    def centre(self) -> Floats:
        """Target's origin (3,) in ``camera`` [m]."""
        return self.camera_T_target.translation

    @property
    def normal(self) -> Floats:
        """Target's z axis (3,) in ``camera``."""
        return self.camera_T_target.rotation[:, 2]

    @property
    def centre_covariance(self) -> Floats:
        """Covariance (3, 3) of the origin [m^2]."""
        return self.covariance[3:, 3:]

    @property
    def normal_covariance(self) -> Floats:
        """Covariance (3, 3) of the target's z axis, singular along it."""
        turned = np.cross(self.normal, self.covariance[:3, :3])
        return np.cross(self.normal, turned.T)


Feature = CircleFeature | PoseFeature
"""Measurement of a target by a ``fit`` stage, in ``camera``."""


@dataclass(frozen=True, eq=False)
class Rejected:
    """Output of a per-capture stage that rejects its capture, with the reason.

    Attributes:
        reason: The same text for all captures that are set aside for it.
        figures: This capture's own.
        fix: What to do, where the cause is not the capture's but the whole session's.
    """

    reason: str
    figures: str = ""
    fix: str = ""


@dataclass(frozen=True, eq=False)
class Rejection:
    """A rejected capture: its name, the stage, and the reason as in :class:`Rejected`."""

    id: str
    stage: str
    reason: str
    figures: str = ""
    fix: str = ""

    def __str__(self) -> str:
        figures = f" ({self.figures})" if self.figures else ""
        return f"{self.stage}: {self.reason}{figures}"

    @property
    def kind(self) -> tuple[str, str, str]:
        """Key that rejections for the same reason share: stage, reason without its numbers, fix."""
        return self.stage, re.sub(r"\(.*\)|\d[\d.]*", "", self.reason), self.fix


@dataclass(frozen=True, eq=False)
class Observation(PosedMeasurement):
    """A fitted feature and the robot poses it belongs to: one equation for the solver.

    Attributes:
        id: Id of the capture.
        feature: The measured feature.
        poses: Poses reported by the controllers, by frame.
        joints: (n,) joint angles [rad], when known.
        camera: Frame of the camera that saw it; a cell has several.
        target: Frame of the seen target.
        motion: The flange's motion about the capture, if it was recorded in motion.
        arm_joints: (n,) joint angles of each arm of a cell whose joints are known [rad], by its
            frame.
    """

    id: str
    feature: Feature
    poses: Poses
    joints: Array | None = None
    camera: str = CAMERA
    target: str = TARGET
    motion: Motion | None = None
    arm_joints: Mapping[str, Array] = field(default_factory=dict)

    @property
    def circle(self) -> CircleFeature:
        """The feature, for users of circles only."""
        if isinstance(self.feature, CircleFeature):
            return self.feature
        raise FrameMismatchError(f"observation {self.id} is a pose, and a circle is needed")

    @property
    def centre_in_mount(self) -> Floats:
        """Target's position (3,) in the link that carries it [m], if known."""
        feature = self.feature
        return feature.centre_in_flange if isinstance(feature, CircleFeature) else np.zeros(3)

    @property
    def tcp_in_base(self) -> Floats:
        """Reported position (3,) of the flange's centre, or of the carried target [m]."""
        return self.base_T_flange.apply(self.centre_in_mount)


@dataclass(frozen=True, eq=False)
class VerificationView:
    """A segmented flange kept from the solver, for verifiers that compare whole clouds."""

    id: str
    flange: FlangeCloud
    base_T_flange: Transform
