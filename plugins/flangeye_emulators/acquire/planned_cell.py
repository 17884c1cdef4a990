"""Plan of a simulated cell session: parameters, poses, and which camera sees which target when."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye.errors import StageError
from flangeye.estimation.estimate import Estimate
from flangeye.estimation.plan import best_next, estimate_so_far, predict, predicted_poses
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Axis, Cell, chain
from flangeye.plugin.stage import PlaceParams
from flangeye.types import Floats, Mask, Observation, Source
from flangeye.units import Angle, param
from flangeye_emulators.acquire.moments import (
    DRAWS,
    UNSEEN,
    UPRIGHT,
    ArmsParams,
    CameraView,
    Moments,
    Sighting,
    carried,
)


class CellSessionParams(ArmsParams):
    """Common parameters of simulated cell sessions."""

    sightings: int = Field(60, ge=3, le=100_000)
    """Number of sightings, evenly distributed over the pairs of camera and target."""
    places: dict[str, PlaceParams] = Field(default_factory=dict)
    """True poses of the frames that the cell leaves unknown, by frame; the base of an arm called
    two is two_base."""
    home: dict[str, tuple[Angle, ...]] = Field(default_factory=dict)
    """Joints of an arm at the middle of its poses, by its name."""
    plan: Literal["random", "grid", "next_best"] = "random"
    """Which moments are taken: drawn at random, or a grid of joints, in turn for each camera and
    target; or always the camera, the target and the joints that are most informative for the whole
    cell, given the sightings so far."""
    spread: Angle = param("30 deg", gt=0)
    """Largest change of a joint from home."""
    joints: bool = True
    """Whether the arms report their joint angles; a camera on a link needs them."""


@dataclass(frozen=True, eq=False)
class PlannedCell:
    """A planned session of a cell.

    Attributes:
        moments: Poses of all frames at each possible moment.
        scheduled: Sightings in order; used unless sightings are chosen during the session.
        source: Provenance of the session, with the truth.
        view: Field of view of the cameras.
        chooses: Whether each sighting is chosen by the observations so far.
    """

    moments: Moments
    scheduled: Sequence[Sighting]
    source: Source
    view: CameraView
    chooses: bool

    def sightings(self, seen: Callable[[], Sequence[Observation]]) -> Iterator[Sighting]:
        """Yield the sightings on demand.

        Args:
            seen: Returns the observations so far.
        """
        yield from NextBest(self).sightings(seen) if self.chooses else self.scheduled


class NextBest:
    """Chooses each sighting by the largest expected information, given the observations so far.

    Until these determine all unknowns, each camera-target pair is chosen in turn. A chosen sighting
    in which the camera does not see the target gives no observation, but counts.
    """

    def __init__(self, planned: PlannedCell) -> None:
        """Start without observations."""
        self._planned, self._left = planned, list(planned.scheduled)
        self._rng = np.random.default_rng(len(planned.scheduled))
        self._taken: set[int] = set()
        self._found: Estimate | None = None

    def sightings(self, seen: Callable[[], Sequence[Observation]]) -> Iterator[Sighting]:
        """Yield at most as many sightings as were scheduled."""
        moments, cell = self._planned.moments, self._planned.moments.cell
        for _ in self._planned.scheduled:
            before = seen()
            self._found = estimate_so_far(before, cell)
            chosen = self._choose(before) or self._left.pop(0)
            self._taken.add(chosen[0])
            if self._planned.view.sees(moments.pose(*chosen)[None])[0]:
                yield chosen

    def _choose(self, seen: Sequence[Observation]) -> Sighting | None:
        if self._found is None:
            return None
        cell = self._planned.moments.cell
        # Who may see whom, and what such a sighting measures.
        pairs = {(o.camera, o.target): o for o in seen}
        expected = [o for like in pairs.values() for o in self._in_view(like, self._found)]
        if not expected:
            return None
        best = expected[best_next(expected, self._found, cell, seen)]
        return int(best.id), best.camera, best.target

    def _in_view(self, like: Observation, found: Estimate) -> list[Observation]:
        """Return predicted observations of a target by a camera that sees it, at random moments."""
        moments = self._planned.moments
        # Moments that are compared for each camera and target
        drawn = self._rng.choice(DRAWS, 100, replace=False)
        reported = [
            replace(like, id=str(i), **moments.recorded(i))
            for i in map(int, drawn)
            if i not in self._taken
        ]
        foretold = predict(reported, found.places, moments.cell)
        visible = self._planned.view.sees(predicted_poses(reported, found.places, moments.cell))
        return [foretold[k] for k in np.flatnonzero(visible)]


def plan_cell(
    cell: Cell, seed: int, params: CellSessionParams, view: CameraView, rng: np.random.Generator
) -> PlannedCell:
    """Draw the poses of everything that moves, and assign the moments to camera-target pairs.

    Raises:
        StageError: The true pose of an unknown is not given, or a camera or target has too few
            sightings.
    """
    _require_places(cell, params)
    moments = _draw(cell, params, rng)
    chosen = _schedule(cell, moments, params.sightings, view)
    _require_seen(cell, chosen, params.sightings)
    sightings, unseen = chosen[: params.sightings], chosen[params.sightings :]
    moments = replace(moments, unseen=tuple(moments.exact(*each) for each in unseen))
    note = f"simulated: a cell, {params.sightings} sightings"
    source = moments.source(seed, note, [cell.describe(), params.model_dump(mode="json")])
    return PlannedCell(moments, sightings, source, view, params.plan == "next_best")


def _require_places(cell: Cell, params: CellSessionParams) -> None:
    missing = [name for name in cell.unknown_frames if name not in params.places]
    if missing:
        raise StageError(
            f"a simulated cell: places states the true pose of each unknown frame; missing: "
            f"{', '.join(missing)}; write places: {{{missing[0]}: {{position: [1 m, 0 m, 0 m]}}}}"
        )


def _draw(cell: Cell, params: CellSessionParams, rng: np.random.Generator) -> Moments:
    """Return random poses of everything that moves, reported and true."""
    angles, axes = {}, {}
    for name, mover in cell.movers.items():
        if isinstance(mover, Axis):
            low, high = mover.travel
            shares = (_changes(params.plan, 1, rng)[:, 0] + 1) / 2
            axes[name] = np.array([mover.place(low + x * (high - low)) for x in shares])
        elif mover is None:
            raise StageError(f"a simulated cell: the model of '{name}' is not known")
        else:
            home = np.array(params.home.get(name, UPRIGHT))
            angles[name] = home + params.spread * _changes(params.plan, len(home), rng)
    arms = {name: Arm(model) for name, model in cell.arms.items()}
    reported = axes | carried(cell, arms, angles)
    still = {name: place.matrix for name, place in params.places.items()}
    moments = Moments(cell, reported, cell.frames, angles if params.joints else {}, angles)
    # Of a reported pose, about and along each axis [rad, m]
    noise = math.pi / 18000, 0.05e-3
    built = moments.placed(still | axes).as_built(params.arm, rng)
    return built.disturbed(cell.measured, noise, rng)


def _changes(plan: str, joints: int, rng: np.random.Generator) -> Floats:
    """Return relative changes of joints (N, n), from -1 to 1: random, or a shuffled grid.

    Candidates for a choice are of both kinds, as the most informative ones are often at the edge.
    """
    anywhere = rng.uniform(-1, 1, (DRAWS, joints))
    if plan == "random":
        return anywhere
    steps = (-1.0, 0.0, 1.0)  # in shares of the spread
    grid = np.stack(np.meshgrid(*[steps] * joints, indexing="ij"), axis=-1).reshape(-1, joints)
    order = [rng.permutation(len(grid)) for _ in range(-(-DRAWS // len(grid)))]
    regular = np.asarray(grid[np.concatenate(order)[:DRAWS]])
    either = rng.random((DRAWS, 1)) < 0.5
    return regular if plan == "grid" else np.where(either, regular, anywhere)


def _schedule(cell: Cell, moments: Moments, sightings: int, view: CameraView) -> list[Sighting]:
    """Return the schedule: each camera-target pair in turn, while it has moments in view."""
    free = {p: list(np.flatnonzero(seen)) for p, seen in _visible(cell, moments, view).items()}
    taken: set[int] = set()
    chosen: list[Sighting] = []
    while len(chosen) < sightings + UNSEEN and any(free.values()):
        for (camera, target), left in free.items():
            i = next((i for i in left if i not in taken), None)
            left[:] = [] if i is None else left[left.index(i) + 1 :]
            if i is not None:
                taken.add(int(i))
                chosen.append((int(i), camera, target))
    return chosen


def _visible(cell: Cell, moments: Moments, view: CameraView) -> dict[tuple[str, str], Mask]:
    """Return the mask (N,) of moments in view, by camera and target."""
    pairs = [(camera, target) for camera in cell.cameras for target in cell.targets]
    return {pair: view.sees(moments.seen(*pair)) for pair in pairs if _apart(cell, pair)}


def _apart(cell: Cell, pair: tuple[str, str]) -> bool:
    """Return whether camera and target can move relative to each other."""
    first, second = ({*chain(cell.frames, end)} & {*cell.measured} for end in pair)
    return first != second


def _require_seen(cell: Cell, chosen: list[Sighting], wanted: int) -> None:
    count = Counter(end for _, camera, target in chosen for end in (camera, target))
    for end in (*cell.cameras, *cell.targets):
        # Sightings that each camera and each target takes part in, at least
        if count[end] < 3:
            what = "sees" if end in cell.cameras else "is seen in"
            raise StageError(
                f"a simulated cell: '{end}' {what} {count[end]} of {DRAWS} moments drawn; "
                "move it or the arms' home, or make spread larger"
            )
    if len(chosen) < wanted:
        raise StageError(
            f"a simulated cell: {len(chosen)} of {DRAWS} moments drawn give a sighting, and "
            f"{wanted} are needed; make spread smaller, or move cameras and targets"
        )
