"""``acquire.simulated_cell``: targets seen by the cameras of a cell, as poses with noise."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from flangeye.errors import StageError
from flangeye.maths.frame_graph import Frame, chain, composed
from flangeye.maths.geometry import invert, rigid, rotation_exp
from flangeye.models.cell import Axis, Cell
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params, stage
from flangeye.types import (
    CAMERA,
    TARGET,
    Floats,
    Observation,
    Observations,
    PoseFeature,
    Seed,
    Source,
    Transform,
    Truth,
)
from flangeye.units import Angle, Length, param
from flangeye_emulators.acquire.planned_session import UNSEEN, VERSION, PlaceParams, noise_free
from flangeye_emulators.world.arm import ArmErrors, ImperfectArm
from flangeye_emulators.world.session import DRAWS, View, disturbed

UPRIGHT = np.radians([0, -90, 90, -90, -90, 0])
"""Joints of an arm of which nothing is said."""
FEWEST = 3
"""Sightings that each camera and each target takes part in, at least."""


class SimulatedCellParams(Params):
    """Parameters of ``acquire.simulated_cell``."""

    sightings: int = Field(60, ge=3, description="How many, dealt evenly to who sees whom.")
    places: dict[str, PlaceParams] = Field(
        default_factory=dict,
        description="Where everything that the cell leaves unknown truly is, by frame; the base of "
        "an arm called two is two_base.",
    )
    home: dict[str, tuple[Angle, ...]] = Field(
        default_factory=dict,
        description="Joints of an arm at the middle of its poses, by its name.",
    )
    spread: Angle = param("30 deg", gt=0, description="Largest change of a joint from there.")
    field: tuple[Angle, Angle] = param(("50 deg", "40 deg"), description="Cameras' angles of view.")
    near: Length = param("300 mm", gt=0, description="Nearest that cameras see.")
    far: Length = param("2 m", gt=0, description="Farthest.")
    facing: Angle = param(
        "50 deg", gt=0, description="Largest angle between a target's z and the view."
    )
    target_rotation: Angle = param("0.05 deg", gt=0, description="Noise of a target's pose.")
    target_position: Length = param("0.1 mm", gt=0, description="And of its place.")
    outliers: float = Field(0.0, ge=0, lt=0.5, description="Share of sightings that are wrong.")
    robot_rotation: Angle = param("0.01 deg", ge=0, description="Noise of a reported pose.")
    robot_position: Length = param("0.05 mm", ge=0, description="And of its place.")
    arm: ArmErrors = Field(
        default_factory=ArmErrors,
        description="How far the arms are from what their controllers say; by default by the "
        "noise of the pose alone.",
    )


@stage("acquire.simulated_cell")
def acquire_simulated_cell(cell: Cell, seed: Seed, params: SimulatedCellParams) -> Observations:
    """Let every camera of a cell see every target that comes into its view, arms moving at random.

    Each sighting is of a moment of its own; its pose has noise, as a marker's has.

    Raises:
        StageError: The place of an unknown is not given, or a camera or target takes part in too
            few sightings.
    """
    rng = np.random.default_rng([VERSION, seed])
    _require_places(cell, params)
    moments = _draw(cell, params, rng)
    chosen = _deal(cell, moments, params)
    calibration, unseen = chosen[: params.sightings], chosen[params.sightings :]
    truth = Truth(*_true(cell, params), unseen=tuple(moments.exact(*each) for each in unseen))
    source = replace(_source(cell, seed, params), truth=truth)
    return Observations(_seen(moments, calibration, params, rng), source, len(calibration))


def _require_places(cell: Cell, params: SimulatedCellParams) -> None:
    missing = [name for name in cell.unknown_frames if name not in params.places]
    if missing:
        raise StageError(
            f"acquire.simulated_cell: places says where everything unknown truly is, and lacks "
            f"{', '.join(missing)}: write places: {{{missing[0]}: {{position: [1 m, 0 m, 0 m]}}}}"
        )


Sight = tuple[int, str, str]
"""A moment, a camera, a target."""


@dataclass(frozen=True, eq=False)
class _Moments:
    """What the controllers report at N moments, and where things are.

    Attributes:
        cell: What stands on what.
        reported: (N, 4, 4) by what moves.
        actual: All frames with their true places.
    """

    cell: Cell
    reported: Mapping[str, Floats]
    actual: Mapping[str, Frame]

    def seen(self, camera: str, target: str) -> Floats:
        """Return (N, 4, 4) camera_T_target."""
        return np.asarray(invert(_each(self.actual, camera)) @ _each(self.actual, target))

    def pose(self, i: int, camera: str, target: str) -> Floats:
        """Return (4, 4) camera_T_target at one moment."""
        frames = {
            name: replace(frame, place=frame.place[i])
            if frame.place is not None and frame.place.ndim == 3
            else frame
            for name, frame in self.actual.items()
        }
        return np.asarray(invert(composed(frames, camera)) @ composed(frames, target))

    def exact(self, i: int, camera: str, target: str) -> Observation:
        """Return what a camera without noise sees."""
        poses = {
            name: Transform(f"{name}_base", name, places[i])
            for name, places in self.reported.items()
        }
        return replace(
            noise_free(self.pose(i, camera, target), i, poses, None),
            id=f"{i:04d}-{camera}-{target}",
            camera=camera,
            target=target,
        )


def _each(frames: Mapping[str, Frame], name: str) -> Floats:
    return np.broadcast_to(composed(frames, name), (DRAWS, 4, 4))


def _draw(cell: Cell, params: SimulatedCellParams, rng: np.random.Generator) -> _Moments:
    """Draw where everything that moves is reported to be, and where it then is."""
    drawn = {name: _moved(name, mover, params, rng) for name, mover in cell.movers.items()}
    reported = {name: places for name, (places, _) in drawn.items()}
    noise = params.robot_rotation, params.robot_position
    actual = {name: disturbed(places, noise, rng) for name, (_, places) in drawn.items()}
    still = {name: place.matrix for name, place in params.places.items()}
    frames = {
        name: replace(frame, place=(still | actual).get(name, frame.place))
        for name, frame in cell.frames.items()
    }
    return _Moments(cell, reported, frames)


def _moved(
    name: str, mover: RobotModel | Axis, params: SimulatedCellParams, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return (N, 4, 4) places of what moves in its base: as reported, and as it is on average."""
    if isinstance(mover, Axis):
        places = np.array([mover.place(x) for x in rng.uniform(*mover.travel, DRAWS)])
        return places, places
    home = np.array(params.home.get(name, UPRIGHT))
    joints = home + rng.uniform(-params.spread, params.spread, (DRAWS, len(home)))
    arm = ImperfectArm(mover, 0.0 if params.arm.is_default else 1.0, rng.spawn(1)[0], params.arm)
    return arm.reported(joints), arm.flange(arm.angles(joints))


def _deal(cell: Cell, moments: _Moments, params: SimulatedCellParams) -> list[Sight]:
    """Choose who sees whom at which moment: each pair in turn, as long as it sees anything."""
    view = View(0.0, params.near, params.far, params.field, params.facing)
    pairs = [(camera, target) for camera in cell.cameras for target in cell.targets]
    free = {p: list(np.flatnonzero(view.sees(moments.seen(*p)))) for p in pairs if _apart(cell, p)}
    taken: set[int] = set()
    chosen: list[Sight] = []
    while len(chosen) < params.sightings + UNSEEN and any(free.values()):
        for (camera, target), left in free.items():
            i = next((i for i in left if i not in taken), None)
            left[:] = [] if i is None else left[left.index(i) + 1 :]
            if i is not None:
                taken.add(int(i))
                chosen.append((int(i), camera, target))
    _require_seen(cell, chosen, params.sightings)
    return chosen


def _apart(cell: Cell, pair: tuple[str, str]) -> bool:
    """Return whether anything moves the two against each other."""
    first, second = ({*chain(cell.frames, end)} & {*cell.movers} for end in pair)
    return first != second


def _require_seen(cell: Cell, chosen: list[Sight], wanted: int) -> None:
    count = Counter(end for _, camera, target in chosen for end in (camera, target))
    for end in (*cell.cameras, *cell.targets):
        if count[end] < FEWEST:
            what = "sees" if end in cell.cameras else "is seen in"
            raise StageError(
                f"acquire.simulated_cell: '{end}' {what} {count[end]} of {DRAWS} moments drawn; "
                "move it or the arms' home, or make spread larger"
            )
    if len(chosen) < wanted:
        raise StageError(
            f"acquire.simulated_cell: {len(chosen)} of {DRAWS} moments drawn give a sighting, and "
            f"{wanted} are needed; make spread smaller, or move cameras and targets"
        )


def _seen(
    moments: _Moments, chosen: list[Sight], params: SimulatedCellParams, rng: np.random.Generator
) -> Iterator[Observation]:
    """Yield the sightings with their noise; some are wrong."""
    deviations = np.repeat([params.target_rotation, params.target_position], 3)
    wrong = set(rng.permutation(len(chosen))[: round(params.outliers * len(chosen))])
    for i, sight in enumerate(chosen):
        exact, pose = moments.exact(*sight), moments.pose(*sight)
        error = deviations * rng.standard_normal(6)
        error += (i in wrong) * np.repeat([0.5, 0.1], 3) * rng.standard_normal(6)
        noisy = rigid(rotation_exp(error[:3]) @ pose[:3, :3], pose[:3, 3] + error[3:])
        feature = PoseFeature(Transform(CAMERA, TARGET, noisy), np.diag(deviations**2))
        yield replace(exact, feature=feature)


def _true(cell: Cell, params: SimulatedCellParams) -> tuple[Transform, tuple[Transform, ...]]:
    camera, *others = (
        Transform.named(cell.name_of(name), params.places[name].matrix)
        for name in cell.unknown_frames
    )
    return camera, tuple(others)


def _source(cell: Cell, seed: int, params: SimulatedCellParams) -> Source:
    made_of = [cell.describe(), params.model_dump(mode="json")]
    text = json.dumps([VERSION, seed, made_of], sort_keys=True)
    note = f"simulated: a cell, {params.sightings} sightings"
    return Source(hashlib.sha256(text.encode()).hexdigest(), (note,))
