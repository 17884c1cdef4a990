"""A camera on a link, and two arms: the same mistakes are named, or it is said why they cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.maths.pose_corrections import inverted, reread, scaled, shifted, without_tool
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.doctor.diagnosis import examine
from flangeye_plugins.check import CHECKS
from tests.crossing import crossed
from tests.workflow.doctor.sessions import clean

FURTHER = ("arm-1", "arm-2", "both")
EACH = [(carried,) for carried in FURTHER]
REPORTED = ("arm-1", "both")
"""Where the flanges' poses matter."""


def session_of(carried, kind="flange", seed=1, **changes):
    return clean(np.random.default_rng(seed), kind=kind, carried=carried, **changes)


def only(session):
    (finding,) = examine(session, CHECKS).findings
    return finding


def with_arms(session, change, arms="both"):
    """Return what a reader gives that makes the mistake with one arm's poses, or both."""
    poses = session.poses if arms == "second" else change(session.poses)
    seconds = session.seconds
    if seconds is not None and arms != "first":
        seconds = change(seconds)
    return replace(session, poses=poses, seconds=seconds)


@pytest.mark.parametrize("carried", FURTHER)
@pytest.mark.parametrize("kind", ["flange", "centres", "marker"])
def test_a_clean_session_gives_nothing(carried: str, kind: str) -> None:
    diagnosis = examine(session_of(carried, kind), CHECKS)
    assert diagnosis.findings == ()
    assert diagnosis.notes == ()


@pytest.mark.parametrize(("carried", "kind"), crossed(EACH, [("flange",), ("marker",)]))
def test_one_gross_outlier(carried: str, kind: str) -> None:
    session = session_of(carried, kind)
    centres = np.array(session.centres)
    centres[7] += [0.0, 0.02, 0.01]
    finding = only(replace(session, centres=centres))
    assert (finding.name, finding.samples) == ("outlier", ("007",))


@pytest.mark.parametrize("carried", FURTHER)
def test_a_target_that_moved_half_way(carried: str) -> None:
    session = session_of(carried, "marker")
    late = np.arange(20) >= 10
    moved = session.centres + np.where(late[:, None], [0.01, 0.0, 0.004], 0.0)
    finding = only(replace(session, centres=moved))
    assert (finding.name, finding.samples) == ("moved target", ("010",))


@pytest.mark.parametrize(("carried", "by"), crossed(EACH, [(1,), (-1,)]))
def test_poses_shifted_against_the_scans(carried: str, by: int) -> None:
    session = session_of(carried)
    _, known = shifted(session.poses, by)
    links = None if session.links is None else shifted(session.links, by)[0]
    late = replace(with_arms(session, lambda poses: shifted(poses, by)[0]), links=links)
    assert f"shift: {-by}" in only(late.where(known)).fix


@pytest.mark.parametrize("carried", REPORTED)
def test_the_base_in_the_flange(carried: str) -> None:
    finding = only(with_arms(session_of(carried), inverted))
    assert "corrected: {reader: auto, robot: {inverted: true}}" in finding.fix


@pytest.mark.parametrize("carried", REPORTED)
@pytest.mark.parametrize("factor", [1e3, pytest.param(1 / 25.4e-3, marks=pytest.mark.slow)])
def test_positions_in_another_unit(carried: str, factor: float) -> None:
    session = with_arms(session_of(carried, "marker"), lambda poses: scaled(poses, factor))
    finding = only(session)
    assert finding.name == "unit"
    assert f"scale: {float(f'{1 / factor:.10g}')}" in finding.fix


@pytest.mark.parametrize("carried", ["arm-1", "arm-2"])
def test_the_targets_unit_before_a_camera_on_a_link(carried: str) -> None:
    session = session_of(carried)
    finding = only(replace(session, centres=session.centres * 1e3))
    assert finding.what.startswith("the target's positions were read in m and are in mm")


@pytest.mark.parametrize("carried", REPORTED)
def test_rotations_read_in_another_convention(carried: str) -> None:
    session = session_of(carried, "marker", turn=0.4)
    finding = only(with_arms(session, lambda poses: reread(poses, "ZYX", "xyz")))
    assert finding.name == "pose convention"
    assert np.allclose(finding.corrected_session.poses, session.poses, atol=1e-6)


@pytest.mark.parametrize("arms", [pytest.param("first", marks=pytest.mark.slow), "second"])
def test_a_mistake_of_one_of_two_arms(arms: str) -> None:
    finding = only(with_arms(session_of("both", "marker"), inverted, arms))
    assert finding.what.startswith(f"the {arms} arm's poses are flange_T_base")
    assert f"{{reader: auto, arms: {arms}, robot: {{inverted: true}}}}" in finding.fix


def test_a_tool_on_the_second_arm() -> None:
    session = session_of("both")
    offset = np.array([0.0, 0.01, 0.05])
    wrong = with_arms(session, lambda poses: without_tool(poses, -offset), "second")
    finding = only(wrong)
    assert finding.name == "tool offset"
    assert "arms: second, offset: " in finding.fix
    assert np.allclose(finding.corrected_session.seconds, session.seconds, atol=5e-4)


@pytest.mark.parametrize("carried", REPORTED)
def test_identity_matrices(carried: str) -> None:
    session = session_of(carried)

    def change(poses):
        out = np.array(poses)
        out[[3, 8]] = np.eye(4)
        return out

    finding = examine(with_arms(session, change), CHECKS).findings[0]
    assert (finding.name, finding.samples) == ("identity matrices", ("003", "008"))


def test_an_arm_that_rests_while_the_other_moves_is_no_stale_pose() -> None:
    session = session_of("both", "marker", n=24)
    poses = np.array(session.poses)
    poses[12:] = poses[11]
    rng = np.random.default_rng(0)
    camera = rigid(rotation_exp(rng.normal(0, 0.5, 3)), np.array([0.05, -0.03, 0.1]))
    base = rigid(rotation_exp(np.array([0.0, 0.1, 2.0])), np.array([1.2, 0.3, 0.0]))
    seen = np.linalg.inv(poses @ camera) @ base @ session.seconds
    resting = replace(
        session,
        poses=poses,
        centres=seen[:, :3, 3] + rng.normal(0, 1e-4, (24, 3)),
        rotations=seen[:, :3, :3] @ rotation_exp(rng.normal(0, 1e-3, (24, 3))),
    )
    done: list[None] = []
    assert examine(resting, CHECKS, lambda: done.append(None)).findings == ()
    assert len(done) == len(CHECKS)  # what moves the bar on a terminal


def test_what_cannot_show_is_said_with_the_reason() -> None:
    idle = examine(session_of("arm-2"), CHECKS).idle
    assert idle == {
        "check.direction": "the camera's poses are computed from joint angles, so recorded flange poses are not used",
        "check.convention": "the camera's poses are computed from joint angles, so recorded flange poses are not used",
        "check.exchanged": "the camera's poses are computed from joint angles, so recorded flange poses are not used",
        "check.axes": "the markers were found in images or clouds, whose frame is known",
        "check.flips": "no marker's whole pose was measured",
        "check.scatter": "no marker's whole pose was measured",
        "check.tool": "a constant offset of the camera's carrier is absorbed by the estimated camera pose",
    }
