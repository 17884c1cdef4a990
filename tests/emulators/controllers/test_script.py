"""The register protocol, programs, and what ur_rtde writes into them, in simulated time."""

import pytest

from flangeye_emulators.controllers.poses import pose_matrix, pose_vector
from flangeye_emulators.controllers.ur.controller import Runtime
from flangeye_emulators.controllers.ur.script import ScriptSource, run_program, take_program
from tests.emulators.controllers.desk import Desk, away

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


def test_programs_are_cut_out_of_a_stream_that_comes_in_pieces() -> None:
    text = (
        CONTROL_SCRIPT.format(offset=0, path="\tmovej([0,0,0,0,0,0])\n")
        + "def second():\n\tsync()\nend\n"
    )
    found, buffer = [], ""
    for i in range(0, len(text), 37):
        source, buffer = take_program(buffer + text[i : i + 37])
        while source is not None:
            found.append(source)
            source, buffer = take_program(buffer)
    assert [source.name for source in found] == ["rtde_control", "second"]
    assert found[0].text == CONTROL_SCRIPT.format(offset=0, path="\tmovej([0,0,0,0,0,0])\n")[:-1]
    assert found[1].text == "def second():\n\tsync()\nend"


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


def test_a_tool_is_set_and_told(desk: Desk) -> None:
    tool = [0.0, 0.01, 0.12, 0.0, 0.3, 0.0]
    flange = desk.pose()
    assert desk.order(29, tool)
    tip = pose_vector(pose_matrix(flange) @ pose_matrix(tool))
    assert desk.pose() == pytest.approx(tip, abs=1e-12)
    assert desk.order(40)
    assert desk.given() == pytest.approx(tool)


def test_a_program_that_is_not_the_control_script_is_noted(desk: Desk) -> None:
    run_program(desk.box, ScriptSource("mine", "def mine():\nend"))
    assert desk.log()[-1] == "program mine is not simulated"
    assert desk.box.runtime is Runtime.PLAYING


def test_the_control_script_says_which_registers_it_uses(desk: Desk) -> None:
    run_program(desk.box, ScriptSource("rtde_control", CONTROL_SCRIPT.format(offset=24, path="")))
    desk.run(1)
    assert desk.box.registers.output_int[24] == 1


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
