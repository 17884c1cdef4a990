"""The lazy run, and the log as an archive."""

import gc
import json
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.errors import CalibrationRefused, NothingSeen, StageError
from flangeye.plugin.registry import Registry
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.restart import restart_hint
from flangeye.workflow.run.runner import Runner
from tests import toy
from tests.conftest import TOY_RECIPE, replaced


def without_timing(result):
    return {k: v for k, v in result.model_dump(mode="json").items() if k != "timing"}


def test_the_same_recipe_gives_the_same_result_bit_for_bit(execute: Callable[..., Any]) -> None:
    first, second = execute(TOY_RECIPE)[0], execute(TOY_RECIPE)[0]
    assert json.dumps(without_timing(first)) == json.dumps(without_timing(second))
    assert first.status == "verified"
    assert first.truth.rms_over_workspace < 1e-3


def test_a_solver_that_stops_pulling_stops_the_acquisition(execute: Callable[..., Any]) -> None:
    execute(TOY_RECIPE.replace("- solve.toy", "- solve.toy: {at_most: 4}"))
    assert toy.acquired == ["000", "001", "002", "003"]


def test_devices_are_closed_also_if_no_capture_is_asked_for(toy_registry: Registry) -> None:
    # As by a solver that has enough from the earlier run's captures: an arm left open would be
    # guarded until the program's end, whose last heartbeat kills it
    plain, closed = toy.acquire.function, list[str]()

    class Opened(t.Captures):
        def close(self) -> None:
            super().close()
            closed.append("arm")

    def opened(seed, params):
        made = plain(seed, params)
        return Opened(iter(made), made.source, made.total)

    recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
    with replaced(toy.acquire, opened):
        assert Runner(recipe, toy_registry, t.ArchivePath()).take(0) == []
    assert closed == ["arm"]


def test_a_capture_without_joint_angles_is_set_aside_with_the_reason(
    execute: Callable[..., Any],
) -> None:
    plain = toy.acquire.function

    def unread(seed, params):
        made = plain(seed, params)
        angles = (np.array([0.1, np.nan if i == 2 else 0.2]) for i in range(params.count))
        captures = (replace(c, joints=q) for c, q in zip(made, angles, strict=True))
        return t.Captures(captures, made.source, params.count)

    with replaced(toy.acquire, unread):
        result, log = execute(TOY_RECIPE)
    reason = "joint 2 is nan: the arm's driver had no angle to give"
    assert [(r.id, r.stage, r.reason) for r in log.rejections] == [("002", "acquire.toy", reason)]
    (aside,) = [o for o in result.observations if not o.used]
    assert (aside.id, aside.reason) == ("002", f"acquire.toy: {reason}")
    assert "002" not in log.poses


def test_captures_are_not_kept(execute: Callable[..., Any]) -> None:
    alive, most = weakref.WeakSet[t.Capture](), list[int]()
    plain = toy.segment.function

    def watched(capture):
        alive.add(capture)
        gc.collect()
        most.append(len(alive))
        return plain(capture)

    gc.freeze()  # what other tests left is not collected each time
    with replaced(toy.segment, watched):
        execute(TOY_RECIPE.replace("count: 6", "count: 30"))
    gc.unfreeze()
    assert max(most) <= 2


def test_a_bad_capture_is_data(execute: Callable[..., Any]) -> None:
    result, log = execute(TOY_RECIPE.replace("count: 6", "count: 6, bad: 2"))
    aside = [o for o in result.observations if not o.used]
    assert [(o.id, o.reason) for o in aside] == [
        ("000", "segment.toy: no finite point"), ("001", "segment.toy: no finite point"),
    ]  # fmt: skip
    assert [r.id for r in log.rejections] == ["000", "001"]
    assert [e.capture for e in log.of_kind("segment")] == ["002", "003", "004", "005"]
    assert result.status == "verified"


def pose_seen(capture):
    """The true pose of the target in a capture of the toy."""
    return (toy.BASE_T_CAMERA.inverse() @ capture.poses[t.FLANGE]).matrix


def both_seen(segment, sure=()):
    """A segment function of the toy: two half turns explain each scan, all but some."""

    def function(capture):
        pose, turned = pose_seen(capture), pose_seen(capture) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        alone = replace(segment(capture), camera_T_target=pose)
        return alone if capture.id in sure else replace(alone, camera_T_target=turned, others=pose)

    return function


def as_segmented(cloud, params):
    return t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, cloud.camera_T_target), 1e-8 * np.eye(6))


@pytest.mark.parametrize("sure", [(), ("003",)])
def test_of_poses_that_explain_a_scan_alike_the_arms_motion_decides(
    execute: Callable[..., Any], sure: tuple[str, ...]
) -> None:
    with (
        replaced(toy.segment, both_seen(toy.segment.function, sure)),
        replaced(toy.fit, as_segmented),
    ):
        result, log = execute(TOY_RECIPE)
    assert {o.id for o in result.observations} == {f"{k:03d}" for k in range(6)}
    for observation in log.observations():
        seen = observation.feature.camera_T_target.matrix
        assert np.allclose(seen, pose_seen(observation), atol=1e-6)
    assert sorted(log.finished) == sorted(log.poses)


def test_of_poses_of_which_one_alone_fits_that_one_is_taken_and_logged(
    execute: Callable[..., Any],
) -> None:
    def upright(cloud, params):
        turned = (toy.BASE_T_CAMERA.matrix @ cloud.camera_T_target)[0, 0] < 0
        return t.Rejected("upside down") if turned else as_segmented(cloud, params)

    with replaced(toy.segment, both_seen(toy.segment.function)), replaced(toy.fit, upright):
        result, log = execute(TOY_RECIPE)
    ids = [f"{k:03d}" for k in range(6)]
    assert [e.capture for e in log.of_kind("fit")] == [o.id for o in result.observations] == ids
    for observation in log.observations():
        seen = observation.feature.camera_T_target.matrix
        assert np.allclose(seen, pose_seen(observation), atol=1e-6)


def test_where_the_arms_motion_does_not_tell_the_captures_are_set_aside(
    execute: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(toy, "rigid", lambda *_: np.eye(4))
    with (
        replaced(toy.segment, both_seen(toy.segment.function)),
        replaced(toy.fit, as_segmented),
        pytest.raises(NothingSeen, match="2 poses of the target .* turn the target by 20 deg"),
    ):
        execute(TOY_RECIPE)


def test_verification_captures_are_kept_from_the_solver(execute: Callable[..., Any]) -> None:
    result, log = execute(TOY_RECIPE.replace("count: 6", "count: 6, verification: 2"))
    assert {o.id for o in result.observations} == {"002", "003", "004", "005"}
    assert result.verifications["4.verify.toy"].figures["views"] == 2
    assert [v.id for v in log.views()] == ["000", "001"]


def test_views_that_an_acquire_step_adds_reach_the_verification(
    execute: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = toy.acquire.function
    monkeypatch.setitem(toy.acquire.needs, "views", t.Views | None)

    def with_a_view(seed, views, params):
        flange = t.FlangeCloud(
            t.PointCloud(t.CAMERA, toy.CROSS), np.zeros(3), np.array([0, 0, -1.0])
        )
        pose = t.Transform(t.BASE, t.FLANGE, np.eye(4))
        views.append(t.VerificationView("published", flange, pose))
        return plain(seed, params)

    with replaced(toy.acquire, with_a_view):
        result, _ = execute(TOY_RECIPE)
    assert result.verifications["4.verify.toy"].figures["views"] == 1


@pytest.mark.parametrize(
    ("own", "centre"),
    [
        ("", [0.0, 0.0, 0.0]),
        ("workspace: {centre: [1 m, 2 m, 3 m], size: [1 m, 1 m, 1 m]}\n", [1, 2, 3]),
    ],
)
def test_a_recipes_own_workspace_goes_before_that_of_its_source(
    execute: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, own: str, centre: list[float]
) -> None:
    monkeypatch.setitem(toy.verify.needs, "box", t.Box)
    told = list[t.Box]()

    def verify(box, **_):
        told.append(box)
        return t.Verification(True, "as it is", {})

    with replaced(toy.verify, verify):
        execute(own + TOY_RECIPE)
    assert [box.centre.tolist() for box in told] == [centre]


def test_a_refused_calibration_keeps_its_evidence(execute: Callable[..., Any]) -> None:
    result, log = execute(TOY_RECIPE.replace("2 mm", "0.001 mm"))
    assert result.status == "refused"
    assert result.refused.startswith("verify.toy: 0.0")
    assert log.complete
    assert log.result["verifications"]["4.verify.toy"]["passed"] is False


def test_weld_runs_only_after_verification(execute: Callable[..., Any]) -> None:
    text = TOY_RECIPE + "  - seam.toy\n  - weld.toy\n"
    _, log = execute(text)
    assert [e.step for e in log.entries][-2:] == ["5.seam.toy", "6.weld.toy"]
    _, refused = execute(text.replace("2 mm", "0.001 mm"))
    assert refused.of_kind("weld") == []


def test_a_calibration_that_nothing_has_verified_is_given_as_such(
    execute: Callable[..., Any],
) -> None:
    result, log = execute(TOY_RECIPE.partition("  - verify.toy")[0])
    assert result.status == "unverified"
    calibration = log.calibration()
    assert calibration is not None and not isinstance(calibration, t.VerifiedHandEye)


SEAM_RECIPE = TOY_RECIPE + "  - scan.toy\n  - seam.toy\n  - weld.toy\n"


def test_a_seam_and_its_true_error_are_in_the_result(execute: Callable[..., Any]) -> None:
    result, log = execute(SEAM_RECIPE)
    assert result.seam.length == pytest.approx(np.sqrt(2))
    assert result.seam.truth.rms == pytest.approx(0, abs=1e-12)
    assert result.seam.truth.inside == 1
    assert result.provenance.notes[-1] == "scanned"
    assert log.last(t.WorkpieceScan).cloud.xyz.shape == (4, 3)


@pytest.mark.parametrize("at", ["verify.toy", "scan.toy", "seam.toy", "weld.toy"])
def test_a_seam_is_planned_again_from_the_log(execute: Callable[..., Any], at: str) -> None:
    first, log = execute(SEAM_RECIPE)
    again, _ = execute(SEAM_RECIPE, at, log)
    assert without_timing(again) == without_timing(first)


@pytest.mark.parametrize("at", ["segment.toy", "fit.toy", "solve.toy", "verify.toy", "3"])
def test_a_log_is_an_archive(execute: Callable[..., Any], at: str) -> None:
    text = TOY_RECIPE.replace("seed: 3", "seed: 3\nlog: {clouds: full}")
    text = text.replace("count: 6", "count: 7, bad: 1, verification: 2")
    first, log = execute(text)
    toy.acquired.clear()
    again, second_log = execute(text, at, log)
    assert toy.acquired == []
    assert without_timing(again) == without_timing(first)
    if at != "verify.toy":
        third, _ = execute(text, "solve.toy", second_log)
        assert third.transforms == first.transforms


def test_what_a_log_cannot_give_is_said(execute: Callable[..., Any]) -> None:
    _, log = execute(TOY_RECIPE)
    with pytest.raises(StageError, match="holds thinned scans only, which cannot be segmented"):
        execute(TOY_RECIPE, "segment.toy", log)
    with pytest.raises(StageError, match="that is the whole recipe; leave out --from"):
        execute(TOY_RECIPE, "acquire.toy", log)
    with pytest.raises(StageError) as error:
        execute(TOY_RECIPE, "solve.robust", log)
    assert str(error.value) == (
        "--at solve.robust: the recipe has no such step; its steps are acquire.toy, segment.toy, "
        "fit.toy, solve.toy, verify.toy"
    )


def test_too_few_poses_stop_the_run(execute: Callable[..., Any]) -> None:
    with pytest.raises(StageError, match="solve.toy: 3 poses needed, 2 given"):
        execute(TOY_RECIPE.replace("count: 6", "count: 2"))


def test_a_plugin_that_breaks_is_named(execute: Callable[..., Any]) -> None:
    with replaced(toy.fit, lambda cloud, params: 1 / 0), pytest.raises(StageError) as error:
        execute(TOY_RECIPE)
    assert str(error.value) == (
        "2.fit.toy: failed with ZeroDivisionError: division by zero; this is a mistake in the "
        "plugin (FLANGEYE_DEBUG=1 shows where)"
    )


def test_stopwatch_charges_each_step_its_own_time(execute: Callable[..., Any]) -> None:
    result, _ = execute(TOY_RECIPE)
    assert set(result.timing) == {
        "0.acquire.toy", "1.segment.toy", "2.fit.toy", "3.solve.toy", "4.verify.toy",
    }  # fmt: skip
    assert result.timing["1.segment.toy"].calls == 6
    assert all(spent.idle is None for spent in result.timing.values())


def test_a_source_is_opened_once_and_again_only_to_scan_in_a_simulated_cell(
    execute: Callable[..., Any],
) -> None:
    opened: list[t.Seed] = []
    plain = toy.acquire.function

    def counted(seed, params):
        opened.append(seed)
        return plain(seed, params)

    with replaced(toy.acquire, counted):
        _, log = execute(SEAM_RECIPE)
        assert len(opened) == 1
        execute(SEAM_RECIPE, "seam.toy", log)
        assert len(opened) == 1
        execute(SEAM_RECIPE, "scan.toy", log)
        assert len(opened) == 2


@pytest.mark.parametrize("recorded", [False, True])
def test_the_log_charges_each_step_the_time_that_the_result_does(
    execute: Callable[..., Any], recorded: bool
) -> None:
    plain = toy.acquire.function

    def made(seed, params):
        stream = plain(seed, params)
        stream.recorded = recorded
        return stream

    with replaced(toy.acquire, made):
        result, log = execute(SEAM_RECIPE)
    logged = dict.fromkeys(result.timing, 0.0)
    for entry in log.entries:
        logged[entry.step] += entry.seconds
    logged["0.acquire.toy"] = sum(meta["seconds"] for meta in log.poses.values())
    told = {label: timing.seconds for label, timing in result.timing.items()}
    # To set an acquire step up is charged to it too, before there is a capture.
    assert logged.pop("0.acquire.toy") <= told.pop("0.acquire.toy")
    assert logged == pytest.approx(told, rel=1e-6)


def test_what_is_read_back_took_no_time(execute: Callable[..., Any]) -> None:
    _, log = execute(SEAM_RECIPE)
    _, again = execute(SEAM_RECIPE, "seam.toy", log)
    read_back = [e.seconds for e in again.entries if e.kind in ("fit", "solve", "scan")]
    assert read_back and not any(read_back)


def test_what_refuses_before_it_solves_keeps_what_was_seen(execute: Callable[..., Any]) -> None:
    def refuse(observations, params):
        list(observations)
        raise CalibrationRefused("no motion", "move the arm")

    with replaced(toy.solve, refuse):
        result, _ = execute(TOY_RECIPE)
    assert (result.status, result.refused) == ("refused", "no motion")
    assert result.advice == "move the arm"
    assert [o.id for o in result.observations] == [f"{k:03d}" for k in range(6)]
    assert {(o.used, o.reason) for o in result.observations} == {(False, "refused before solving")}


def test_values_survive_the_log_bit_for_bit(execute: Callable[..., Any]) -> None:
    result, log = execute(TOY_RECIPE)
    logged = log.calibration()
    assert np.array_equal(
        logged.base_T_camera.transform.matrix, result.transforms["base_T_camera"].matrix
    )
    assert [o.id for o in log.observations()] == [o.id for o in result.observations]
    for observation, told in zip(log.observations(), result.observations, strict=True):
        assert observation.circle.centre.tolist() == told.centre_in_camera


@pytest.mark.parametrize("told", [t.ExpectedError(1e-4, 2e-4), None])
def test_only_a_solver_that_tells_no_expected_error_gets_the_mixed_models(
    execute: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, told: t.ExpectedError | None
) -> None:
    plain, given, of_model = toy.solve.function, [], t.ExpectedError(3e-4, 4e-4)

    def solve(observations, params):
        return replace(plain(observations, params), expected=told)

    def verify(calibration, solve, views, params):
        given.append(calibration.expected)
        return t.Verification(True, "as it is", {})

    monkeypatch.setattr(
        "flangeye.estimation.calibrate.with_expected_error",
        lambda found, *_: replace(found, expected=of_model),
    )
    with replaced(toy.solve, solve), replaced(toy.verify, verify):
        execute(TOY_RECIPE)
    assert given == [told or of_model]


def test_a_refining_step_changes_the_calibration_that_is_verified(
    execute: Callable[..., Any],
) -> None:
    text = TOY_RECIPE.replace("  - verify.toy", "  - refine.toy\n  - verify.toy")
    result, log = execute(text)
    assert result.provenance.notes[-1] == "refined"
    assert log.given("solve.toy").notes == ()
    assert log.calibration().notes == ("refined",)
    again, _ = execute(text, "verify.toy", log)
    assert without_timing(again) == without_timing(result)


def test_what_is_solved_again_is_refined_again(execute: Callable[..., Any]) -> None:
    told = []

    def verify(calibration, solve, views, params):
        told.append(solve([pair.observation for pair in calibration.pairs[1:]]))
        return t.Verification(True, "as it is", {})

    with replaced(toy.verify, verify):
        execute(TOY_RECIPE.replace("  - verify.toy", "  - refine.toy\n  - verify.toy"))
    assert told[0].notes == ("refined",)
    assert len(told[0].pairs) == 5


def test_a_solver_does_not_speak_for_what_was_refined(execute: Callable[..., Any]) -> None:
    told: list[tuple[Any, Any]] = []
    plain = toy.solve.function

    def solve(observations, params):
        return replace(plain(observations, params), without=lambda poses: told)

    def verify(calibration, solve, views, params):
        again = solve([pair.observation for pair in calibration.pairs[1:]])
        told.append((calibration.without, again.without))
        return t.Verification(True, "as it is", {})

    with replaced(toy.solve, solve), replaced(toy.verify, verify):
        execute(TOY_RECIPE)
        execute(TOY_RECIPE.replace("  - verify.toy", "  - refine.toy\n  - verify.toy"))
    assert all(told[0])
    assert told[1] == (None, None)


@pytest.mark.parametrize(
    ("clouds", "hint"),
    [
        ("full", "flangeye run toy --from old.mcap --at segment.toy --set PATH=VALUE"),
        ("preview", "flangeye run toy --from old.mcap --at fit.toy --set PATH=VALUE "
         "(to do segment.toy again, record with --set log.clouds=full)"),
    ],
)  # fmt: skip
def test_a_log_is_gone_on_with_at_the_first_step_whose_input_it_holds(
    toy_registry: Registry, clouds: str, hint: str
) -> None:
    text = f"log: {{clouds: {clouds}}}\n{TOY_RECIPE}"
    recipe = parse_recipe(text, "toy", toy_registry)
    assert restart_hint(recipe, "toy", Path("old.mcap")) == hint
