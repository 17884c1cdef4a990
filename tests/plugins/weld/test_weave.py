"""The torch swings across the seam as it is asked to; later passes go along what the root found."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from flangeye_plugins.weld.following.steering import Weave, WeaveOffset
from flangeye_plugins.weld.passes import follower_of
from flangeye_plugins.weld.resuming import controller_from
from tests.plugins.weld.bench import rms
from tools.weld_bench import curved, misplanned, try_condition
from tools.weld_conditions import CONDITIONS, Condition

SHORT, PERIOD = 0.08, 16e-3


def test_a_swing_is_a_sine_with_its_derivatives() -> None:
    weave, step = Weave(4e-3, 0.7), 1e-5
    assert weave.at(-1.0) == WeaveOffset() == Weave(0.0, 1.0).at(2.0)
    for t in (0.1, 0.6, 1.3):
        here, before, after = (weave.at(t + dt) for dt in (0.0, -step, step))
        assert here.rate == pytest.approx((after.aside - before.aside) / (2 * step), abs=1e-8)
        assert here.rush == pytest.approx((after.rate - before.rate) / (2 * step), abs=1e-7)
    assert max(abs(weave.at(t).rate) for t in np.arange(0, 3, 1e-3)) <= weave.fastest + 1e-12


@pytest.mark.parametrize(
    ("name", "width", "frequency"),
    [
        pytest.param("weave 3 mm at 0.8 Hz", 3e-3, 0.8, marks=pytest.mark.slow),
        ("weave 2 mm at 1 Hz, arm lag 100 ms + dead time 60 ms", 2e-3, 1.0),
    ],
)
def test_the_true_torch_swings_as_asked(name: str, width: float, frequency: float) -> None:
    found = try_condition(CONDITIONS[name], 0, SHORT, 8e-3)
    assert found.done, found.controller.reason
    assert rms(found.errors) < 0.1e-3
    time, torch = (
        found.column("time")[found.beside][200:],
        found.column("torch")[found.beside][200:],
    )
    turns = 2 * np.pi * frequency * time
    rows = np.column_stack([np.sin(turns), np.cos(turns), np.ones_like(time)])
    sine, cosine, middle = np.linalg.lstsq(rows, torch, rcond=None)[0]
    assert 2 * np.hypot(sine, cosine) == pytest.approx(width, rel=0.05)
    assert abs(middle) < 0.1e-3


def by_pass(found):
    """The torch's errors, root pass first."""
    beside = found.beside
    error = (found.column("torch") - found.column("aim"))[beside]
    back = np.flatnonzero(np.diff(found.column("torch_s")[beside]) < -0.02)
    return np.split(error, back + 1)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if "lag" in name else ())
        for name in CONDITIONS
        if "passes" in name
    ],
)
def test_every_pass_is_where_it_was_asked_to_be_and_decided_again_from_its_log(name: str) -> None:
    given = []

    def listening(controller):
        step = controller.step

        def heard(pose, touches):
            given.append((pose, touches, step(pose, touches)))
            return given[-1][2]

        controller.step = heard

    asked = CONDITIONS[name]
    found = try_condition(asked, 0, SHORT, PERIOD, listening)
    assert found.done, found.controller.reason
    passes = by_pass(found)
    assert len(passes) == 1 + len(asked.settings["passes"])
    assert [rms(each) < 0.1e-3 for each in passes] == [True] * len(passes)
    assert found.bounded
    root = follower_of(found.controller)
    start = {
        "points": misplanned(curved(SHORT), 0, *asked.planned).tolist(), "wraps": 0.0,
        "mode": "tactile", "prior": asdict(root.task.prior),
        "settings": root.task.settings.model_dump(mode="json"),
    }  # fmt: skip
    again = controller_from(json.loads(json.dumps(start)))
    for pose, touches, command in given:
        decided = again.step(pose, touches)
        np.testing.assert_array_equal(decided.velocity, command.velocity)
        assert decided.turn == command.turn
    assert again.phase == "done"


def test_a_pass_that_is_not_known_well_enough_stops_the_weld() -> None:
    """The root pass just stays within it; the next one adds what the arm and heat may do."""
    doubtful = Condition(settings={
        "passes": [{"across": "1 mm"}], "distortion": "0.15 mm", "max_error": "1 mm", "sigmas": 4.0,
    })  # fmt: skip
    found = try_condition(doubtful, 0, SHORT, PERIOD)
    assert found.phases[-1] == "stopped"
    assert found.controller.reason.startswith("in pass 2 the torch is known to 1.")
