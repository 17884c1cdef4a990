"""What python -m tools.equal_results takes for equal."""

import math

from tools.equal_results import _differences, _environment, _summary

RESULT = {
    "status": "verified",
    "transforms": {"base_T_camera": {"matrix": [[1.0, 0.0], [0.0, math.nan]]}},
    "timing": {"1.fit.rim": {"seconds": 1.0}},
    "provenance": {"versions": {"numpy": "2.4"}, "seed": 0},
}


def test_timing_and_versions_do_not_count() -> None:
    other = {
        **RESULT,
        "timing": {},
        "provenance": {"versions": {"numpy": "3.0"}, "seed": 0},
    }
    assert list(_differences(RESULT, other)) == []


def test_the_last_bit_counts_and_is_named_by_its_place() -> None:
    matrix = [[1.0, 0.0], [math.ulp(0.0), math.nan]]
    other = {**RESULT, "transforms": {"base_T_camera": {"matrix": matrix}}}
    assert list(_differences(RESULT, other)) == [
        "transforms.base_T_camera.matrix[1][0]: 0.0, now 5e-324"
    ]


def test_a_value_that_one_result_has_alone_counts() -> None:
    assert list(_differences(RESULT, {**RESULT, "seam": []})) == ["seam: None, now []"]


def test_a_line_tells_the_names_of_what_differs() -> None:
    assert _summary([]) == "equal"
    apart = ["a.matrix[0][1]: 0.0, now 1.0", "a.matrix[0][2]: 0.0, now 1.0", "b.rms: 1, now 2"]
    assert _summary(apart) == f"3 values differ, of matrix, rms; {apart[0]}"


def test_code_is_run_with_its_own_list_of_plugins(tmp_path) -> None:
    code = tmp_path / "code"
    code.mkdir()
    (code / "pyproject.toml").write_text(
        '[project]\nname = "flangeye"\nversion = "9"\n'
        '[project.entry-points.flangeye]\nbuiltin = "some_plugins"\n'
    )
    _environment(code, tmp_path)
    info = tmp_path / "plugins" / "flangeye-9.dist-info"
    assert (info / "entry_points.txt").read_text() == "[flangeye]\nbuiltin = some_plugins\n"
