"""A planned seam, and the outcome of its weld."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from flangeye.types.arrays import Array, Floats, freeze
from flangeye.types.clouds import PointCloud
from flangeye.types.notes import Note


@dataclass(frozen=True, eq=False)
class Seam:
    """A weld seam as it is planned, in ``base``, from its start to its end.

    Attributes:
        points_in_base: (N, 3) along the root of the groove, N of at least 2 [m].
        openings_in_base: (N, 3) unit vectors out of the groove, towards the torch.
        covariance: (N, 3, 3) of each point: where it is on the workpiece, and the hand-eye pose,
            together [m^2]. Neighbours share most of it.
        half_angle: Between a wall and the opening [rad], or None where it is not known.
        half_width: From the root's plane to a shoulder [m], or None where it is not known.
        source: What it was planned from, for people.
        figures: How well that went, in SI units, by name.
        notes: What is to be done, and what is for the record.
        cloud: The part of the scan around it, in ``base``, for people.
    """

    points_in_base: Array
    openings_in_base: Array
    covariance: Array
    half_angle: float | None = None
    half_width: float | None = None
    source: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    cloud: PointCloud | None = None

    def __post_init__(self) -> None:
        n = len(self.points_in_base)
        freeze(self, points_in_base=(n, 3), openings_in_base=(n, 3), covariance=(n, 3, 3))
        if n < 2 or not (np.diff(self.arc_length) > 0).all():
            raise ValueError("a seam has at least two points, each at another place than the last")
        if not np.allclose(np.linalg.norm(self.openings_in_base, axis=1), 1.0, atol=1e-6):
            raise ValueError("Seam.openings_in_base are not unit vectors")

    @property
    def arc_length(self) -> Floats:
        """(N,) way along the seam from its start to each point [m]."""
        steps = np.linalg.norm(np.diff(self.points_in_base, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def tangents(self) -> Floats:
        """(N, 3) unit vectors along the seam, in the direction of welding."""
        along = np.gradient(self.points_in_base, self.arc_length, axis=0)
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class WeldReport:
    """What the tip, the torch and the robot did, in ``base``, in at most a few thousand samples.

    Attributes:
        mode: How the seam was followed.
        completed: Whether the torch came to the seam's end.
        reason: Why it did not; empty when it did.
        planned: (N, 3) the plan [m].
        refined: (M, 3) the seam as the tip felt it; M may be zero [m].
        opening: (3,) unit vector out of the work: deviations are taken across it.
        time: (K,) since the weld began [s].
        tip: (K, 3) where the finger's tip was [m].
        torch: (K, 3) [m].
        robot: (K, 3) where the tip would have been, undeformed: what was commanded [m].
        deflection: (K,) of the tip against the wall, as measured [m].
        wanted: (K,) what was asked of it [m].
        speed: (K,) of the robot's end point along the plane [m/s].
        turn: (K,) angular velocity of the tool [rad/s].
        along: (K,) the torch's way along the plan; the lead-in is before zero [m].
        phases: K names of what the controller was doing.
        figures: By name, in SI units.
        loop: How the loop kept time, by name, in SI units; differs from run to run.
        notes: What is to be done, and what is for the record.
        sigma: (K,) standard deviation of the torch's place across the seam [m], or empty.
        bound: (K,) what its distance from the seam does not exceed [m], or empty.
        band: (K,) the same for 95 % of the seam [m], or empty.
        true_torch: (K, 3) simulation only: where the torch really was [m], or empty.
    """

    mode: str
    completed: bool
    reason: str
    planned: Array
    refined: Array
    opening: Array
    time: Array
    tip: Array
    torch: Array
    robot: Array
    deflection: Array
    wanted: Array
    speed: Array
    turn: Array
    along: Array
    phases: tuple[str, ...]
    figures: Mapping[str, float] = field(default_factory=dict)
    loop: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    sigma: Array = field(default_factory=lambda: np.zeros(0))
    bound: Array = field(default_factory=lambda: np.zeros(0))
    band: Array = field(default_factory=lambda: np.zeros(0))
    true_torch: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        k = len(self.phases)
        for name in ("refined", "tip", "torch", "robot", "true_torch"):
            if not len(getattr(self, name)):  # JSON does not tell (0, 3) from (0,)
                object.__setattr__(self, name, np.zeros((0, 3)))
        freeze(self, planned=(len(self.planned), 3), refined=(len(self.refined), 3), opening=(3,))
        freeze(self, tip=(k, 3), torch=(k, 3), robot=(k, 3))
        freeze(self, true_torch=(len(self.true_torch) and k, 3))
        for name in ("sigma", "bound", "band"):
            freeze(self, **{name: (len(getattr(self, name)) and k,)})
        for name in ("time", "deflection", "wanted", "speed", "turn", "along"):
            freeze(self, **{name: (k,)})
