"""``scanner.emulator`` and ``scanner.mounted``: scanners in a simulated cell."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from flangeye.devices import PATIENCE, DeviceError, FrameDropped, Scan, Scanner
from flangeye.errors import FlangeyeError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel, middle_of_view
from flangeye.models.targets import plate_of
from flangeye.models.workpiece import load_workpiece
from flangeye.plugin.stage import Params, part
from flangeye.types import BASE, CAMERA, Array, Floats, PointCloud, Transform, Truth
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye_emulators.controllers.client import EmulatorControl, address_of
from flangeye_emulators.world import bench
from flangeye_emulators.world.bench import BenchParams, bench_with
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.raycast import FloatImage, RaycastScene
from flangeye_emulators.world.scanner import (
    CameraPose,
    ScannerQuality,
    StructuredLight,
    TimeOfFlight,
    before_camera,
    scanner_of,
)
from flangeye_plugins.scanner.opened import OpenScanner


class MountedParams(ScannerQuality, BenchParams):
    """Parameters of ``scanner.mounted``."""

    # The scanner's true position in ``flange`` [m]
    mount: ClassVar[tuple[float, float, float]] = (0.06, 0.0, 0.04)
    seed: int = Field(0, ge=0)
    """Seed of noise, distortion and clutter."""

    @property
    def flange_T_camera(self) -> Floats:
        """Pose (4, 4) of the scanner on the flange [m]; it is rotated by 90 deg about z."""
        return rigid(rotation_from_rpy(0.0, 0.0, np.pi / 2), np.asarray(self.mount))


@part("scanner.mounted")
def scanner_mounted(model: ScannerModel | None, params: MountedParams) -> Scanner:
    """A simulated scanner on the simulated arm's flange, which scans a workpiece on a bench.

    Raises:
        DeviceError: The recipe has no scanner model, or no simulated arm carries the scanner.
    """
    if model is None:
        raise DeviceError(
            "scanner.mounted: the recipe must name the scanner to simulate: scanner.model"
        )
    if bench.newest() is None:
        raise DeviceError(
            "scanner.mounted: no simulated arm carries it; give the recipe robot.driver: simulated"
        )
    return MountedScanner(model, params)


class MountedScanner(OpenScanner):
    """A simulated scanner on a flange; simulated time stops during an exposure.

    Attributes:
        true_seams: True seams by name, (N, 3) in ``base`` [m]; not to be used by planning stages.
    """

    def __init__(self, model: ScannerModel, params: MountedParams) -> None:
        """Place the workpiece; the scanner's distortion is the same for every exposure."""
        distortion, clutter, self._noise = np.random.default_rng(params.seed).spawn(3)
        self._eye = scanner_of(model, params.resolution, params.noise, distortion)
        rows, columns = self._eye.pixels.shape
        facts = {"unit": "m", "layout": f"organised, {columns} x {rows}", "simulated": "yes"}
        super().__init__(f"simulated {model.model} on the flange, seed {params.seed}", facts)
        workpiece = load_workpiece(params.workpiece)
        self._bodies = bench_with(workpiece, params.base_T_part, params.covered, clutter)
        self.true_seams: dict[str, Array] = dict(params.true_seams(workpiece))
        self._flange_T_camera = params.flange_T_camera

    def expose(self) -> Callable[[], Scan]:
        """Scan from the arm's present pose.

        Raises:
            DeviceError: The simulated arm no longer exists.
        """
        arm = bench.newest()
        if arm is None:
            raise DeviceError(f"{self.name}: the arm that carries it is gone")
        scene = before_camera(self._bodies, arm.true_flange() @ self._flange_T_camera)
        cloud = PointCloud(CAMERA, self._eye.scan(scene, self._noise))
        now = arm.state().time_ns
        return lambda: Scan(cloud, now, now)


class LoopbackScannerParams(Params):
    """Parameters of ``scanner.emulator``."""

    host: str = "auto"
    """Address of the controller; auto: that of this run's emulator."""
    robot: str = "ur5e"
    """Robot model of the controller: one of data/robots, or a file."""
    camera: CameraPose = Field(default_factory=CameraPose)
    """The scanner's true pose."""
    # The wall and the stand are beside this box [m]
    workspace: ClassVar[tuple[float, float, float]] = (0.3, 0.3, 0.2)
    seed: int = Field(0, ge=0)
    """Seed of noise, distortion and dropped frames."""
    # Scale of the scanner's noise and distortion
    noise: ClassVar[float] = 1.0
    resolution: float = Field(0.35, gt=0, le=1)
    """Scale of columns and rows; at 1 a scan takes seconds."""
    # Exposure time, during which the arm must stand still [s]
    exposure: ClassVar[float] = 0.3
    # Time from the end of the exposure to the data [s]
    latency: ClassVar[float] = 0.2
    dropped: float = Field(0.0, ge=0, le=1)
    """Share of exposures that are lost."""
    lost_after: int | None = Field(None, ge=0)
    """Exposures after which the scanner is gone, as if unplugged."""


@part("scanner.emulator")
def scanner_loopback(model: ScannerModel | None, params: LoopbackScannerParams) -> Scanner:
    """A simulated scanner that sees the cell of an emulated controller on loopback.

    Raises:
        DeviceError: The recipe has no scanner model, no controller answers, or it drives another
            arm.
    """
    if model is None:
        raise DeviceError(
            "scanner.emulator: the recipe must name the scanner to simulate: scanner.model"
        )
    try:
        control = EmulatorControl(address_of(params.host), patience=PATIENCE)
    except FlangeyeError as error:
        raise DeviceError(f"scanner.emulator: {error}") from None
    scanner = LoopbackScanner(model, params, control)
    try:
        scanner.require_same_arm()
        scanner.prepare()
    except DeviceError:
        scanner.close()
        raise
    return scanner


class LoopbackScanner(OpenScanner):
    """A simulated scanner in a controller's cell; motion during an exposure blurs the scan.

    Attributes:
        truth: True pose of the scanner.
    """

    def __init__(
        self, model: ScannerModel, params: LoopbackScannerParams, control: EmulatorControl
    ) -> None:
        """Set up the cell.

        Args:
            model: Model of the scanner.
            params: Parameters of the driver.
            control: Open control channel of the controller.
        """
        faults, distortion = np.random.default_rng(params.seed).spawn(2)
        eye = scanner_of(model, params.resolution, params.noise, distortion)
        rows, columns = eye.pixels.shape
        facts = {"unit": "m", "layout": f"organised, {columns} x {rows}", "simulated": "yes"}
        super().__init__(f"simulated {model.model}, seed {params.seed}", facts)
        base_T_camera = params.camera.base_T_camera
        self.truth = Truth(Transform(BASE, CAMERA, base_T_camera))
        self._control, self._params, self._faults = control, params, faults
        self._studio = CellScene(
            load_model("robots", params.robot), eye, base_T_camera, np.asarray(params.workspace)
        )
        self._count = 0

    def require_same_arm(self) -> None:
        """Raise DeviceError if the controller drives another arm than the model's."""
        off = self._studio.disagreement(self._stance())
        # Largest distance of the controller's flange from where the robot's model puts it [m]
        if not off < 1e-3:
            raise DeviceError(
                f"scanner.emulator: the controller at {self._params.host} does not move the "
                f"model {self._params.robot}: set robot to what it moves"
            )

    def prepare(self) -> None:
        """Load slow data before the arm moves, because rendering delays the detection of faults."""
        self._studio.prepare(self._stance())

    def expose(self) -> Callable[[], Scan]:
        """Scan the arm for the duration of an exposure."""
        self._require_present()
        self._count += 1
        index, dropped = self._count, self._faults.random() < self._params.dropped
        started = time.monotonic_ns()
        stances = self._stances()
        ended = time.monotonic_ns()

        def transfer() -> Scan:
            xyz = self._studio.scan(stances, (self._params.seed, index))
            _wait_until(ended * 1e-9 + self._params.latency)
            if dropped:
                raise FrameDropped(f"{self.name}: frame {index} was lost on its way")
            return Scan(PointCloud(CAMERA, xyz), started, ended)

        return transfer

    def close(self) -> None:
        """Disconnect from the controller."""
        self._control.close()

    def _require_present(self) -> None:
        after = self._params.lost_after
        if after is not None and self._count >= after:
            raise DeviceError(
                f"{self.name}: disconnected after {after} exposures, as lost_after states"
            )

    def _stances(self) -> list[TrueStance]:
        """Return the arm's true stances at even times over the exposure."""
        began = time.monotonic()
        stances = []
        # How often the arm's place is asked for during one exposure: at its ends and in its middle
        for after in np.linspace(0.0, self._params.exposure, 3):
            _wait_until(began + after)
            stances.append(self._stance())
        return stances

    def _stance(self) -> TrueStance:
        try:
            truth = self._control.truth()
        except (FlangeyeError, ValueError, OSError) as error:
            raise DeviceError(f"{self.name}: lost: {error}") from None
        return TrueStance(truth.joints, truth.base_T_flange)


def _wait_until(moment: float) -> None:
    time.sleep(max(0.0, moment - time.monotonic()))


class TrueStance(NamedTuple):
    """True stance of an arm: joint angles (n,) [rad] and flange pose (4, 4)."""

    joints: Floats
    base_T_flange: Floats


class CellScene:
    """The simulated cell with its scanner and an arm that may move."""

    def __init__(
        self,
        robot: RobotModel,
        eye: StructuredLight | TimeOfFlight,
        base_T_camera: Floats,
        workspace: Floats,
    ) -> None:
        """Set up the cell around the centre of the scanner's view.

        Args:
            robot: The arm; it carries the plate its model names.
            eye: The scanner.
            base_T_camera: (4, 4) true pose of the scanner.
            workspace: (3,) size of the workspace, beside which wall and stand are placed [m].
        """
        plate = plate_of(robot)
        scanner: ScannerModel = eye.scanner
        self._cell = SimulatedCell(robot, plate, middle_of_view(scanner, base_T_camera), workspace)
        self._around = self._cell.around()
        self._arm = Arm(robot)
        self._eye, self._base_T_camera = eye, base_T_camera

    def disagreement(self, stance: TrueStance) -> float:
        """Return the distance of the flange from the model's forward kinematics [m].

        It is infinite for an arm with another number of joints.
        """
        if len(stance.joints) != self._arm.n:
            return float("inf")
        modelled = self._arm.flange(stance.joints)
        return float(np.linalg.norm((modelled - stance.base_T_flange)[:3, 3]))

    def scan(self, stances: Sequence[TrueStance], seed: Sequence[int]) -> FloatImage:
        """Return one scan (H, W, 3) in ``camera`` [m] of an arm seen at several stances.

        The scan is the mean over the stances; a point missing at one of them is missing.
        """
        looks = [self._look(stance, seed) for stance in _distinct(stances)]
        return looks[0] if len(looks) == 1 else np.mean(looks, axis=0, dtype=np.float32)

    def prepare(self, stance: TrueStance) -> None:
        """Compute in advance what the first scan needs at a stance."""
        self._scene(stance)

    def _look(self, stance: TrueStance, seed: Sequence[int]) -> FloatImage:
        return self._eye.scan(self._scene(stance), np.random.default_rng(seed))

    def _scene(self, stance: TrueStance) -> RaycastScene:
        bodies = self._cell.arm(self._arm.frames(stance.joints), stance.base_T_flange)
        return before_camera([*self._around, *bodies], self._base_T_camera)


def _distinct(stances: Sequence[TrueStance]) -> list[TrueStance]:
    kept = [stances[0]]
    for stance in stances[1:]:
        # Of an arm that stands, no entry of its flange's pose changes by more [m, 1]
        if np.abs(stance.base_T_flange - kept[-1].base_T_flange).max() > 1e-6:
            kept.append(stance)
    return kept
