"""What a cell's answer says: who agrees, what it is known to, and what was seen of whom."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye import cell as room
from flangeye.handeye.cell import _estimate, _note_of_sizes, _notes, _pairs, _require_agreement
from flangeye.handeye.components import Noise
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.types import Transform


def test_half_of_the_sightings_have_to_agree() -> None:
    for agree, count in ((3, 6), (4, 7), (1, 1)):
        some: Any = SimpleNamespace(found=SimpleNamespace(inliers=np.arange(count) < agree))
        _require_agreement(some, count)
    for agree, count in ((2, 5), (3, 7), (0, 1)):
        some = SimpleNamespace(found=SimpleNamespace(inliers=np.arange(count) < agree))
        with pytest.raises(CalibrationRefused, match=f"only {agree} of {count} sightings agree"):
            _require_agreement(some, count)


def test_without_a_sighting_nothing_is_solved() -> None:
    nothing: Any = None
    with pytest.raises(StageError, match="no sighting to solve with: every capture was set aside"):
        room.solve_cell([], nothing, (1.0, 1.0))


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
    residuals = np.array([np.zeros(6), [*turn, 0.0, 3e-3, 4e-3]])
    fit = SimpleNamespace(
        inliers=np.array([True, False]), squares=np.array([1.0, 144.0]),
        linear=SimpleNamespace(residuals=residuals),
    )  # fmt: skip
    found: Any = SimpleNamespace(found=fit)
    cell: Any = SimpleNamespace(ends=lambda *_: None)
    first, second = _pairs([seen("left", "plate")] * 2, cell, found)
    assert first.used and first.reason is None
    assert first.residual == pytest.approx([0.0, 1.0, 2.0])
    assert not second.used and second.residual == pytest.approx([4.0, 5.0, 6.0])
    assert second.reason == "residual 5.0 mm and 0.5 deg, 12 sigma"


def test_who_saw_whom_and_what_noise_there_is_is_noted() -> None:
    """What the arms' noise does in the camera, and what is added evenly, per axis."""
    observations = [seen("left", "plate")] * 3 + [seen("right", "plate")]
    of_arms = np.tile(np.diag([1e-8] * 3 + [4e-8] * 3), (4, 1, 1))
    noise = Noise(pose=9e-8, tilt=3e-8, arms=4.0)
    fit = SimpleNamespace(linear=SimpleNamespace(of_arms=of_arms), noise=noise)
    found: Any = SimpleNamespace(found=fit)
    assert _notes(observations, found, None) == (
        "solved at once: left saw plate 3 times, right saw plate 1 times",
        f"noise beyond the features' own: 0.500 mm and {np.degrees(np.sqrt(7e-8)):.3f} deg per axis",
    )
    sizes: Any = SimpleNamespace(expected=np.array([2.0, 1.0, 1.1, 1.2, 1.3, 1.4]))
    (note,) = _note_of_sizes(sizes)
    assert note.startswith("the covariance counts joint zeros 2.0 times as large as the robots'")
    assert "encoders 1.0, sag 1.1, lengths 1.2, twists 1.3, what is smooth over the" in note
