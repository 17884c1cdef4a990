"""Table 1, figure 11 and the Kinect's row on the authors' recordings."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.types import BASE, CAMERA, ArchivePath, Transform, Views
from flangeye_paper.icp_as_in_paper import (
    ByIterationParams,
    PaperIcpParams,
    error_icp_as_in_paper,
    verify_by_iteration,
)
from flangeye_paper.points import PointsParams, acquire_points
from flangeye_paper.published import (
    PublishedParams,
    StoredParams,
    acquire_published_centres,
    verify_stored_results,
)
from flangeye_paper.realisations import error_oracle
from flangeye_plugins.cost import TranslationParams, cost_translation
from flangeye_plugins.reader.ancorasir import AncorasirParams
from flangeye_plugins.reader.ancorasir import ancorasir as reader
from flangeye_plugins.solve.svd import SvdParams, solve_svd

ICP, STORED = "verify.icp_as_in_paper", "verify.stored_results_as_in_paper"


def printed(figures):
    """Millimetres and degrees, as the paper has them."""
    shift = [figures[axis] * 1e3 for axis in "xyz"]
    return np.array(shift + [np.degrees(figures[axis]) for axis in ("roll", "pitch", "yaw")])


def test_the_aubo_row_is_reproduced_by_the_defect_of_2019(
    paper: Callable[..., Any], ancorasir: Path
) -> None:
    figures, result = paper("table1_aubo", ICP, archive=ancorasir)
    off = np.abs(printed(figures) - [-0.259, 0.269, -0.351, 0.135, 0.045, 0.007])
    # The defect normalises rounding errors, so the last digits are those of the machine and its
    # libraries: unchanged code has given y 0.0014 mm apart. Four ways to round the same formula
    # differ by (0.008, 0.016, 0.002) mm and (0.002, 0.002, 0.005) deg; sound normals by 1 to 3 mm.
    assert (off <= [0.016] * 3 + [0.005] * 3).all()
    assert figures["iterations"] == 5
    assert len(result.observations) == 54


def test_sound_normals_and_a_converged_icp_tell_another_story(
    paper: Callable[..., Any], ancorasir: Path
) -> None:
    overrides = ["steps.2.normals=sound", "steps.2.iterations=60", "steps.2.change=1e-9"]
    figures, _ = paper("table1_aubo", ICP, *overrides, archive=ancorasir)
    np.testing.assert_allclose(
        printed(figures), [1.356, 3.344, -0.074, 0.570, -0.269, 0.952], atol=2e-3
    )


@pytest.mark.parametrize(
    ("name", "row", "atol"),
    [
        ("ur5", [11.60, 2.81, 5.55, 0.49, -0.89, -0.47], [0.1, 0.4, 0.1, 0.06, 0.06, 0.06]),
        ("franka", [4.34, -4.06, -0.13, -0.30, -0.34, -0.07], [0.1] * 3 + [0.03] * 3),
    ],
)
def test_stored_results_imply_the_printed_rows(
    paper: Callable[..., Any], ancorasir: Path, name: str, row: list[Any], atol: Any
) -> None:
    figures, _ = paper(f"table1_{name}", STORED, archive=ancorasir)
    assert (np.abs(printed(figures) - row) <= atol).all()


def test_the_published_matrix_is_that_of_the_recipe(
    paper: Callable[..., Any], ancorasir: Path
) -> None:
    for name, folder in (("aubo", "aubo"), ("ur5", "ur5"), ("franka", "franka")):
        _, result = paper(f"table1_{name}", STORED, archive=ancorasir)
        found = np.array(result.transforms["base_T_camera"].matrix)
        theirs = np.load(ancorasir / "data" / folder / "H.npy")
        theirs[:3, 3] /= 1 if name == "aubo" else 1e3
        np.testing.assert_allclose(found, theirs, atol=3e-7)


def test_the_kinect_s_icp_does_not_even_begin_at_a_millimetre(
    paper: Callable[..., Any], ancorasir: Path
) -> None:
    figures, result = paper("table1_kinect", ICP, archive=ancorasir)
    assert figures == {}
    assert result.refused == "ICP failed: too few points match, the error is infinite"


def test_a_shuffle_is_the_seed_s(ancorasir: Path) -> None:
    params = PublishedParams(reader=reader.bind(AncorasirParams(robot="aubo")), shuffle=True)
    path = ArchivePath(ancorasir)
    orders = [
        [o.id for o in acquire_published_centres(path, Views(), seed, params)] for seed in (1, 1, 2)
    ]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2])


def test_algorithm_1_by_iteration_improves_as_it_goes() -> None:
    calibration = solve_svd(acquire_points(0, PointsParams(poses=30)), SvdParams())
    params = ByIterationParams(
        error=error_oracle.bind(), cost=cost_translation.bind(TranslationParams(at="camera"))
    )
    figures = verify_by_iteration(calibration, None, None, params).figures
    norms = [np.linalg.norm([figures[f"{axis}_{n:02d}"] for axis in "xyz"]) for n in range(4, 31)]
    assert norms == sorted(norms, reverse=True)
    assert figures["x"] == figures["x_30"]
    assert figures["others_rms"] > 1e-3


@pytest.mark.slow
def test_figure_11_ends_where_the_authors_did(paper: Callable[..., Any], ancorasir: Path) -> None:
    figures, _ = paper("fig11_aubo", "verify.algorithm_1_by_iteration", archive=ancorasir)
    assert np.linalg.norm(printed(figures)[:3]) < 0.4
    assert 0.5e-3 < figures["others_rms"] < 1.3e-3


def test_where_no_verification_cloud_was_published_it_says_so(ancorasir: Path) -> None:
    views = Views()
    params = PublishedParams(reader=reader.bind(AncorasirParams(robot="ur5")))
    acquire_published_centres(ArchivePath(ancorasir), views, 0, params)
    with pytest.raises(StageError) as error:
        error_icp_as_in_paper(Transform(BASE, CAMERA, np.eye(4)), [], views, None, PaperIcpParams())
    assert str(error.value) == (
        "no published verification cloud: acquire.published_centres has one of the Aubo and of "
        "the Kinect; those of the UR5, UR10e and Franka were never published"
    )


def test_stored_results_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(StageError) as error:
        verify_stored_results(None, ArchivePath(tmp_path), StoredParams(robot="ur5"))
    assert str(error.value) == (
        f"{tmp_path}: no data/ur5/results_photoneo.npz; give the published folder"
    )
