"""What stays unknown of a graph of frames, and what would tell it, in words."""

import numpy as np
import pytest

from flangeye.handeye.missing import Loops, Move
from flangeye.handeye.observability import WeakMoves
from flangeye.maths.frame_graph import Frame
from flangeye.types import Floats

MOVES = np.tile(np.eye(4), (5, 1, 1))
FRAMES = {
    "flange": Frame("base", MOVES), "left": Frame("base"), "right": Frame("base"),
    "marker": Frame("flange"), "plate": Frame("base"),
}  # fmt: skip
SCALE = np.tile(np.repeat([0.02, 0.01], 3), 2)


def loops(unknown: list[str], *pairs: tuple[str, str]) -> Loops:
    return Loops(FRAMES, pairs, unknown, SCALE)


def test_a_frame_is_unknown_that_has_a_tenth_of_a_weak_move_of_its_limits() -> None:
    moves = np.zeros((12, 2))
    moves[1, 0], moves[10, 0], moves[4, 1] = 0.02, 0.101 * 0.01, 0.01
    two = loops(["left", "marker"], ("left", "marker"))
    assert two._named(WeakMoves(moves, np.ones(2))) == ["left", "marker"]
    moves[10, 0] = 0.099 * 0.01
    assert two._named(WeakMoves(moves, np.ones(2))) == ["left"]
    moves[7, 0] = -0.101 * 0.02
    assert two._named(WeakMoves(moves, np.ones(2))) == ["left", "marker"]


def told(weak: Floats) -> str:
    """Return what is said where a direction of two frames is not told."""
    axis = weak / np.linalg.norm(weak)
    information = 1e8 * (np.eye(12) - np.outer(axis, axis))
    turn: Move = ("flange", (0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    useless: Move = ("flange", (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    again = {turn: 0.5 * 1e8 * np.outer(axis, axis), useless: 0 * information}
    return loops(["left", "marker"], ("left", "marker")).told_unknown(information, again)


@pytest.mark.parametrize(
    ("turns", "shifts", "said"), [(0.02, 0.009, "turn"), (0.018, 0.01, "shift")]
)
def test_a_weak_move_is_said_with_its_frames_what_it_is_and_what_shows_it(
    turns: float, shifts: float, said: str
) -> None:
    """A turn or a shift, by which is larger beside its limit."""
    weak = np.zeros(12)
    weak[[2, 10]] = turns, shifts
    assert told(weak) == (
        f"the sightings do not tell where left and marker are: a common {said} hardly changes "
        "them; turn flange about (0.00, 0.00, 1.00) of base by 20 deg or more, and see it again"
    )


def test_motions_are_asked_for_by_what_turns_and_what_moves() -> None:
    rail = Loops({**FRAMES, "rail": Frame("floor", MOVES)}, [], ["left"], SCALE)
    asked = rail._asked([
        ("flange", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
        ("rail", (0.0, 0.0, 0.0, 0.6, 0.8, 0.0)),
        ("flange", (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
    ])  # fmt: skip
    assert asked == [
        "turn flange about (1.00, 0.00, 0.00) and (0.00, 0.00, 1.00) of base by 20 deg or more, and "
        "see it again",
        "move rail along (0.60, 0.80, 0.00) of floor by 0.1 m or more, and see it again",
    ]


@pytest.mark.parametrize(
    ("named", "pairs", "said"),
    [
        (["plate"], [("left", "marker")], "no sighting that agrees with others has plate in it: let"),
        (["left", "plate"], [("right", "marker")], "no sighting that agrees with others has left or plate"),
        (["left"], [("left", "marker")], "no motion shows where left stands: say it of left (place:"),
        (["left", "marker"], [("left", "marker")], "no motion shows where left and marker stand: say"),
        (["left", "marker"], [("left", "marker"), ("right", "plate")],
         "no sighting ties left and marker to right and plate: let a camera of the one see a target"),
    ],
)  # fmt: skip
def test_what_no_motion_tells_is_told_by_a_sighting_or_has_to_be_said(
    named: list[str], pairs: list[tuple[str, str]], said: str
) -> None:
    assert loops(["left", "marker"], *pairs)._tie(named).startswith(said)
