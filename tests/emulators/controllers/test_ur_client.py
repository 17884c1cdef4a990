"""The unmodified ur_rtde client against a controller in a process of its own."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_emulators.controllers.poses import pose_matrix, twist_between
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
    assert cell.robot.moveJ_IK(target.tolist(), 1.05, 1.4)
    cell.reaches(target, 1e-9)
    assert cell.robot.moveL_FK(OTHER, 0.25, 1.2)
    cell.turns_to(OTHER, 1e-9)
    assert cell.robot.isSteady()


def test_a_move_in_the_background_and_its_stop(cell: Any) -> None:
    start = cell.pose()
    target = away(start, 0.1, 0, 0, 0, 0, 0)
    assert cell.robot.moveL(target.tolist(), 0.1, 1.0, True)
    assert cell.robot.getAsyncOperationProgress() >= 0
    cell.until(lambda: cell.receive.getActualTCPSpeed()[0] > 0.09)
    cell.robot.stopL(2.0)
    assert cell.robot.getAsyncOperationProgress() < 0
    assert 0.005 < cell.pose()[0] - start[0] < 0.09
    assert cell.robot.isSteady()
    assert cell.robot.moveL(target.tolist(), 0.2, 1.0, True)
    cell.until(lambda: cell.robot.getAsyncOperationProgress() < 0)
    cell.reaches(target, 1e-9)


def test_paths(cell: Any) -> None:
    start = cell.pose()
    corners = [
        away(start, dx, dy, 0, 0, 0, 0) for dx, dy in ((0.05, 0), (0.05, 0.05), (0, 0.05), (0, 0))
    ]
    assert cell.robot.moveL([[*corner, 0.2, 1.2, 0.01] for corner in corners])
    cell.reaches(start, 1e-5)  # the client writes six digits
    assert cell.robot.moveJ([[*OTHER, 1.0, 2.0, 0.02], [*HOME, 1.0, 2.0, 0.0]])
    cell.reaches(start, 1e-5)
    path = rtde_control.Path()
    entry = rtde_control.PathEntry
    path.addEntry(entry(entry.MoveJ, entry.PositionJoints, [*OTHER, 1.0, 2.0, 0.0]))
    path.addEntry(entry(entry.MoveL, entry.PositionTcpPose, [*start, 0.2, 1.2, 0.0]))
    assert cell.robot.movePath(path, True)
    seen = set()
    while (progress := cell.robot.getAsyncOperationProgress()) >= 0:
        seen.add(progress)
        time.sleep(0.005)
    assert seen == {0, 1}
    cell.reaches(start, 1e-5)


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
    cell.robot.speedJ([0.3, 0, 0, 0, 0, 0], 2.0)
    cell.until(lambda: abs(cell.receive.getActualQd()[0] - 0.3) < 1e-6)
    assert cell.robot.speedStop(2.0)
    assert cell.robot.isSteady()


@pytest.mark.parametrize("how", ["servoJ", "servoL"])
def test_a_servo_follows(cell: Any, how: str) -> None:
    start = cell.pose()
    for cycle in range(300):
        began = cell.robot.initPeriod()
        if how == "servoL":
            target = away(start, 0.02 * np.sin(cycle / 60), 0, 0, 0, 0, 0)
            cell.robot.servoL(target.tolist(), 0.5, 0.5, 0.002, 0.03, 2000)
        else:
            target = away(HOME, 0.1 * np.sin(cycle / 60), 0, 0, 0, 0, 0)
            cell.robot.servoJ(target.tolist(), 0.5, 0.5, 0.002, 0.03, 2000)
        cell.robot.waitPeriod(began)
    if how == "servoL":
        cell.reaches(target, 1e-4)
    else:
        cell.turns_to(target, 1e-4)
    assert cell.robot.servoStop()


def test_touch(cell: Any) -> None:
    floor = cell.pose()[2] - 0.02
    cell.control.set_surfaces(SpringSurface(np.array([0, 0, floor]), np.array([0, 0, 1])))
    assert cell.robot.zeroFtSensor()
    assert cell.robot.moveUntilContact([0, 0, -0.04, 0, 0, 0])
    assert cell.pose()[2] == pytest.approx(floor, abs=3e-4)
    wrench, limits = [0, 0, -15.0, 0, 0, 0], [0.1, 0.1, 0.05, 1, 1, 1]
    for _ in range(500):
        began = cell.robot.initPeriod()
        assert cell.robot.forceMode([0] * 6, [0, 0, 1, 0, 0, 0], wrench, 2, limits)
        cell.robot.waitPeriod(began)
    assert cell.receive.getActualTCPForce()[2] == pytest.approx(15.0, abs=0.3)
    raw = cell.receive.getFtRawWrench()
    assert raw[2] == pytest.approx(-15.0, abs=0.3)  # the flange looks down
    assert cell.robot.toolContact([0, 0, -1, 0, 0, 0]) >= 0
    assert cell.robot.forceModeStop()
    up = away(cell.pose(), 0, 0, 0.02, 0, 0, 0)
    assert cell.robot.moveL(up.tolist(), 0.1, 1.0)
    assert cell.robot.startContactDetection([0, 0, -1, 0, 0, 0])
    down = up - [0, 0, 0.06, 0, 0, 0]
    assert cell.robot.moveL(down.tolist(), 0.04, 0.5, True)
    # Not asked in between: a contact that comes while the script takes a command is lost.
    cell.until(lambda: cell.robot.getAsyncOperationProgress() < 0)
    cell.until(lambda: not np.any(cell.receive.getActualQd()))
    time.sleep(0.5)
    assert cell.robot.readContactDetection()
    assert cell.robot.stopContactDetection()
    assert cell.pose()[2] == pytest.approx(floor, abs=3e-4)


def test_questions(cell: Any) -> None:
    tool = [0.0, 0.0, 0.12, 0.0, 0.0, 0.0]
    flange = cell.pose()
    assert cell.robot.setTcp(tool)
    assert cell.robot.getTCPOffset() == pytest.approx(tool)
    tip = pose_matrix(flange) @ pose_matrix(tool)
    assert np.allclose(pose_matrix(cell.pose()), tip)
    assert np.allclose(pose_matrix(cell.robot.getForwardKinematics()), tip)
    there = pose_matrix(cell.robot.getForwardKinematics(list(HOME), tool))
    assert np.allclose(there, tip)
    assert cell.robot.getInverseKinematics(cell.pose().tolist()) == pytest.approx(HOME, abs=1e-8)
    near = (away(HOME, 2 * np.pi, 0, 0, 0, 0, 0)).tolist()
    far_turn = cell.robot.getInverseKinematics(cell.pose().tolist(), near)
    assert far_turn == pytest.approx(near, abs=1e-8)
    assert cell.robot.getInverseKinematicsHasSolution(cell.pose().tolist())
    assert not cell.robot.getInverseKinematicsHasSolution([2.0, 0, 0, 0, 0, 0])
    assert cell.robot.isPoseWithinSafetyLimits(cell.pose().tolist())
    assert cell.robot.isJointsWithinSafetyLimits(list(HOME))
    assert not cell.robot.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])
    moved = cell.robot.poseTrans([0, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 0])
    assert moved == pytest.approx([0, 1, 1, 0, 0, 0])
    assert cell.robot.setPayload(1.5, [0, 0, 0.05])
    cell.until(lambda: cell.receive.getPayload() == 1.5)
    assert cell.receive.getPayloadCog() == pytest.approx([0, 0, 0.05])


def test_questions_in_the_stream_answer_late(cell: Any) -> None:
    """The client does not wait for these answers, so the first one may be an older number."""
    for ask, answer in (
        (cell.robot.getStepTime, pytest.approx(0.002)),
        (lambda: cell.robot.getActualJointPositionsHistory(2), pytest.approx(HOME)),
        (cell.robot.getJointTorques, pytest.approx([0] * 6)),
    ):
        cell.until(lambda ask=ask, answer=answer: ask() == answer)
    flange = cell.control.truth().base_T_flange
    cell.until(lambda: np.allclose(pose_matrix(cell.robot.getActualToolFlangePose()), flange))


def test_outputs_and_the_slider(cell: Any) -> None:
    assert cell.io.setStandardDigitalOut(3, True)
    assert cell.io.setToolDigitalOut(1, True)
    assert cell.io.setConfigurableDigitalOut(2, True)
    cell.until(lambda: cell.receive.getActualDigitalOutputBits() == 1 << 3 | 1 << 17 | 1 << 10)
    assert cell.receive.getDigitalOutState(3)
    for level in (cell.io.setStandardDigitalOut(3, False), cell.io.setToolDigitalOut(1, False)):
        assert level
    assert cell.io.setConfigurableDigitalOut(2, False)
    cell.until(lambda: cell.receive.getActualDigitalOutputBits() == 0)
    assert cell.io.setAnalogOutputVoltage(1, 0.25)
    cell.until(lambda: cell.receive.getStandardAnalogOutput1() == 0.25)
    assert cell.io.setSpeedSlider(0.25)
    cell.until(lambda: abs(cell.receive.getSpeedScaling() - 0.25) < 1e-9)
    assert cell.receive.getTargetSpeedFraction() == 0.25
    target = away(cell.pose(), 0.05, 0, 0, 0, 0, 0)
    began = time.monotonic()
    assert cell.robot.moveL(target.tolist(), 0.25, 2.0)
    assert time.monotonic() - began > 4 * 0.05 / 0.25
    assert cell.io.setSpeedSlider(1.0)


def test_the_dashboard(cell: Any) -> None:
    board = cell.dashboard
    assert board.isConnected()
    assert board.polyscopeVersion() == "5.21.3.1"
    assert board.getSerialNumber() == "20245500001"
    assert board.getRobotModel() == "UR5"
    assert board.isInRemoteControl()
    assert board.running()
    assert board.robotmode() == "Robotmode: RUNNING"
    assert board.safetystatus() == "Safetystatus: NORMAL"
    assert board.programState().startswith("PLAYING")
    board.pause()
    assert board.programState().startswith("PAUSED")
    board.play()
    assert board.running()
    board.popup("hello")
    board.closePopup()
    board.addToLog("hello")
    board.loadURP("seam.urp")


def test_custom_functions(cell: Any) -> None:
    lines = "movej([0.1,-1.5,1.5,-1.5,-1.5,0],a=2,v=1)\nsleep(0.05)\ntextmsg(1)"
    assert cell.robot.sendCustomScriptFunction("there", lines)
    cell.until(lambda: abs(cell.receive.getActualQ()[0] - 0.1) < 1e-9)
    assert cell.robot.isProgramRunning()


def test_jogging_and_accepted_settings(cell: Any) -> None:
    start = cell.pose()
    assert cell.robot.jogStart([0.05, 0, 0, 0, 0, 0], 0, 0.5)
    cell.until(lambda: cell.receive.getActualTCPSpeed()[0] > 0.049)
    assert cell.robot.jogStop()
    assert cell.pose()[0] > start[0]
    assert cell.robot.setGravity([0, 0, 9.82])
    assert cell.robot.forceModeSetDamping(0.1)
    assert cell.robot.forceModeSetGainScaling(0.5)


def test_a_protective_stop_and_the_way_back(cell: Any) -> None:
    assert cell.robot.triggerProtectiveStop()
    cell.until(cell.receive.isProtectiveStopped)
    target = (away(cell.pose(), 0.05, 0, 0, 0, 0, 0)).tolist()
    assert not cell.robot.moveL(target)
    cell.dashboard.unlockProtectiveStop()
    cell.until(lambda: not cell.receive.isProtectiveStopped())
    assert not cell.robot.moveL(target)
    assert cell.robot.reuploadScript()
    cell.until(cell.robot.isProgramRunning)
    assert cell.robot.moveL(target)


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
