"""The register protocol, programs, and what ur_rtde writes into them, in simulated time."""

import numpy as np
import pytest

from flangeye_emulators.controllers.poses import pose_matrix, pose_vector
from flangeye_emulators.controllers.ur.controller import Runtime
from flangeye_emulators.controllers.ur.script import (
    ScriptSource,
    injected_path,
    register_offset,
    take_program,
)
from flangeye_emulators.controllers.ur.server import CustomProgram, run_program
from tests.emulators.controllers.desk import HOME, Desk, away

CONTROL_SCRIPT = """\
def rtde_control():
    global reg_offset_int = # int register offset
{offset}
    def exec_move_path():
        textmsg("exec_move_path")
        # inject move path
{path}
    end
    textmsg("a line that only looks like movel(p[0,0,0,0,0,0],a=1,v=1,r=0)")
end
"""
PATH = """\
\tsignal_async_progress(0)
\tmovel(p[-0.4,-0.2,0.4,2.2,2.2,0],a=1.2,v=0.25,r=0.02)
\tsignal_async_progress(1)
\tmovej([0,-1.5,1.5,-1.5,-1.5,1e-05],a=1.4,v=1.05,r=0)
"""


def test_programs_are_cut_out_of_a_stream_that_comes_in_pieces() -> None:
    text = CONTROL_SCRIPT.format(offset=0, path=PATH) + "def second():\n\tsync()\nend\n"
    found, buffer = [], ""
    for i in range(0, len(text), 37):
        source, buffer = take_program(buffer + text[i : i + 37])
        while source is not None:
            found.append(source)
            source, buffer = take_program(buffer)
    assert [source.name for source in found] == ["rtde_control", "second"]
    assert found[0].text == CONTROL_SCRIPT.format(offset=0, path=PATH)[:-1]
    assert found[1].text == "def second():\n\tsync()\nend"


def test_moves_and_offset_are_read_from_the_control_script() -> None:
    script = CONTROL_SCRIPT.format(offset=24, path=PATH)
    assert register_offset(script) == 24
    first, second = injected_path(script)
    assert (first.kind, first.is_pose, first.blend) == ("movel", True, 0.02)
    assert (second.kind, second.is_pose) == ("movej", False)
    assert (second.acceleration, second.speed) == (1.4, 1.05)
    assert second.target == pytest.approx([0, -1.5, 1.5, -1.5, -1.5, 1e-5])
    assert injected_path(CONTROL_SCRIPT.format(offset=0, path="")) == []
    assert register_offset("def rtde_control():\nend") == 0


def test_a_command_is_done_until_it_is_cleared(desk: Desk) -> None:
    desk.write(29, [0, 0, 0.1, 0, 0, 0])
    desk.run(1)
    assert desk.answer() == 2
    desk.run(5)
    assert desk.answer() == 2
    assert desk.log().count("command 29") == 1
    desk.write(0)
    desk.run(1)
    assert desk.answer() == 1


def test_a_client_may_use_the_upper_registers() -> None:
    desk = Desk(offset=24)
    assert desk.order(40)
    assert desk.order(3, [*(away(desk.pose(), 0.01, 0, 0, 0, 0, 0)), 0.1, 1.0])
    assert desk.box.registers.output_int[0] == 0


def test_the_stop_command_ends_the_script(desk: Desk) -> None:
    desk.write(255)
    desk.run(2)
    assert desk.box.runtime is Runtime.STOPPED
    assert desk.log()[-1] == "program stopped: the program ended"


def test_an_unknown_command_is_done_and_noted(desk: Desk) -> None:
    assert desk.order(99)
    assert desk.log()[-1] == "command 99 is not simulated"


def test_the_answers_to_questions(desk: Desk) -> None:
    tool = [0.0, 0.01, 0.12, 0.0, 0.3, 0.0]
    flange = desk.pose()
    assert desk.order(29, tool)
    tip = pose_vector(pose_matrix(flange) @ pose_matrix(tool))
    assert desk.pose() == pytest.approx(tip, abs=1e-12)
    assert desk.order(40)
    assert desk.given() == pytest.approx(tool)
    assert desk.order(43)
    assert desk.given() == pytest.approx(tip)
    assert desk.order(44, [*HOME, 0, 0, 0, 0, 0, 0])
    assert np.allclose(pose_matrix(desk.given()), pose_matrix(flange))
    assert desk.order(46, desk.pose())
    assert desk.given() == pytest.approx(HOME, abs=1e-8)
    assert desk.order(39, [0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0])
    assert desk.given() == pytest.approx([0, 1, 1, 0, 0, 0])
    assert desk.order(47)
    assert desk.given_integer() == 1
    desk.stream(58)
    assert np.allclose(pose_matrix(desk.given()), pose_matrix(flange))
    desk.stream(26)
    assert desk.given(1)[0] == 0.002
    desk.stream(27, integers=[3])
    assert np.array_equal(desk.given(), HOME)


def test_what_can_be_reached_and_what_cannot(desk: Desk) -> None:
    far = [2.0, 0, 0, 0, 0, 0]
    for code, target, yes in (
        (60, desk.pose(), 1),
        (60, far, 0),
        (36, desk.pose(), 1),
        (36, far, 0),
    ):
        assert desk.order(code, target)
        assert desk.given_integer() == yes
    assert desk.order(61, [*desk.pose(), *HOME])
    assert desk.given_integer() == 1
    for joints, yes in ((HOME, 1), (away(HOME, 7, 0, 0, 0, 0, 0), 0)):
        assert desk.order(37, joints)
        assert desk.given_integer() == yes


def test_payload_keeps_its_centre_when_none_is_given(desk: Desk) -> None:
    assert desk.order(17, [1.5, 0.0, 0.0, 0.05])
    assert desk.order(17, [2.0, 0.0, 0.0, 0.0])
    mass, centre = desk.box.payload
    assert mass == 2.0
    assert centre == pytest.approx([0, 0, 0.05])


def test_a_move_in_the_background_shows_its_progress_and_can_be_stopped(desk: Desk) -> None:
    target = away(desk.pose(), 0.1, 0, 0, 0, 0, 0)
    assert desk.order(3, [*target, 0.1, 1.0], [1])
    assert desk.progress() == 0
    desk.seconds(0.3)
    assert not desk.arm.standing
    assert desk.order(33, [2.0], [0])
    assert desk.progress() is None
    assert desk.arm.standing
    assert desk.order(3, [*target, 0.1, 1.0])
    assert desk.misses(target) < 1e-9


def test_a_new_move_takes_the_place_of_one_in_the_background(desk: Desk) -> None:
    home = desk.pose()
    assert desk.order(3, [*(away(home, 0.1, 0, 0, 0, 0, 0)), 0.2, 1.0], [1])
    desk.seconds(0.3)
    assert desk.order(3, [*home, 0.2, 1.0])
    assert desk.misses(home) < 1e-9


def square(pose, blend):
    corners = ((0.05, 0.0), (0.05, 0.05), (0.0, 0.05), (0.0, 0.0))
    lines = []
    for i, (dx, dy) in enumerate(corners):
        target = ",".join(f"{v:.9f}" for v in away(pose, dx, dy, 0, 0, 0, 0))
        lines.append(f"\tsignal_async_progress({i})\n\tmovel(p[{target}],a=1.2,v=0.1,r={blend})\n")
    return injected_path(CONTROL_SCRIPT.format(offset=0, path="".join(lines)))


@pytest.mark.parametrize("blend", [0, 0.01])
def test_a_path_passes_its_waypoints(blend: float) -> None:
    home = Desk().pose()
    desk = Desk(path=square(home, blend))
    shown = []
    desk.write(45, integers=[0])
    while desk.answer() != 2:
        desk.run(1)
        shown.append(desk.progress())
    assert sorted(set(shown) - {None}) == [0, 1, 2, 3]
    assert desk.misses(home) < 1e-8
    corner = np.linalg.norm(desk.positions()[:, :2] - (away(home[:2], 0.05, 0.05)), axis=1).min()
    assert (corner < 1e-6) if blend == 0 else (1e-3 < corner < 0.01)
    stops = sum(
        not before.any() and after.any()
        for (_, before, *_), (_, after, *_) in zip(desk.trace, desk.trace[1:], strict=False)
    )
    assert stops == (4 if blend == 0 else 1)


def test_a_path_in_joints_keeps_every_joints_limit() -> None:
    line = "\tmovej([{}],a=20,v=3.1,r={})\n"
    stops = ["1.5,-1.0,1.2,-1.5,-1.5,0", "-0.5,-1.5,1.5,-1.0,-1.5,1"]
    text = line.format(stops[0], 0.05) + line.format(stops[1], 0)
    desk = Desk("ur10e", path=injected_path(CONTROL_SCRIPT.format(offset=0, path=text)))
    assert desk.order(45)
    turned = np.abs(np.diff(desk.joints(), axis=0)) / 0.002
    assert (turned <= desk.arm.speed_limits * 1.01).all()
    assert turned.max() > 2.0


def test_jogging_goes_along_the_tools_axes(desk: Desk) -> None:
    axis = desk.arm.stance.base_T_tcp[:3, 2]
    assert desk.order(41, [0, 0, 0.05, 0, 0, 0, 1, 0.5])
    desk.seconds(0.5)
    assert desk.arm.twist[:3] == pytest.approx(0.05 * axis, abs=1e-4)
    assert desk.order(42)
    assert desk.arm.standing


def test_a_custom_program_runs_line_by_line(desk: Desk) -> None:
    lines = [
        "write_output_integer_register(0 +0, 1)",
        "movej([0,-1.5,1.5,-1.5,-1.5,0], a=2, v=1)  # a comment",
        "sleep(0.1)",
        "set_tcp(p[0, 0, 0.05, 0, 0, 0])",
        "write_output_float_register(13, 0.25)",
        "write_output_integer_register(0 +0, 2)",
    ]
    source = "def job():\n" + "".join(f"\t{line}\n" for line in lines) + "end"
    run_program(desk.box, ScriptSource("job", source))
    desk.seconds(1.0)
    assert desk.box.runtime is Runtime.STOPPED
    assert desk.arm.stance.joints == pytest.approx([0, -1.5, 1.5, -1.5, -1.5, 0])
    assert desk.answer() == 2
    assert desk.box.registers.output_double[13] == 0.25
    assert desk.arm.chain.flange_T_tcp[2, 3] == 0.05


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("open_gripper()", "'open_gripper()' is not simulated"),
        ("write_output_integer_register(99, 1)", "there is no register 99"),
        ("set_tcp(p[0, 0])", "set_tcp takes a pose of six numbers"),
    ],
)
def test_a_custom_program_that_cannot_run_stops(desk: Desk, line: str, why: str) -> None:
    desk.box.load(CustomProgram(desk.box, f"def job():\n\t{line}\nend"), "job")
    desk.run(2)
    assert desk.log()[-1] == f"program stopped: runtime error: {why}"
