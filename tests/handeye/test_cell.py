"""What a cell's answer says: who agrees, what it is known to, and what was seen of whom."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye import cell as room
from flangeye.handeye.cell import _estimate, _note_of_sizes, _notes, _pairs, _require_agreement
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.types import Transform


def test_half_of_the_sightings_have_to_agree() -> None:
    for agree, count in ((3, 6), (4, 7), (1, 1)):
        some: Any = SimpleNamespace(inliers=np.arange(count) < agree)
        _require_agreement(some, count)
    for agree, count in ((2, 5), (3, 7), (0, 1)):
        some = SimpleNamespace(inliers=np.arange(count) < agree)
        with pytest.raises(CalibrationRefused, match=f"only {agree} of {count} sightings agree"):
            _require_agreement(some, count)


def test_without_a_sighting_nothing_is_solved() -> None:
    nothing: Any = None
    with pytest.raises(StageError, match="no sighting to solve with: every capture was set aside"):
        room.sighted_of([], nothing, (1.0, 1.0))


def seen(camera: str, target: str, *centre: float) -> Any:
    feature = SimpleNamespace(centre=np.array(centre or (0.0, 0.0, 0.0)))
    return SimpleNamespace(camera=camera, target=target, feature=feature)


def test_a_camera_is_known_about_the_middle_of_what_it_saw_and_a_target_where_it_is() -> None:
    pose = rigid(rotation_exp([0.3, -0.2, 0.5]), np.array([0.4, 0.2, 0.9]))
    observations = [seen("left", "plate", 0.1, 0, 1.0), seen("left", "plate", 0.3, 0.2, 0.6),
                    seen("right", "plate", 9.0, 9, 9)]  # fmt: skip
    covariance = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-8
    found: Any = SimpleNamespace(covariances={"left": covariance, "plate": covariance})
    camera = _estimate(Transform("base", "left", pose), found, observations)
    middle = pose[:3, :3] @ [0.2, 0.1, 0.8] + pose[:3, 3]
    assert camera.about == pytest.approx(middle)
    lever = np.eye(6)
    for k in range(3):
        lever[3:, k] = np.cross(np.eye(3)[k], middle - pose[:3, 3])
    assert camera.covariance == pytest.approx(lever @ covariance @ lever.T)
    target = _estimate(Transform("base", "plate", pose), found, observations)
    assert target.about == pytest.approx(pose[:3, 3])
    assert target.covariance == pytest.approx(covariance)
    assert target.unobservable.shape == (0, 6)


def test_sightings_set_aside_are_told_with_their_distance_turn_and_sigma(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapped, expected = np.array([[1.0, 2, 3], [4.0, 5, 6]]), np.array([[1.0, 1, 1], [0.0, 0, 0]])
    monkeypatch.setattr(room, "mapped_and_expected", lambda *_: (mapped, expected))
    monkeypatch.setattr(room, "_transforms", lambda *_: None)
    turn = np.radians(0.3), 0.0, np.radians(0.4)
    found: Any = SimpleNamespace(
        inliers=np.array([True, False]), squares=np.array([1.0, 144.0]),
        residuals=np.array([np.zeros(6), [*turn, 0.0, 3e-3, 4e-3]]),
    )  # fmt: skip
    cell: Any = SimpleNamespace(ends=lambda *_: None)
    first, second = _pairs([seen("left", "plate")] * 2, cell, found)
    assert first.used and first.reason is None
    assert first.residual == pytest.approx([0.0, 1.0, 2.0])
    assert not second.used and second.residual == pytest.approx([4.0, 5.0, 6.0])
    assert second.reason == "residual 5.0 mm and 0.5 deg, 12 sigma"


def test_who_saw_whom_and_what_moves_is_noted_with_its_noise() -> None:
    """In the ratio of a typical arm's: 0.05 mm to 0.01 deg."""
    observations = [seen("left", "plate")] * 3 + [seen("right", "plate")]
    found: Any = SimpleNamespace(movers=9.0)
    assert _notes(observations, found, None) == (
        "solved at once: left saw plate 3 times, right saw plate 1 times",
        "noise of what moves: 0.150 mm and 0.030 deg per axis, as the residuals show it",
    )
    sizes: Any = SimpleNamespace(expected=np.array([2.0, 1.0, 1.1, 1.2, 1.3, 1.4]))
    (note,) = _note_of_sizes(sizes)
    assert note.startswith("the covariance counts joint zeros 2.0 times as large as the robots'")
    assert "encoders 1.0, sag 1.1, lengths 1.2, twists 1.3, what is smooth over the" in note
