"""Tests of drivers: robots, scanners, sensors, profilers. The device or its emulator must be on."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import numpy as np

from flangeye import types as t
from flangeye.devices import (
    GRACE,
    PATIENCE,
    Arc,
    DeviceError,
    FrameDropped,
    Profiler,
    Robot,
    RobotState,
    Scan,
    Scanner,
    StateSource,
    TactileSensor,
)
from flangeye.files.paths import bundled
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.motion.supervision import STANDING
from flangeye.testing.base import (
    Conformance,
    require,
    require_close,
    require_one_line,
    require_round_trip,
)
from flangeye.testing.sources import logged

SPEED = 0.3
"""Joint speed of the kit's moves [rad/s], slow enough for a real arm."""

ACCELERATION = 2.0
"""Joint acceleration of the kit's moves [rad/s^2]."""

TESTED_TURN = 0.1
"""Angle by which the last joint is turned [rad]."""

RESTS = 0.5
"""Longest time from the last look at a moving arm until it rests [s]."""

LATE = 1.0
"""Delay that a busy machine may add to a measured time [s]."""


class DriverConformance(Conformance):
    """Base of the conformance classes of drivers.

    ``params`` describe the connection. If something must be started first, or a fixture provides
    the parameters, override :meth:`open`.

    Attributes:
        unreachable: Parameters of an unreachable device, for testing the refusal.
    """

    unreachable: ClassVar[Any] = None

    def open(self) -> Any:
        """Return the device, open."""
        return self.call()

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the device, and close it after."""
        with self.open() as device:
            yield device

    def test_closing_twice_is_safe_and_it_opens_again(self) -> None:
        """The device can be closed twice, and opened again at once, as on a resume."""
        for _ in range(3):
            device = self.open()
            require(device.name, "the device has no name")
            device.close()
            device.close()

    def test_a_device_that_is_not_there_is_one_line(self) -> None:
        """A missing device raises within PATIENCE, with device, reason and remedy in one line."""
        if self.unreachable is None:
            return
        began = time.monotonic()
        try:
            self.plugin.function(**self._models(), params=self.unreachable).close()
        except DeviceError as error:
            require_one_line(error)
        else:
            raise AssertionError("a device that is not there could be opened")
        took = time.monotonic() - began
        require(took < PATIENCE + LATE, f"the error came after {took:.1f} s, limit {PATIENCE:g} s")

    def _models(self) -> dict[str, Any]:
        values = {**self._cell(), **self.context()}
        return {name: self._value(values, name, need) for name, need in self.plugin.needs.items()}


class RobotConformance(DriverConformance):
    """A ``robot`` part. It moves the last joint by 0.1 rad at 0.3 rad/s: make sure it may."""

    kind = "robot"

    def test_it_says_where_it_is(self) -> None:
        """The state is recent, in metres, and agrees with the model's kinematics."""
        with self.opened() as robot:
            require(isinstance(robot, Robot), "it lacks methods of flangeye.devices.Robot")
            state = robot.state()
            require(isinstance(state, RobotState), f"state() gave {type(state).__name__}")
            pose = state.base_T_flange
            require((pose.parent, pose.child) == (t.BASE, t.FLANGE), f"the pose is {pose.name}")
            require(np.linalg.norm(pose.translation) < 5.0, "the pose is not in metres")
            require(
                len(state.joints) == len(state.joint_speeds), "joints and speeds differ in number"
            )
            require(np.abs(state.joints).max() < 4 * np.pi, "the joints are not in radians")
            require(0 < robot.period < 0.1, f"a period of {robot.period} s")

    def test_time_goes_on(self) -> None:
        """Each control cycle gives a new state, later than the last one."""
        with self.opened() as robot:
            first = robot.state().time_ns
            for _ in range(20):
                robot.wait_cycle()
            require(robot.state().time_ns > first, "the sample's time is the same 20 cycles later")

    def test_a_joint_move_arrives_and_keeps_to_its_speed(self) -> None:
        """The joint moves there and back, never faster than the commanded limit."""
        with self.opened() as robot:
            start = robot.state().joints
            target = start + np.eye(len(start))[-1] * TESTED_TURN
            for joints in (target, start):
                robot.move_joints(joints, SPEED, ACCELERATION)
                fastest, state = self._until_still(robot)
                require_close(state.joints, joints, 1e-3, "a joint after its move [rad]")
                # A speed that is asked for may be exceeded by this much, for a cycle
                require(
                    0.1 * SPEED < fastest <= SPEED * 1.05,
                    f"a joint moved at {fastest:.3g} rad/s, commanded were {SPEED} rad/s",
                )

    def test_it_stops_at_once(self) -> None:
        """An arm stopped in the middle of a move stays at rest."""
        with self.opened() as robot:
            start = robot.state().joints
            self._under_way(robot, start)
            robot.stop()
            robot.stop()
            _, state = self._until_still(robot)
            gone = abs(state.joints[-1] - start[-1])
            require(
                gone < 3 * TESTED_TURN,
                f"after stop() the joint moved {gone:.3g} rad from its start",
            )
            robot.move_joints(start, SPEED, ACCELERATION)
            self._until_still(robot)

    def test_silence_alone_ends_a_move(self) -> None:
        """If the state is no longer read, the arm stops within RESTS and stays at rest.

        So an arm also stops if the program, its guard or the driver's own process hangs. It does
        not move on when the process continues.
        """
        with self.opened() as robot:
            start = robot.state().joints
            before = self._under_way(robot, start)
            time.sleep(RESTS)
            after = robot.state()
            if after.time_ns == before.time_ns:  # an arm whose time passes in its cycles alone
                self._cycles(robot, RESTS)
                after = robot.state()
            gone = _apart(before, after)
            require(
                gone < SPEED * RESTS,
                f"without state() calls the arm moved on by {gone:.3g} rad in {RESTS} s",
            )
            on = max(_apart(after, state) for state in self._watch(robot, 0.5))
            require(
                on < 0.1 * TESTED_TURN,
                f"the arm moves on by {on:.3g} rad when state() is called again after {RESTS} s",
            )
            robot.move_joints(start, SPEED, ACCELERATION)
            self._until_still(robot)

    def test_a_velocity_ends_without_commands(self) -> None:
        """Without commands it brakes after GRACE."""
        with self.opened() as robot:
            start = robot.state().joints
            robot.move_velocity(np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]), 0.2)
            self._cycles(robot, GRACE + 1.0)
            speed = _fastest(robot.state())
            require(speed < STANDING, f"without commands the arm still moves at {speed:.3g} rad/s")
            robot.move_joints(start, SPEED, ACCELERATION)
            self._until_still(robot)

    def _cycles(self, robot: Robot, seconds: float) -> None:
        for _ in range(round(seconds / robot.period)):
            robot.wait_cycle()

    def _watch(self, robot: Robot, seconds: float) -> list[RobotState]:
        """Read the arm's state in each of its cycles, and return the states."""
        seen = []
        for _ in range(round(seconds / robot.period)):
            robot.wait_cycle()
            seen.append(robot.state())
        return seen

    def _under_way(self, robot: Robot, start: t.Floats) -> RobotState:
        """Start a motion and read the state for 0.3 s; repeat if a busy machine read too late."""
        for _ in range(3):
            away = np.eye(len(start))[-1] * 4 * TESTED_TURN
            robot.move_joints(start + away, SPEED, ACCELERATION)
            state = self._watch(robot, 0.3)[-1]
            if _fastest(state) > STANDING:
                return state
            robot.move_joints(start, SPEED, ACCELERATION)
            self._until_still(robot)
        raise AssertionError("the move has not begun")

    def _until_still(self, robot: Robot) -> tuple[float, RobotState]:
        """Return the highest joint speed until rest, and the final joint angles."""
        fastest, still = 0.0, 0
        for _ in range(round(10.0 / robot.period)):
            robot.wait_cycle()
            state = robot.state()
            speed = _fastest(state)
            fastest = max(fastest, speed)
            still = still + 1 if speed < STANDING and state.mode != "moving" else 0
            if still * robot.period > 0.1:
                return fastest, state
        raise AssertionError("the arm does not come to rest within 10 s")


class ScannerConformance(DriverConformance):
    """A ``scanner`` part; there must be something measurable in its view."""

    kind = "scanner"

    def scanned(self, scanner: Scanner) -> Scan:
        """Return one scan; a frame that got lost is asked for again."""
        for _ in range(5):
            try:
                return scanner.expose()()
            except FrameDropped as error:
                require_one_line(error)
        raise AssertionError("five exposures in a row were dropped")

    def test_it_gives_points_in_metres(self) -> None:
        """Points are in ``camera`` [m], within range, single precision, NaN if missing."""
        with self.opened() as scanner:
            require(isinstance(scanner, Scanner), "it lacks methods of flangeye.devices.Scanner")
            cloud = self.scanned(scanner).cloud
        require(cloud.frame == t.CAMERA, f"the cloud is in '{cloud.frame}', not in '{t.CAMERA}'")
        points = cloud.points()
        require(len(points), "a scan without a point")
        require(points.any(axis=1).all(), "missing points are zero; they must be NaN")
        depth = float(np.median(np.linalg.norm(points, axis=1)))
        near, far = self.scanner.near / 20, self.scanner.far * 20
        require(near < depth < far, f"the scan's middle is {depth:.3g} m away: not in metres?")

    def test_it_says_its_unit_and_layout(self) -> None:
        """The device states its unit and layout, and its clouds have that layout."""
        with self.opened() as scanner:
            facts = {name.lower(): value for name, value in scanner.facts.items()}
            require(any("unit" in name for name in facts), "facts do not say the device's unit")
            cloud = self.scanned(scanner).cloud
        if "organised" in facts.get("layout", ""):
            require(cloud.organised, "the device states organised, the cloud is not")

    def test_an_exposure_has_its_time(self) -> None:
        """The exposure lies between request and return, on this computer's clock."""
        with self.opened() as scanner:
            before = time.monotonic_ns()
            scan = self.scanned(scanner)
            after = time.monotonic_ns()
        slack = LATE * 1e9
        require(scan.started_ns >= before - slack, "the exposure began before expose() was called")
        require(
            scan.started_ns <= scan.ended_ns <= after,
            "the exposure's end is before its start, or after expose() returned",
        )

    def test_scans_follow_each_other(self) -> None:
        """A second exposure begins and ends after the first."""
        with self.opened() as scanner:
            first, second = self.scanned(scanner), self.scanned(scanner)
        later = second.started_ns >= first.started_ns and second.ended_ns >= first.ended_ns
        require(later, "the second scan began or ended before the first")

    def test_a_scan_survives_the_log(self) -> None:
        """A capture with the scan is unchanged after it is written to MCAP and read back."""
        with self.opened() as scanner:
            scan = self.scanned(scanner)
        pose = t.Transform(t.BASE, t.FLANGE, np.eye(4))
        capture = t.Capture("0", scan.cloud, t.by_frame(pose), time_ns=scan.ended_ns)
        require_round_trip(capture, logged)


class StreamConformance(DriverConformance):
    """Base of the conformance classes of devices that deliver items by themselves."""

    # Its method that gives the next, and what that is called
    gives: ClassVar[str]

    def given(self, device: Any, count: int) -> list[Any]:
        """Return the next items; a call without a new item returns none."""
        found: list[Any] = []
        limit = time.monotonic() + PATIENCE + LATE
        while len(found) < count and time.monotonic() < limit:
            one = getattr(device, self.gives)()
            if one is None:
                time.sleep(0.002)
            else:
                found.append(one)
        require(
            len(found) == count, f"{len(found)} {self.gives}s within {PATIENCE:g} s, not {count}"
        )
        return found

    def test_it_gives_each_once_with_its_time(self) -> None:
        """Items arrive in order of time, each exactly once."""
        with self.opened() as device:
            times = [one.time_ns for one in self.given(device, 5)]
        require(times == sorted(set(times)), f"{self.gives}s are not in order, or one came twice")

    def test_asking_does_not_wait(self) -> None:
        """The call returns at once, as the control loop makes it 500 times a second."""
        with self.opened() as device:
            self.given(device, 1)
            for _ in range(20):
                took = _seconds(getattr(device, self.gives))
                require(took < 0.05 + LATE / 5, f"{self.gives}() took {took:.3f} s")


class SensorConformance(StreamConformance):
    """A ``sensor`` part. A tactile sensor that is on must deliver frames by itself."""

    kind = "sensor"
    gives = "frame"

    def context(self) -> Mapping[Any, Any]:
        """Return an arm at rest, and the bundled finger."""
        finger = read_model(bundled("data") / "fingers" / "srm.yaml", Finger)
        return {StateSource: _Standing(), Finger: finger}

    def test_its_camera_is_calibrated(self) -> None:
        """The sensor has a pinhole matrix [px] for its images."""
        with self.opened() as sensor:
            require(isinstance(sensor, TactileSensor), "it lacks methods of devices.TactileSensor")
            image = self.given(sensor, 1)[0].image
            matrix = np.asarray(sensor.camera_matrix)
        require(matrix.shape == (3, 3), f"a camera matrix of shape {matrix.shape}")
        rows, columns = image.pixels.shape[:2]
        inside = 0 < matrix[0, 2] < columns and 0 < matrix[1, 2] < rows
        require(inside and matrix[0, 0] > 1, "the camera matrix is not in this image's pixels")


class ProfilerConformance(StreamConformance):
    """A ``profiler`` part: a profile sensor that is on, with a bead below it."""

    kind = "profiler"
    gives = "profile"

    def context(self) -> Mapping[Any, Any]:
        """Return an arm at rest; a profile sensor alone needs no finger."""
        return {StateSource: _Standing(), TactileSensor: None}

    def test_its_profiles_are_in_metres(self) -> None:
        """Each profile has an offset and its standard deviation in metres, at a fixed distance."""
        with self.opened() as profiler:
            require(isinstance(profiler, Profiler), "it lacks methods of devices.Profiler")
            looks, behind = self.given(profiler, 5), profiler.behind
        require(all(abs(look.offset) < 0.1 for look in looks), "an offset is not in metres")
        require(all(0.0 < look.sigma < 0.01 for look in looks), "a sigma is not in metres")
        require(0.0 < behind < 0.5, f"it looks {behind} m behind the torch")


class ArcConformance(DriverConformance):
    """An ``arc`` part: a power source. Remove wire and gas first, so that nothing burns."""

    kind = "arc"

    def test_it_switches_gas_and_arc_without_waiting(self) -> None:
        """The guard of the arm switches it between two of the arm's cycles."""
        with self.opened() as arc:
            require(isinstance(arc, Arc), "it lacks methods of devices.Arc")
            for switch in (arc.gas, arc.burn, arc.burn, arc.gas):
                for on in (True, False):
                    took = _seconds(partial(switch, on))
                    require(took < 0.05 + LATE / 5, f"switching took {took:.3f} s")

    def test_it_says_whether_it_burns_or_that_it_does_not_know(self) -> None:
        """An arc without feedback returns None, not False, which would mean that it went out."""
        with self.opened() as arc:
            says = arc.burning()
        require(says in (True, False, None), f"burning() returned {says!r}")


def _apart(first: RobotState, second: RobotState) -> float:
    return float(np.abs(second.joints - first.joints).max())


def _fastest(state: RobotState) -> float:
    return float(np.abs(state.joint_speeds).max())


class _Standing:
    """An arm at rest, on this computer's clock."""

    def state(self) -> RobotState:
        pose = t.Transform(t.BASE, t.FLANGE, np.eye(4))
        return RobotState(pose, np.zeros(6), np.zeros(6), time.monotonic_ns(), "ready")


def _seconds(call: Callable[[], Any]) -> float:
    began = time.monotonic()
    call()
    return time.monotonic() - began
