"""What a stored calibration expects of later sightings, by numbers."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import corners_of
from flangeye.models.loading import load_model
from flangeye.plugin.registry import load_registry
from flangeye.types import Floats
from flangeye.types.geometry import rotation_exp
from flangeye.workflow.doctor.monitor import from_archive, verdicts
from flangeye.workflow.doctor.monitor.drift import (
    CheckSightings,
    DriftTest,
    DriftVerdict,
    Information,
)
from flangeye.workflow.doctor.monitor.history import CheckFinding, History, MonitorCheck
from flangeye.workflow.doctor.monitor.stored import StoredCalibration, stored_calibration
from tests.workflow.doctor.monitor.cell import WORKSPACE, calibrate, check

ARM = Arm(load_model("robots", "ur5e"))
JOINTS = np.radians([10.0, -125.0, -105.0, -40.0, -90.0, 170.0])


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> StoredCalibration:
    recipe = "robot: {model: ur5e}"
    return stored_calibration(calibrate(tmp_path_factory.mktemp("stored") / "run", recipe))


def where_it_should_be(stored: StoredCalibration, count: int = 3) -> list[t.Observation]:
    """Return sightings of a flange exactly where the calibration and the arm have it."""
    seen = []
    for number in range(count):
        joints = JOINTS + 0.1 * number
        flange = t.Transform(t.BASE, t.FLANGE, ARM.flange(joints))
        found = stored.estimate.transform.inverse() @ flange
        circle = t.CircleFeature(
            found.translation, found.rotation[:, 2], {}, 1e-8 * np.eye(3), 1e-6 * np.eye(3), 1.0
        )
        seen.append(t.Observation(f"scan-{number}", circle, t.by_frame(flange), joints))
    return seen


def sightings(stored: StoredCalibration, seen: list[t.Observation]) -> CheckSightings:
    return stored.sightings(seen, np.zeros(len(seen), dtype=np.intp))


def changed(seen: t.Observation, **feature: Any) -> t.Observation:
    return replace(seen, feature=replace(seen.circle, **feature))


def test_what_is_where_it_should_be_has_no_residual(stored: StoredCalibration) -> None:
    told = sightings(stored, where_it_should_be(stored))
    np.testing.assert_allclose(told.residuals, 0.0, atol=1e-9)
    assert told.check.tolist() == [0, 0, 0]


def test_a_shift_shows_in_the_base_and_a_tilt_across_the_flange_s_axis(
    stored: StoredCalibration,
) -> None:
    first, second, third = where_it_should_be(stored)
    aside = changed(first, centre=first.circle.centre + [1e-3, 0.0, 0.0])
    assert second.circle.normal is not None
    axis = stored.estimate.transform.inverse().rotation @ second.base_T_flange.rotation[:, 0]
    tilted = changed(second, normal=rotation_exp(0.01 * axis) @ second.circle.normal)
    bare = changed(third, normal=None, normal_covariance=None)
    told = sightings(stored, [aside, tilted, bare])
    shift = stored.estimate.transform.rotation @ [1e-3, 0.0, 0.0]
    np.testing.assert_allclose(told.residuals[0], [*shift, 0.0, 0.0], atol=1e-9)
    # About its x the axis of a flange leans towards its -y
    np.testing.assert_allclose(told.residuals[1], [0.0, 0.0, 0.0, 0.0, -0.01], atol=1e-6)
    # Without a normal there is no tilt, and nothing is known of it
    np.testing.assert_allclose(told.residuals[2], 0.0, atol=1e-9)
    assert (np.diagonal(told.covariances[2])[3:] > 1e3 * np.diagonal(told.covariances[1])[3:]).all()


def test_a_sighting_has_the_noise_of_its_scan_and_of_the_arm(stored: StoredCalibration) -> None:
    (told,) = sightings(stored, where_it_should_be(stored, 1)).covariances
    # Alike in all directions, of a centre and across a normal
    own = np.diag([1e-8, 1e-8, 1e-8, 1e-6, 1e-6])
    np.testing.assert_allclose(told, own + stored.pose_error.beyond, atol=1e-12)


def compared(
    stored: StoredCalibration, monkeypatch: pytest.MonkeyPatch, since: int | None
) -> Callable[[int, int], tuple[Floats, Floats]]:
    """Return what the last of six checks is compared with, from which one on, by how many.

    Or, where something moved at a check, what those since are.
    """
    told: list[Information] = []
    every = [
        MonitorCheck(f"{k}", tuple(changed(o, centre=o.circle.centre + [1e-5 * (k + 1), 0, 0])
                                   for o in where_it_should_be(stored)))
        for k in range(6)
    ]  # fmt: skip

    def heard(before: Information, answer: Any) -> Any:
        told.append(before)
        return answer

    if since is None:
        fine = CheckFinding(0, "OK", 0.0, (0.0,) * 6, None, 0.5)
        monkeypatch.setattr(verdicts, "judge", lambda *_: fine)
        monkeypatch.setattr(verdicts, "misfits", lambda seen, before, _: heard(before, np.False_))
    parts = {"scanner": 1.0, "flange": 0.0, "arm": 0.0}
    monkeypatch.setattr(verdicts, "attribute_change", lambda before, *_: heard(before, parts))

    def before(first: int, reference: int) -> tuple[Floats, Floats]:
        test, found = DriftTest(reference=reference), History(Path("h"), "key", every[first:5])
        moved = DriftVerdict("MOVED", np.zeros(6), np.eye(6), 1e-3, (since or 0) - first, 2.0)
        monkeypatch.setattr(verdicts, "verdict", lambda *_: moved)
        verdicts.take(stored, found, every[5], test)
        return told[-1].matrix, told[-1].vector

    return before


@pytest.mark.parametrize("since", [None, 5])
def test_a_check_is_compared_with_so_many_checks_before_it_and_with_all_of_fewer(
    stored: StoredCalibration, monkeypatch: pytest.MonkeyPatch, since: int | None
) -> None:
    before = compared(stored, monkeypatch, since)

    def same(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> bool:
        return all(np.allclose(a, b, rtol=1e-9) for a, b in zip(one, other, strict=True))

    assert same(before(0, 2), before(3, 2)) and same(before(3, 2), before(3, 9))
    assert not same(before(0, 3), before(0, 2)) and not same(before(3, 9), before(4, 9))
    assert not same(before(4, 9), before(5, 9))  # that one is the first of all


def test_the_joints_move_the_circle_as_the_arm_does(stored: StoredCalibration) -> None:
    seen = where_it_should_be(stored)
    told = sightings(stored, seen)
    assert told.joints is not None
    at = ARM.flange(JOINTS)[:3, 3]
    for joint in range(6):
        by = ARM.flange(JOINTS + 1e-6 * np.eye(6)[joint])[:3, 3] - at
        # By its sign: the circle's residual is what is seen less what the arm says
        np.testing.assert_allclose(np.abs(told.joints[0][:3, joint]), np.abs(by) / 1e-6, atol=1e-5)


@pytest.mark.parametrize("lost", ["joints", "arm"])
def test_where_arm_or_angles_are_not_known_the_joints_tell_nothing(
    stored: StoredCalibration, lost: str
) -> None:
    seen = where_it_should_be(stored)
    if lost == "joints":
        seen[1] = replace(seen[1], joints=None)
        assert sightings(stored, seen).joints is None
    else:
        unknown = replace(stored, log=replace(stored.log, attachments={}))
        assert unknown.arm is None and sightings(unknown, seen).joints is None


def test_the_work_is_watched_at_its_corners(stored: StoredCalibration) -> None:
    about = stored.estimate.about
    corners = corners_of(WORKSPACE.centre, WORKSPACE.size)
    np.testing.assert_allclose(stored.corners + about, corners, atol=1e-12)
    # Where no work is known, all that the calibration saw is; and where that is nothing, a point
    unknown = replace(stored, log=replace(stored.log, source=None))
    places = np.array([pair.observation.tcp_in_base for pair in stored.calibration.pairs])
    around = unknown.corners + about
    np.testing.assert_allclose(around.min(axis=0), places.min(axis=0), atol=1e-12)
    np.testing.assert_allclose(around.max(axis=0), places.max(axis=0), atol=1e-12)
    nothing = replace(unknown, calibration=replace(stored.calibration, pairs=()))
    assert nothing.corners.tolist() == [[0.0, 0.0, 0.0]]


def test_the_key_tells_calibrations_apart_by_a_nanometre(stored: StoredCalibration) -> None:
    def moved(by: float) -> str:
        camera = stored.calibration.camera
        pose = camera.transform.matrix.copy()
        pose[0, 3] += by
        there = replace(camera, transform=t.Transform(t.BASE, t.CAMERA, pose))
        return replace(stored, calibration=replace(stored.calibration, camera=there)).key

    assert moved(0.0) == stored.key != moved(2e-9)
    assert moved(1e-11) == stored.key and "\n" not in stored.key


def test_recordings_in_a_file_are_no_log_and_a_log_that_is_not_there_is_said(
    stored: StoredCalibration, tmp_path: Path
) -> None:
    recipe = b"title: T\nrobot: ur5e\nsteps: [acquire.archive, segment.flange, fit.rim, solve.svd]"
    log = replace(stored.log, attachments={"recipe.resolved.yaml": recipe})
    (tmp_path / "poses.csv").write_text("1, 2, 3")
    for name, told in (("none.mcap", "none.mcap: does not exist"), ("poses.csv", r"poses.csv:1: ")):
        with pytest.raises(StageError, match=told) as error:
            from_archive(tmp_path / name, replace(stored, log=log), load_registry())
        assert "MCAP" not in str(error.value)


@pytest.mark.parametrize("began_ns", [10**18, 0])
def test_a_check_is_of_the_time_of_its_last_scan_or_else_of_its_log(
    stored: StoredCalibration, began_ns: int, tmp_path: Path
) -> None:
    run = check(tmp_path / "later", 1, began_ns=began_ns)
    os.utime(run / "run.mcap", ns=(5, 7))
    last = began_ns + 8 * 3600 * 10**9 + 2 if began_ns else 7
    assert from_archive(run, stored, load_registry()).time_ns == last


@pytest.mark.parametrize(
    "first", ["acquire.archive", "acquire.live", "acquire.live: {poses: 20}", "acquire.archive: {}"]
)
def test_later_recordings_are_read_from_an_archive_whatever_the_calibration_took(
    stored: StoredCalibration, first: str, tmp_path: Path
) -> None:
    recipe = f"title: T\nrobot: ur5e\nsteps: [{{{first}}}, segment.flange, fit.rim, solve.svd]"
    if ":" not in first:
        recipe = recipe.replace(f"{{{first}}}", first)
    log = replace(stored.log, attachments={"recipe.resolved.yaml": recipe.encode()})
    with pytest.raises(StageError, match="no reader knows this layout"):
        from_archive(tmp_path, replace(stored, log=log), load_registry())


@pytest.mark.parametrize("recipe", ["", "title: T", "robot: ur5e\nsteps: []", "only a text"])
def test_a_calibration_whose_recipe_has_no_steps_says_that_nothing_reads_scans(
    stored: StoredCalibration, recipe: str, tmp_path: Path
) -> None:
    log = replace(stored.log, attachments={"recipe.resolved.yaml": recipe.encode()})
    with pytest.raises(StageError):
        from_archive(tmp_path, replace(stored, log=log), load_registry())
