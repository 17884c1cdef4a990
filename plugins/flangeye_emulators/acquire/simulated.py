"""``acquire.simulated``: moves a simulated arm and renders each scan; the truth is known."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from flangeye.devices import MotionAllowed
from flangeye.errors import NothingMoved, StageError
from flangeye.models.bodies import TargetBody
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange, Sphere, plate_of
from flangeye.motion.reach import Plan, PlannedPose, Reach, Site, poses_near
from flangeye.plugin.stage import BoundPart, Choose, stage
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Box,
    Capture,
    Captures,
    Floats,
    Observation,
    PointCloud,
    Role,
    Seed,
    Source,
    StageLog,
    Transform,
    Truth,
    by_frame,
)  # fmt: skip
from flangeye.types.geometry import invert
from flangeye.units import in_mm, param
from flangeye.workflow.run.prefetch import cores, prefetched
from flangeye_emulators.acquire.moments import UNSEEN, VERSION, fingerprint_of, noise_free
from flangeye_emulators.world.arm import ArmErrors, ImperfectArm
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.raycast import FloatImage, SolidBody
from flangeye_emulators.world.scanner import (
    CameraPose,
    ScannerQuality,
    StructuredLight,
    TimeOfFlight,
    before_camera,
    scanner_of,
)
from flangeye_plugins.acquire.itinerary import as_plan, left_out, row_at


class SimulatedParams(ScannerQuality):
    """Parameters of ``acquire.simulated``."""

    poses: Annotated[BoundPart, Choose("plan")] = param({"grid": {}})
    """Poses the robot visits."""
    camera: CameraPose = Field(default_factory=CameraPose)
    """The scanner's true pose."""
    verification: int = Field(1, ge=0, le=1000)
    """Captures that are kept from solving, near the workspace's middle."""
    arm: ArmErrors = Field(default_factory=ArmErrors)
    """Errors of the arm that its controller does not know of."""
    outliers: float = Field(0.0, ge=0, le=1)
    """Share of the captures in which the flange is covered."""


@stage("acquire.simulated")
def acquire_simulated(  # noqa: PLR0913  what it asks the runner for
    robot: RobotModel,
    scanner: ScannerModel,
    flange: Flange,
    seed: Seed,
    params: SimulatedParams,
    sphere: Sphere | None = None,
    body: TargetBody | None = None,
    stage_log: StageLog | None = None,
    motion: MotionAllowed | None = None,
) -> Captures:
    """Scan a simulated arm that moves its flange through the scanner's field of view.

    The reported poses are the nominal kinematics of the commanded joints; the true arm has its own
    joint zeros. Captures for verification come first. Each scan is rendered on demand. If the
    target is the wrist circle, the robot carries its own plate; a body is mounted on the flange and
    given in the flange's frame.

    Raises:
        StageError: Fewer than three poses are possible.
        NothingMoved: Only the plan was requested.
    """
    plate = flange if flange.bore else plate_of(robot)
    planning, checking, errors, noise, later = np.random.SeedSequence([VERSION, seed]).spawn(5)
    base_T_camera = params.camera.base_T_camera
    shown = body or max(plate.outer, plate.details.wrist / 2)
    reach = Reach(robot, scanner, base_T_camera, shown)
    site = _site(reach, base_T_camera)
    names = f"{robot.model} can show {body.name if body else 'its flange'} to {scanner.model}"
    stops = _stops(reach, site, params, (planning, checking), names)
    if motion and motion.plan_only:
        raise _plan_alone(stops, reach, site)
    unseen = [] if params.arm.is_default else _unseen(stops.plan, site, _rng(checking.spawn(1)[0]))
    cell = SimulatedCell(robot, plate, stops.plan.centre, stops.plan.size, sphere, body)
    session = _session(cell, scanner, stops, unseen, params, errors)
    models = [robot, scanner, flange, params, *([sphere] if sphere else [])]
    made_of: list[Any] = [model.model_dump(mode="json") for model in models]
    source = session.source(fingerprint_of(seed, made_of + ([body.digest] if body else [])))
    whys = [pose.why for pose in stops.all]
    # A plan that says why is heard before each scan, so nothing is scanned ahead of it.
    ahead = not any(whys)
    # Scans that are made at once at most: each holds 160 MB while it is
    scans = session.captures(noise, min(cores(), 4) if ahead else 1)
    look = partial(session.look, rng=_rng(later))
    captures = _explained(scans, whys, stage_log)
    return Captures(captures, source, len(whys), look, recorded=ahead)


def _explained(
    captures: Iterator[Capture], whys: Sequence[str], stage_log: StageLog | None
) -> Iterator[Capture]:
    """Yield the captures; log the plan's reason for each one beforehand."""
    for index, why in enumerate(whys):
        if why and stage_log:
            stage_log("next", {"id": f"{index:04d}", "why": why})
        yield next(captures)


def _site(reach: Reach, base_T_camera: Floats) -> Site:
    eye = base_T_camera[:3, 3]
    return Site(reach.middle(), eye, reach.facing_rotation, reach.joints, shown=lambda: reach.shown)


@dataclass(frozen=True, eq=False)
class _Stops:
    """The planned poses: first those for verification, then those for calibration."""

    plan: Plan
    checks: list[PlannedPose]
    poses: list[PlannedPose]

    @property
    def all(self) -> list[PlannedPose]:
        return [*self.checks, *self.poses]


def _stops(
    reach: Reach,
    site: Site,
    params: SimulatedParams,
    seeds: tuple[np.random.SeedSequence, np.random.SeedSequence],
    names: str,
) -> _Stops:
    plan: Plan = params.poses(site, _rng(seeds[0]))
    poses = list(plan.poses)
    fewest = 3  # without which no camera pose can be found
    if len(poses) < fewest:
        raise StageError(
            f"acquire.simulated: {names} at {len(poses)} of {plan.wanted} planned poses, "
            f"{fewest} are needed ({reach.why_refused()}); "
            "move camera.position, or the plan's centre, or make its size or tilt smaller"
        )
    return _Stops(plan, _checks(plan, site, params.verification, _rng(seeds[1])), poses)


def _plan_alone(stops: _Stops, reach: Reach, site: Site) -> NothingMoved:
    """Return the plan as an exception that ends the stage without a session."""
    roles = ["verification"] * len(stops.checks) + ["calibration"] * len(stops.poses)
    rows = [
        row_at(f"{i:04d}", role, pose, site.eye)
        for i, (role, pose) in enumerate(zip(roles, stops.all, strict=True))
    ]
    wanted = stops.plan.wanted
    head = f"{len(rows)} stops of a simulated arm, {wanted} requested; paths are not simulated"
    return NothingMoved(*as_plan(head, rows, left_out(reach.refusals, stops.all)))


def _checks(plan: Plan, site: Site, count: int, rng: np.random.Generator) -> list[PlannedPose]:
    """Return poses for verification, near the middle of the workspace."""
    found = poses_near(plan.centre, count, site, rng)
    if len(found) < count:
        raise StageError(
            f"acquire.simulated: no pose for verification near the middle of the workspace "
            f"({in_mm(plan.centre)}); move the plan's centre, or set verification: 0"
        )
    return found


def _unseen(plan: Plan, site: Site, rng: np.random.Generator) -> list[Floats]:
    """Return joint angles of poses over the workspace that calibration does not use."""
    # Largest roll, pitch and yaw of the poses at which the true error is measured [rad]
    spread = plan.size / 2, 0.3
    return [pose.joints for pose in poses_near(plan.centre, UNSEEN, site, rng, spread)]


@dataclass(frozen=True, eq=False)
class _Visits:
    """A session that visits every pose once.

    The scanner's buffers, 300 MB, live while captures are read. The arrays of joints (N, n),
    reported and true, end with the poses that calibration does not use.
    """

    cell: SimulatedCell
    scanner: ScannerModel
    stops: _Stops
    params: SimulatedParams
    arm: ImperfectArm
    joints: Floats
    angles: Floats
    of_scanner: np.random.SeedSequence

    @property
    def base_T_camera(self) -> Floats:
        return self.params.camera.base_T_camera

    @property
    def count(self) -> int:
        return len(self.stops.all)

    def source(self, fingerprint: str) -> Source:
        """Return the provenance of the captures, with the truth."""
        plan, found = self.stops.plan, len(self.stops.poses)
        note = f"simulated: {self.cell.robot.model} before {self.scanner.model}, {found} poses"
        if left := plan.wanted - found:
            note += f"; {left} more were planned but are not possible"
        truth = Truth(Transform(BASE, CAMERA, self.base_T_camera), unseen=self._unseen())
        return Source(fingerprint, (note,), Box(plan.centre, plan.size), truth, simulated=True)

    def _unseen(self) -> tuple[Observation, ...]:
        """Return noise-free observations at poses that calibration does not use."""
        joints, angles = self.joints[self.count :], self.angles[self.count :]
        reported = [by_frame(Transform(BASE, FLANGE, pose)) for pose in self.arm.reported(joints)]
        seen = invert(self.base_T_camera) @ self.arm.flange(angles)
        features = map(noise_free, seen)
        each = zip(features, reported, joints, strict=True)
        return tuple(Observation(f"exact-{i}", *known) for i, known in enumerate(each))

    def captures(self, noise: np.random.SeedSequence, at_once: int) -> Iterator[Capture]:
        """Render the captures on demand, or up to ``at_once`` ahead of demand.

        Each capture has its own random generator, so the result does not depend on the order.
        """
        of_covers, *of_captures = noise.spawn(1 + self.count)
        eye = self._eye()
        covered = self._covered(_rng(of_covers))
        around = self.cell.around()

        def captured(index: int) -> Capture:
            rng = _rng(of_captures[index])
            frames, flange = self.arm.stand(self.angles[index], rng)
            cover = [self.cell.board(flange)] if index in covered else []
            bodies = around + self.cell.arm(frames, flange) + cover
            xyz = eye.scan(before_camera(bodies, self.base_T_camera), rng)
            return self._capture(index, xyz, self.arm.reported(self.joints[index]))

        if at_once == 1:
            yield from map(captured, range(self.count))
        else:
            with closing(prefetched(iter(range(self.count)), captured, at_once)) as working:
                for _, made in working:
                    yield made()

    def look(self, bodies: Sequence[SolidBody], rng: np.random.Generator) -> PointCloud:
        """Scan other bodies, given in ``base``, with the same scanner at the same pose."""
        return PointCloud(CAMERA, self._eye().scan(before_camera(bodies, self.base_T_camera), rng))

    def _eye(self) -> StructuredLight | TimeOfFlight:
        """Return the scanner; its distortion is the same for each call."""
        rng = _rng(self.of_scanner)
        return scanner_of(self.scanner, self.params.resolution, self.params.noise, rng)

    def _covered(self, rng: np.random.Generator) -> set[int]:
        """Return the random calibration captures in which a board hides the flange."""
        calibration = np.arange(len(self.stops.checks), self.count)
        count = round(self.params.outliers * len(calibration))
        return set(rng.permutation(calibration)[:count].tolist())

    def _capture(self, index: int, xyz: FloatImage, base_T_flange: Floats) -> Capture:
        role: Role = "verification" if index < len(self.stops.checks) else "calibration"
        # When simulated runs begin: 2024-01-01, 00:00 UTC
        # From one exposure to the next
        return Capture(
            id=f"{index:04d}",
            cloud=PointCloud(CAMERA, xyz),
            poses=by_frame(Transform(BASE, FLANGE, base_T_flange)),
            joints=self.joints[index],
            time_ns=1_704_067_200_000_000_000 + (index + 1) * 4_000_000_000,
            role=role,
        )


def _session(
    cell: SimulatedCell,
    scanner: ScannerModel,
    stops: _Stops,
    unseen: Sequence[Floats],
    params: SimulatedParams,
    errors: np.random.SeedSequence,
) -> _Visits:
    of_arm, of_scanner = errors.spawn(2)
    arm = ImperfectArm(cell.robot, float(params.arm.quality != "exact"), _rng(of_arm), params.arm)
    joints = np.array([*(pose.joints for pose in stops.all), *unseen])
    return _Visits(cell, scanner, stops, params, arm, joints, arm.angles(joints), of_scanner)


def _rng(sequence: np.random.SeedSequence) -> np.random.Generator:
    return np.random.default_rng(sequence)
