"""The unmodified ur_rtde client against a controller in a process of its own."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flangeye_emulators.controllers.poses import pose_matrix, pose_vector, twist_between
from tests.emulators.controllers.desk import HOME, away
from tests.emulators.controllers.process import Process

pytestmark = pytest.mark.realtime

reason = "the client library ur-rtde is not installed: pip install 'flangeye[ur]'"
rtde_control = pytest.importorskip("rtde_control", reason=reason)
rtde_receive = pytest.importorskip("rtde_receive", reason=reason)
rtde_io = pytest.importorskip("rtde_io", reason=reason)
dashboard_client = pytest.importorskip("dashboard_client", reason=reason)

OTHER = [0.2, -1.4, 1.3, -1.5, -1.4, 0.1]


def wait_until(condition, control=None, patience=10.0):
    """Wait for what the client sees late on a busy machine."""
    limit = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < limit, control and control.log()[-5:]
        time.sleep(0.005)


class Cell:
    """A controller and every connection of the client to it."""

    def __init__(self, process):
        self.process, self.control = process, process.control
        self.receive = rtde_receive.RTDEReceiveInterface(process.host)
        self.robot = rtde_control.RTDEControlInterface(process.host)
        self.io = rtde_io.RTDEIOInterface(process.host)
        self.dashboard = dashboard_client.DashboardClient(process.host)
        self.dashboard.connect()

    def disconnect(self):
        for connection in (self.robot, self.receive, self.io, self.dashboard):
            connection.disconnect()

    def pose(self):
        """The tool's pose, not older than the question."""
        now = self.control.state()["time"]
        self.until(lambda: self.receive.getTimestamp() >= now)
        return np.array(self.receive.getActualTCPPose())

    def reaches(self, target, tolerance):
        """Wait until the tool is seen at a pose."""
        there = pose_matrix(target)
        self.until(lambda: np.abs(twist_between(pose_matrix(self.pose()), there)).max() < tolerance)

    def turns_to(self, joints, tolerance):
        """Wait until the joints are seen at their angles."""
        self.until(lambda: np.abs(np.subtract(self.receive.getActualQ(), joints)).max() < tolerance)

    def until(self, condition):
        wait_until(condition, self.control)


@pytest.fixture(scope="module")
def running() -> Iterator[Cell]:
    with Process() as process:
        cell = Cell(process)
        yield cell
        cell.disconnect()


@pytest.fixture
def cell(running: Cell) -> Any:
    """The cell at rest, with nothing around it."""
    running.control.clear()
    running.control.set_surfaces()
    if not running.robot.isProgramRunning():
        running.robot.reuploadScript()
        running.until(running.robot.isProgramRunning)
    running.control.put(HOME)
    running.robot.setTcp([0.0] * 6)
    running.turns_to(HOME, 1e-12)
    return running


def test_it_connects_and_sees_the_arm(cell: Any) -> None:
    assert cell.receive.isConnected()
    assert cell.robot.isConnected()
    assert cell.robot.isProgramRunning()
    cell.turns_to(HOME, 1e-12)
    truth = cell.control.truth()
    assert np.allclose(pose_matrix(cell.pose()), truth.base_T_flange)
    assert cell.receive.getRobotMode() == 7
    assert cell.receive.getSafetyMode() == 1
    assert cell.receive.getRuntimeState() == 2
    assert cell.receive.getSafetyStatusBits() == 1
    assert cell.receive.getRobotStatus() == 3


def test_moves(cell: Any) -> None:
    target = away(cell.pose(), 0.08, 0.05, -0.06, 0, 0, 0)
    began = time.monotonic()
    assert cell.robot.moveL(target.tolist(), 0.25, 1.2)
    way = np.linalg.norm([0.08, 0.05, -0.06])
    assert time.monotonic() - began >= way / 0.25 + 0.25 / 1.2 - 0.01
    cell.reaches(target, 1e-9)
    assert cell.robot.moveJ(OTHER, 1.05, 1.4)
    cell.turns_to(OTHER, 1e-12)


def test_a_move_in_the_background_and_its_stop(cell: Any) -> None:
    start = cell.pose()
    target = away(start, 0.1, 0, 0, 0, 0, 0)
    assert cell.robot.moveL(target.tolist(), 0.1, 1.0, True)
    assert cell.robot.getAsyncOperationProgress() >= 0
    cell.until(lambda: cell.receive.getActualTCPSpeed()[0] > 0.09)
    cell.robot.stopL(2.0)
    assert cell.robot.getAsyncOperationProgress() < 0
    assert 0.005 < cell.pose()[0] - start[0] < 0.09
    assert cell.robot.moveL(target.tolist(), 0.2, 1.0, True)
    cell.until(lambda: cell.robot.getAsyncOperationProgress() < 0)
    cell.reaches(target, 1e-9)


def test_a_stream_of_velocities(cell: Any) -> None:
    start = cell.pose()
    for cycle in range(300):
        began = cell.robot.initPeriod()
        speed = 0.05 * np.sin(np.pi * cycle / 300)
        cell.robot.speedL([speed, 0, 0, 0, 0, 0], 1.0)
        cell.robot.waitPeriod(began)
    assert cell.robot.speedStop(1.0)
    moved = cell.pose() - start
    # The sine's mean over 0.6 s; a loaded machine makes the periods longer.
    assert moved[0] > 0.05 * 2 / np.pi * 0.6 * 0.95
    assert np.abs(moved[1:3]).max() < 1e-6


def test_outputs(cell: Any) -> None:
    assert cell.io.setStandardDigitalOut(3, True)
    assert cell.io.setToolDigitalOut(1, True)
    assert cell.io.setConfigurableDigitalOut(2, True)
    cell.until(lambda: cell.receive.getActualDigitalOutputBits() == 1 << 3 | 1 << 17 | 1 << 10)
    assert cell.receive.getDigitalOutState(3)
    for level in (cell.io.setStandardDigitalOut(3, False), cell.io.setToolDigitalOut(1, False)):
        assert level
    assert cell.io.setConfigurableDigitalOut(2, False)
    cell.until(lambda: cell.receive.getActualDigitalOutputBits() == 0)


def test_the_dashboard(cell: Any) -> None:
    board = cell.dashboard
    assert board.isConnected()
    assert board.polyscopeVersion() == "5.21.3.1"
    assert board.isInRemoteControl()
    assert board.running()
    assert board.robotmode() == "Robotmode: RUNNING"
    assert board.safetymode() == "Safetymode: NORMAL"


def test_a_protective_stop_and_the_way_back(cell: Any) -> None:
    cell.control.fault("protective-stop")
    cell.control.unlock_after(0.0)
    cell.until(cell.receive.isProtectiveStopped)
    target = (away(cell.pose(), 0.05, 0, 0, 0, 0, 0)).tolist()
    assert not cell.robot.moveL(target)
    cell.dashboard.unlockProtectiveStop()
    cell.until(lambda: not cell.receive.isProtectiveStopped())
    assert not cell.robot.moveL(target)
    assert cell.robot.reuploadScript()
    cell.until(cell.robot.isProgramRunning)
    assert cell.robot.moveL(target)


def test_a_tool_is_set_and_told(cell: Any) -> None:
    tool = [0.0, 0.0, 0.12, 0.0, 0.0, 0.0]
    flange = cell.pose()
    assert cell.robot.setTcp(tool)
    assert cell.robot.getTCPOffset() == pytest.approx(tool)
    cell.reaches(pose_vector(pose_matrix(flange) @ pose_matrix(tool)), 1e-9)


def test_packages_come_at_500_hertz(cell: Any) -> None:
    """By the controller's clock; how many of them a client sees depends on the machine's load."""
    stamps = set()
    limit = time.monotonic() + 1.0
    while time.monotonic() < limit:
        stamps.add(cell.receive.getTimestamp())
        time.sleep(0.0003)
    steps = np.diff(sorted(stamps))
    assert steps.min() == pytest.approx(0.002)
    assert np.allclose(steps / 0.002, np.round(steps / 0.002), atol=1e-3)


@pytest.mark.parametrize("model", ["ur3e", "ur5", "ur10e"])
def test_other_arms_and_older_boxes(model: str) -> None:
    with Process(model=model) as process:
        robot = rtde_control.RTDEControlInterface(process.host)
        receive = rtde_receive.RTDEReceiveInterface(process.host)
        target = list(receive.getActualTCPPose())
        target[2] -= 0.02
        assert robot.moveL(target, 0.1, 0.5)
        wait_until(lambda: abs(receive.getActualTCPPose()[2] - target[2]) < 1e-9)
        robot.disconnect()
        receive.disconnect()


def test_the_upper_registers_and_no_external_sensor() -> None:
    with Process() as process:
        control = rtde_control.RTDEControlInterface
        flags = (
            control.FLAG_UPLOAD_SCRIPT | control.FLAG_UPPER_RANGE_REGISTERS | control.FLAG_NO_EXT_FT
        )
        robot = control(process.host, 500.0, flags)
        assert robot.moveJ(OTHER, 1.0, 2.0)
        assert robot.getTCPOffset() == [0.0] * 6
        robot.disconnect()
