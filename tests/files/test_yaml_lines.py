from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.errors import RecipeError
from flangeye.files.yaml_lines import flow, parse_yaml, read_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3), ("on", "on"), ("yes", "yes"), ("No", "No"), ("012", 12), ("true", True),
        ("False", False), ("~", None), ("0x10", "0x10"), ("1_000", "1_000"), ("12:30", "12:30"),
        ("'1'", "1"), ("2026-11-21", "2026-11-21"), (".5", 0.5), ("-3", -3), ("", None),
    ],
)  # fmt: skip
def test_scalars_mean_what_they_look_like(text: str, value: Any) -> None:
    read = parse_yaml(f"a: {text}", "x").data["a"]
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "x:3: duplicate key 'a', first given on line 1"),
        ("a: &k [1]\nb: *k", "x:1: anchors and aliases (& and *) are not allowed; write it out"),
        ("a: !!python/name:os.system", "x:1: tags (tag:yaml.org,2002:python/name:os.system) are not"
         " allowed; use plain values"),
        ("a: !x 1", "x:1: tags (!x) are not allowed; use plain values"),
        ("[" * 30, "x:1: nested deeper than 20 levels"),
        ("? [1, 2]\n: 3", "x:1: a key must be plain text"),
        ("a: [1, 2\nb: 3", "x:2: not valid YAML: expected ',' or ']', but got ':'"),
        ("a: 1\n b: 2", "x:2: not valid YAML: mapping values are not allowed here"),
        ("a: 1\n---\nb: 2", "x:2: not valid YAML: but found another document"),
        ("a: \x00", "x: not valid YAML: unacceptable character #x0000: special characters are not allowed"),
        ('a: 1\nb: "\\uD800"', "x:2: is not UTF-8 text"),
        ('a: 1\n"\\uDFFF": 1', "x:2: is not UTF-8 text"),
        ("a: \udcff", "x: is not UTF-8 text"),
    ],
)  # fmt: skip
def test_what_is_refused_names_the_line(text: Any, message: str) -> None:
    with pytest.raises(RecipeError) as error:
        parse_yaml(text, "x")
    assert str(error.value) == message


def test_lines_are_those_of_the_file() -> None:
    document = parse_yaml("a: 1\nsteps:\n  - fit.rim:\n      inlier: 3\n", "x")
    assert document.line(("steps", 0, "fit.rim", "inlier")) == 4
    assert document.line(("steps", 0, "fit.rim", "unknown")) == 3


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"none.yaml: cannot be read: No such file or directory"):
        read_yaml(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xff")
    with pytest.raises(RecipeError, match=r"latin.yaml: is not UTF-8 text"):
        read_yaml(tmp_path / "latin.yaml")
    (tmp_path / "big.yaml").write_bytes(b"#" * 1_000_001)
    with pytest.raises(RecipeError, match=r"big.yaml: is larger than 1000000 bytes"):
        read_yaml(tmp_path / "big.yaml")


@given(st.text(st.characters(), max_size=200))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        parse_yaml(text, "x")
    except RecipeError as error:
        assert str(error).startswith("x")


def test_a_text_of_very_many_digits_is_read_in_one_pass() -> None:
    text = "1" * 400_000 + "x"  # steps that grow with the square would take a day
    assert parse_yaml(f"a: {text}", "x").data == {"a": text}


@given(st.text("0189.e+-~nulr", max_size=5))
def test_a_text_is_written_so_that_it_is_read_as_text(text: str) -> None:
    assert parse_yaml(f"path: {flow(text)}", "x").data == {"path": text}


@pytest.mark.parametrize("name", ["08", "1e3", "0019", "9" * 30])
def test_a_folder_that_is_called_by_a_number_stays_text(name: str) -> None:
    assert parse_yaml(f"path: {flow(name)}", "x").data == {"path": name}
