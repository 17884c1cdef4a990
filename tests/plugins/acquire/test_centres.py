"""acquire.centres: published centres without clouds, and the published results from them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import wrist_circle_of
from flangeye.types import ArchivePath, Source
from flangeye.types.geometry import kabsch, rigid
from flangeye.units import SI
from flangeye.workflow.log.record import Recorder
from flangeye_plugins.acquire.centres import CentresParams, acquire_centres
from flangeye_plugins.reader.ancorasir import AncorasirParams
from flangeye_plugins.reader.ancorasir import ancorasir as reader
from flangeye_plugins.reader.auto import auto


def acquire(path, robot=None, **params):
    chosen = reader.bind(AncorasirParams(robot=robot)) if robot else auto.bind()
    return acquire_centres(ArchivePath(path), CentresParams(reader=chosen, **params))


@pytest.mark.parametrize(
    ("robot", "folder", "unit", "dropped"),
    [
        ("aubo", "data/aubo", 1.0, []),
        # The authors' script drops the last column, and does so twice.
        ("ur5", "data/ur5", 1e-3, [50, 51]),
        # A centre 37 mm off, which they took out by hand.
        ("franka", "data/franka", 1e-3, [44]),
        ("kinect", "Kinect_Result", 1e-3, []),
    ],
)
def test_published_centres_give_the_published_matrix(
    ancorasir: Path, robot: str, folder: str, unit: float, dropped: list[Any]
) -> None:
    observations = list(acquire(ancorasir, robot))
    left_out = tuple(observations[i].id for i in dropped)
    used = list(acquire(ancorasir, robot, leave_out=left_out))
    assert len(used) == len(observations) - len(dropped)
    centres = np.array([o.circle.centre for o in used])
    tcps = np.array([o.tcp_in_base for o in used])
    published = np.load(ancorasir / folder / "H.npy")
    published[:3, 3] *= unit
    assert np.abs(rigid(*kabsch(centres, tcps)) - published).max() < 1e-6


def test_counts_and_residuals_of_the_aubo(ancorasir: Path) -> None:
    stream = acquire(ancorasir, "aubo")
    observations = list(stream)
    assert (len(observations), stream.total) == (54, 54)
    centres = np.array([o.circle.centre for o in observations])
    tcps = np.array([o.tcp_in_base for o in observations])
    rotation, translation = kabsch(centres, tcps)
    errors = np.linalg.norm(centres @ rotation.T + translation - tcps, axis=1)
    assert np.sqrt((errors**2).mean()) == pytest.approx(0.663e-3, abs=1e-6)
    assert np.median(errors) == pytest.approx(0.540e-3, abs=1e-6)


@pytest.fixture
def archive(tmp_path: Path) -> Any:
    """Four UR poses with centres."""
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(1).uniform(0, 1, (4, 3))
    np.savez(tmp_path / "calibration_robot_pose_data.npz", poses)
    np.save(tmp_path / "p_robot_mat.npy", poses[:3, :3, 3].T * 1000)
    np.save(tmp_path / "p_camera_mat.npy", np.ones((3, 3)) * 400)
    return tmp_path


def test_a_centre_has_the_stated_noise_and_no_normal(archive: Any) -> None:
    stream = acquire(archive, centre_noise=SI(0.5e-3))
    first = next(iter(stream))
    assert first.id == "0"
    assert np.allclose(first.circle.covariance, 0.25e-6 * np.eye(3))
    assert first.circle.normal is None and first.circle.normal_covariance is None
    assert stream.source.notes[-2:] == (
        "skipped 1 of 4 poses, without a ready-made centre: 3",
        "3 ready-made centres, assumed standard deviation 0.5 mm per axis",
    )


def test_centres_of_a_wrist_circle_lie_behind_the_flange(archive: Any) -> None:
    robot = load_model("robots", "ur10e")
    chosen = CentresParams(reader=auto.bind())
    wrist = acquire_centres(ArchivePath(archive), chosen, wrist_circle_of(robot.flange, 0.09))
    plain = list(acquire(archive))
    assert wrist.source.notes[-1].endswith("mm per axis; they lie 6.5 mm behind the flange")
    for behind, at_face in zip(wrist, plain, strict=True):
        offset = behind.tcp_in_base - at_face.tcp_in_base
        assert offset == pytest.approx(-6.5e-3 * behind.base_T_flange.rotation[:, 2], abs=1e-15)


def test_the_fingerprint_follows_the_files(archive: Any) -> None:
    first = acquire(archive).source.fingerprint
    np.save(archive / "p_camera_mat.npy", np.ones((3, 3)) * 401)
    assert acquire(archive).source.fingerprint != first


def test_an_archive_without_centres_names_the_other_way(archive: Any) -> None:
    (archive / "p_camera_mat.npy").unlink()
    with pytest.raises(StageError) as error:
        acquire(archive)
    assert str(error.value) == (
        f"{archive}: holds no ready-made centres (ancorasir {archive.name}); acquire.archive reads "
        "its clouds"
    )


def test_two_centres_are_too_few(archive: Any) -> None:
    with pytest.raises(StageError) as error:
        acquire(archive, leave_out=("1",))
    assert str(error.value) == (
        f"{archive}: 2 captures to calibrate with; at least 3 are needed, at different places"
    )


def test_no_archive_given() -> None:
    with pytest.raises(StageError) as error:
        acquire(None)
    assert str(error.value) == (
        "acquire.centres: no archive given; add --archive PATH, or path: in the recipe"
    )


def test_a_log_gives_the_centres_it_holds(archive: Any, tmp_path: Path) -> None:
    given = list(acquire(archive))
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, {}, full_clouds=False)
    recorder.flangeye_run_started(source=Source("x"), total=3)
    for observation in given:
        recorder.flangeye_stage_finished(
            step="0.acquire.centres", capture=observation.id, value=observation, seconds=0.0
        )
    recorder.close()
    again = list(acquire(path))
    assert [o.id for o in again] == [o.id for o in given]
    assert all(
        np.array_equal(a.circle.centre, b.circle.centre) for a, b in zip(again, given, strict=True)
    )
