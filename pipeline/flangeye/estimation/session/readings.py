r"""Select the reading of arm and marker poses (inverted, exchanged) if several fit alike.

Every sample satisfies :math:`P C = S M`: :math:`P` is the arm's pose, :math:`C` the carried frame
in the flange, :math:`S` the fixed frame in the base, and :math:`M` the measured pose from the fixed
frame to the carried one. The same numbers also satisfy

.. math:: P^{-1} S = C M^{-1}, \quad M C^{-1} = S^{-1} P, \quad M^{-1} S^{-1} = C^{-1} P^{-1}:

both inverted, exchanged, or both at once; and in each the camera may be fixed or carried. The
residuals of these eight readings differ little. What differs is where camera and target then are,
and the pattern of the residuals: a marker's position is measured better than its rotation times its
distance, and an arm's errors come from its joints.
"""

from __future__ import annotations

from itertools import product
from typing import Literal, NamedTuple, get_args

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.estimation.estimate import Estimate
from flangeye.estimation.session.session import session_of
from flangeye.models.cell import cell_of
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    TARGET,
    Floats,
    Mask,
    Observation,
    PoseFeature,
    Transform,
)
from flangeye.types.geometry import invert

Axes = Literal["opengl", "ros"]
"""A camera's frame with y up and z backward, or with x forward, y left and z up (REP 103)."""


def optical(axes: Axes) -> Floats:
    """Return the (3, 3) rotation from a camera's frame to x right, y down, z forward."""
    if axes == "opengl":
        return np.diag([1.0, -1.0, -1.0])
    return np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


class Pairs(NamedTuple):
    """N poses (N, 4, 4) of an arm and of a marker in the camera; whether the camera is in hand."""

    robot: Floats
    marker: Floats
    in_hand: bool

    def where(self, kept: Mask) -> Pairs:
        """Return some of the poses."""
        return Pairs(self.robot[kept], self.marker[kept], self.in_hand)


class Reading(NamedTuple):
    """Changes to apply to poses as they were read, in this order."""

    exchanged: bool = False
    robot_inverted: bool = False
    marker_inverted: bool = False
    remounted: bool = False

    def of(self, pairs: Pairs) -> Pairs:
        """Return the poses with these changes."""
        robot, marker, in_hand = pairs
        if self.exchanged:
            robot, marker = marker, robot
        robot = invert(robot) if self.robot_inverted else robot
        marker = invert(marker) if self.marker_inverted else marker
        return Pairs(robot, marker, in_hand != self.remounted)

    def mistake(self, in_hand: bool) -> str:
        """Return the mistake in words; ``in_hand`` says whether the camera is now carried."""
        both = self.robot_inverted and self.marker_inverted
        words = [
            "the tables of robot and markers are exchanged" if self.exchanged else "",
            "the poses of robot and markers are both inverted" if both else "",
            "the poses are flange_T_base" if self.robot_inverted and not both else "",
            "the target's poses are target_T_camera" if self.marker_inverted and not both else "",
            f"the camera is {'beside the robot' if in_hand else 'in the hand'}"
            if self.remounted
            else "",
        ]
        return " and ".join(filter(None, words))


def likely(
    pairs: Pairs, carried: float, standing: float, robot: RobotModel | None
) -> list[Reading]:
    """Return the readings that may be meant, likeliest first; several if the data do not decide.

    Args:
        pairs: Poses as they were read; one calibration fits them. Centres have NaN rotations, and
            are neither inverted nor exchanged.
        carried: Distance of the carried frame from the flange [m].
        standing: Distance of the fixed frame from the base [m].
        robot: The arm's model, if it is known.
    """
    # Median distance [m] and spread of its logarithm, from the flange of what an arm carries, and
    # from its base of what stands: as tools and cells are, with room for either to be odd
    held, away = (0.12, 0.8), (0.9, 0.5)
    # Log odds from which places decide between two readings, and from which errors do: the priors
    # of the errors' sizes alone make odds of one or two thousand
    told, likelier = np.log(20.0), np.log(1e4)
    whole = bool(np.isfinite(pairs.marker).all())
    plausible = {}
    for inverse, exchanged, remounted in product((False, True), repeat=3):
        turned = inverse != (exchanged and pairs.in_hand)
        reading = Reading(exchanged, turned, turned != remounted, remounted)
        if whole or not (reading.exchanged or reading.marker_inverted):
            near, far = (standing, carried) if inverse else (carried, standing)
            places = reading.of(pairs).marker[:, :3, 3]
            plausible[reading] = _odds(near, *held) + _odds(far, *away) + _seen(places)
    top = max(plausible.values())
    meant = [reading for reading, each in plausible.items() if each > top - told]
    if len(meant) == 1 or not whole:
        return sorted(meant, key=lambda reading: -plausible[reading])
    costs = dict(zip(meant, _costs(meant, pairs, robot), strict=True))
    odds = {reading: plausible[reading] - cost for reading, cost in costs.items()}
    likely = [reading for reading in meant if odds[reading] > max(odds.values()) - likelier]
    return sorted(likely, key=lambda reading: -odds[reading])


def _odds(distance: float, median: float, spread: float) -> float:
    """Return the log odds of a distance [m]: its logarithm has a Student's t distribution."""
    # With three degrees of freedom, -(3 + 1) / 2 log(1 + t^2 / 3)
    off = np.log(max(distance, 1e-3) / median) / spread
    return float(-2.0 * np.log1p(off**2 / 3.0))


def _seen(places: Floats) -> float:
    """Return the log odds that targets at places (N, 3) are in view, for the best camera axes.

    A camera's half angle of view is 20 to 35 degrees; beyond 60 all angles are equally unlikely.
    """
    off = [
        _off_axis(places),
        _off_axis(places @ optical("opengl").T),
        _off_axis(places @ optical("ros").T),
    ]
    odds = -0.5 * (np.array(off) / np.radians(20)) ** 2 - np.array([0.0, 1.0, 1.5])
    return float(max(odds.max(), -5.0))


def _off_axis(places: Floats) -> float:
    """Return the rms angle of places (N, 3) off the axis z [rad]."""
    angles = np.arctan2(np.hypot(places[:, 0], places[:, 1]), places[:, 2])
    return float(np.sqrt(np.nanmean(angles**2)))


def other_axes(places: Floats) -> Axes | None:
    """Return the camera axes that bring places (N, 3) into view; None if they already are."""
    off = {name: _off_axis(places @ optical(name).T) for name in get_args(Axes)}
    name: Axes = min(off, key=off.__getitem__)
    before = np.radians(40)  # as far from its axis as a wide camera sees
    return name if off[name] < before < _off_axis(places) else None


def _costs(readings: list[Reading], pairs: Pairs, robot: RobotModel | None) -> Floats:
    """Return the negative log restricted likelihood of each reading, on samples without outliers.

    All readings use the same samples. Sixty decide between two readings as well as thousands do.
    """
    some = np.unique(np.linspace(0, len(pairs.robot) - 1, 60).round().astype(int))
    kept = np.isin(np.arange(len(pairs.robot)), some)
    found = [estimated(each.of(pairs).where(kept), robot) for each in readings]
    agree = np.all([each.inliers for each in found if each], axis=0)
    if any(found) and not agree.all():
        kept[np.flatnonzero(kept)[~agree]] = False
        found = [estimated(each.of(pairs).where(kept), robot) for each in readings]
    costs = [0.5 * each.posterior.cost if each else np.inf for each in found]
    left = [each.problem.residuals(each.places)[each.inliers] for each in found if each]
    # Exact poses, to a micrometre, have no noise to tell by: the priors alone would decide
    if left and max(np.abs(each).max(initial=0.0) for each in left) < 1e-6:
        costs = [0.0 if each else np.inf for each in found]
    return np.zeros(len(costs)) if np.isinf(costs).all() else np.array(costs)


def estimated(pairs: Pairs, robot: RobotModel | None) -> Estimate | None:
    """Return the model's estimate from poses; None where it refuses them."""
    # As good as acquire.samples takes markers for: how good they are is estimated [rad, m]
    noise = np.diag(np.square([np.radians(0.2)] * 3 + [0.5e-3] * 3))
    observations = [
        Observation(
            f"{i}",
            PoseFeature(Transform(CAMERA, TARGET, marker), noise),
            {FLANGE: Transform(BASE, FLANGE, flange)},
        )
        for i, (flange, marker) in enumerate(zip(pairs.robot, pairs.marker, strict=True))
    ]
    camera, target = (FLANGE, BASE) if pairs.in_hand else (BASE, FLANGE)
    cell = cell_of(Configuration(camera=camera, target=target), robot)
    try:
        return session_of(observations, cell, None).found
    except (CalibrationRefused, StageError):
        return None
