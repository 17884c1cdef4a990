"""Tables of every form are the same rows of named cells."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from flangeye.errors import StageError
from flangeye.files.tables import files_at, read_table

numbers = st.floats(-1e6, 1e6)


def record(k: int) -> dict[str, Any]:
    return {"at": {"x": k + 0.5, "y": -k}, "seen": [[1, k], [0, 2e-7]], "image": f"{k}.png"}


COLUMNS = ("at.x", "at.y", "seen.0.0", "seen.0.1", "seen.1.0", "seen.1.1", "image")
FORMS: dict[str, Callable[[list[Any]], str]] = {
    "a.json": json.dumps,
    "b.json": lambda records: json.dumps({"frames": records, "camera": "none"}),
    "c.jsonl": lambda records: "\n\n".join(map(json.dumps, records)),
    "d.yaml": lambda records: yaml.safe_dump(records, sort_keys=False),
}


@pytest.mark.parametrize("name", FORMS)
def test_records_are_rows_with_dotted_columns(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FORMS[name]([record(k) for k in range(4)]))
    table = read_table(tmp_path, name)
    assert table.heading == COLUMNS
    assert table.numbers(table.indices(["at.x", "seen"]))[3].tolist() == [3.5, 1, 3, 0, 2e-7]
    assert table.texts(table.index("image")) == ["0.png", "1.png", "2.png", "3.png"]


@given(rows=st.lists(st.lists(numbers, min_size=6, max_size=6), min_size=1, max_size=5))
def test_a_number_is_the_same_from_text_and_from_json(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[float]]
) -> None:
    folder = tmp_path_factory.mktemp("tables")
    (folder / "t.json").write_text(json.dumps(rows))
    (folder / "t.csv").write_text("".join(",".join(map(repr, row)) + "\n" for row in rows))
    for name in ("t.json", "t.csv"):
        assert np.array_equal(read_table(folder, name).numbers(range(6)), rows)


def test_files_with_a_record_each_are_one_table_in_the_order_of_their_numbers(
    tmp_path: Path,
) -> None:
    for k in (10, 9, 1):
        (tmp_path / f"pose_{k}.json").write_text(json.dumps(record(k)))
    table = read_table(tmp_path, "pose_*.json")
    assert table.texts(table.index("image")) == ["1.png", "9.png", "10.png"]
    assert table.files == tuple(tmp_path / f"pose_{k}.json" for k in (1, 9, 10))
    assert table.where(1) == str(tmp_path / "pose_9.json")


def test_a_file_is_found_by_its_name_and_others_by_a_pattern(tmp_path: Path) -> None:
    for name in ("log[1].csv", "a/pose.json", "b/pose.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1\n")
    assert files_at(tmp_path, "log[1].csv") == [tmp_path / "log[1].csv"]
    assert files_at(tmp_path, "*/pose.json") == [tmp_path / f"{n}/pose.json" for n in "ab"]
    assert files_at(tmp_path, "c/pose.json") == files_at(tmp_path, "/etc/*") == []


@pytest.mark.parametrize(
    "name", ["**/*.csv", "a**b", "x" * 5000, "x" * 300 + "*", "*\0", "a*" * 50]
)
def test_no_name_takes_long_or_ends_in_a_traceback(name: str, tmp_path: Path) -> None:
    (tmp_path / ("a" * 200)).touch()
    began = time.process_time()
    try:
        assert files_at(tmp_path, name) in ([], [tmp_path / ("a" * 200)])
    except StageError as error:
        assert "is not a valid file name: " in str(error) and len(str(error)) < 300
    assert time.process_time() - began < 1.0


def test_a_value_that_is_missing_is_an_empty_cell(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(json.dumps([{"x": 1}, {"x": None, "y": 2}]))
    assert [cells for _, cells in read_table(tmp_path, "t.json").rows] == [(1, ""), ("", 2)]


FANUC = """P[1]{{
   GP1:
    UF : 0, UT : 1,    CONFIG : 'N U T, 0, 0, 0',
    X =  {0:9.3f}  mm,    Y =  {1:9.3f}  mm,    Z =  {2:9.3f}  mm,
    W =  {3:9.3f} deg,    P =  {4:9.3f} deg,    R =  {5:9.3f} deg
}};
"""
PROGRAMS = {
    "x_m y_m z_m rx_rad ry_rad rz_rad": "movel(p[{}, {}, {}, {}, {}, {}], a=1.2, v=0.25)\n",
    "x_mm y_mm z_mm a_deg b_deg c_deg": "XP={{X {},Y {},Z {},A {},B {},C {},S 2,T 35,E1 0.0}}\n",
    "x_mm y_mm z_mm w_deg p_deg r_deg": FANUC,
    "x_mm y_mm z_mm q1 q2 q3 q4": "CONST robtarget p:=[[{},{},{}],[{},{},{},{}],[0,0,0,0],"
    "[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
}


@pytest.mark.parametrize("columns", PROGRAMS)
def test_the_positions_of_a_program_are_rows(tmp_path: Path, columns: str) -> None:
    rows = np.round(np.random.default_rng(3).uniform(-180, 180, (3, len(columns.split()))), 3)
    text = "def calibrate():\n" + "".join(PROGRAMS[columns].format(*row) for row in rows)
    (tmp_path / "program.txt").write_text(text + "end\n")
    table = read_table(tmp_path, "program.txt")
    assert table.heading == tuple(columns.split())
    assert table.convention is not None
    assert np.array_equal(table.numbers(range(rows.shape[1])), rows)
    first = 5 if columns.endswith("w_deg p_deg r_deg") else 2
    assert table.where(0) == f"{tmp_path / 'program.txt'}:{first}"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("t.json", "[1", "t.json: is not JSON: Expecting ',' delimiter"),
        ("t.json", "[" * 100_000, "t.json: is not JSON: maximum recursion depth exceeded"),
        ("t.json", "7", "t.json: expected arrays of poses, a list of records, or a record under each scan's name"),
        ("t.jsonl", '{"x": 1}\n{"x":\n', "t.jsonl:2: is not JSON: Expecting value"),
        ("t.yaml", "a: [1", "t.yaml:1: not valid YAML"),
        ("t.yaml", "# " + "x" * 1_000_000, "t.yaml: is larger than 1000000 bytes; write it as"),
        ("t.json", json.dumps([[0] * 1001]),
         "t.json: record 1: has more than 1000 values, too many for a pose"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(StageError) as error:
        read_table(tmp_path, name)
    assert str(error.value).removeprefix(f"{tmp_path}/").startswith(message)


def test_files_of_one_pattern_have_the_same_columns(tmp_path: Path) -> None:
    (tmp_path / "1.json").write_text('{"x": 1}')
    (tmp_path / "2.json").write_text('{"y": 1}')
    with pytest.raises(StageError, match=r"2\.json: its columns are not those of 1\.json"):
        read_table(tmp_path, "*.json")


@pytest.mark.parametrize("end", ["x", "# remark"])
def test_a_line_of_blanks_is_read_in_linear_time(tmp_path: Path, end: str) -> None:
    (tmp_path / "a.txt").write_text("1 2 3" + " " * 400_000 + end + "\n4 5 6\n7 8 9\n")
    rows = read_table(tmp_path, "a.txt").rows  # in quadratic time it would take 20 minutes
    assert [cells[:3] for _, cells in rows] == [tuple("123"), tuple("456"), tuple("789")]


def test_a_line_of_one_separator_has_no_cells(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("|\n1|2|3|\n4|5|6|\n7|8|9|\n|\n")
    table = read_table(tmp_path, "a.txt")
    assert [cells for _, cells in table.rows if len(cells) == 3][-1] == ("7", "8", "9")
