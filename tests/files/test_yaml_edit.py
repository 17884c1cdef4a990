"""A recipe that is edited by a program keeps what the person wrote."""

from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.files.yaml_lines import edited, parse_yaml

RECIPE = """\
# my cell, measured on Monday
title: Cell   # of line 3
robot:
  model: ur5e
  # the tool is off
  limits: {box: {centre: [0 m, 0 m, 1 m], size: [1 m, 1 m, 1 m]}}

steps:
  - acquire.simulated: {seed: 1, poses: 12}   # enough
  # the flange
  - segment.flange
  - fit.rim:
      inlier: 0.2 mm  # tight
      seed: 3
  - verify.holdout
"""


def change(*path: Any, to: Any) -> dict[str, Any]:
    """Return the recipe's data with one value changed; None takes it out."""
    data = parse_yaml(RECIPE, "r").data
    node = data
    for key in path[:-1]:
        node = node[key]
    if to is None:
        del node[path[-1]]
    elif isinstance(node, list) and path[-1] == len(node):
        node.append(to)
    else:
        node[path[-1]] = to
    return data


@pytest.mark.parametrize(
    ("path", "to", "line", "instead"),
    [
        (("title",), "Other: cell", "title: Cell   # of line 3",
         "title: 'Other: cell'   # of line 3"),
        (("steps", 0, "acquire.simulated", "seed"), 2,
         "{seed: 1, poses: 12}", "{seed: 2, poses: 12}"),
        (("steps", 0, "acquire.simulated", "new"), "1 mm",
         "{seed: 1, poses: 12}", "{seed: 1, poses: 12, new: 1 mm}"),
        (("steps", 1), {"segment.flange": {"size": "1 m"}},
         "- segment.flange\n", "- segment.flange: {size: 1 m}\n"),
        (("steps", 2, "fit.rim", "inlier"), "0.3 mm", "0.2 mm  # tight", "0.3 mm  # tight"),
        (("steps", 2, "fit.rim", "seed"), None, "      seed: 3\n", ""),
        (("steps", 2, "fit.rim", "deep"), {"a": 1},
         "      seed: 3\n", "      seed: 3\n      deep: {a: 1}\n"),
        (("steps", 3), None, "  - verify.holdout\n", ""),
        (("steps", 1), None, "  - segment.flange\n", ""),
        (("steps", 4), "verify.drift",
         "  - verify.holdout\n", "  - verify.holdout\n  - verify.drift\n"),
        (("robot", "model"), "ur10", "model: ur5e", "model: ur10"),
        (("robot",), "ur10", "robot:\n  model: ur5e\n  # the tool is off\n  limits: {box: {centre:"
         " [0 m, 0 m, 1 m], size: [1 m, 1 m, 1 m]}}", "robot:\n  ur10"),
        (("robot", "base"), True, "1 m, 1 m]}}\n", "1 m, 1 m]}}\n  base: true\n"),
    ],
)  # fmt: skip
def test_only_what_differs_is_written(path: Any, to: Any, line: str, instead: str) -> None:
    assert line in RECIPE
    data = change(*path, to=to)
    assert edited(RECIPE, data) == RECIPE.replace(line, instead, 1)


def test_a_new_section_stands_where_the_data_have_it() -> None:
    data = parse_yaml(RECIPE, "r").data
    steps = data.pop("steps")
    found = edited(RECIPE, {**data, "scanner": {"model": "phoxi-m"}, "steps": steps})
    assert found == RECIPE.replace("steps:\n", "scanner: {model: phoxi-m}\nsteps:\n")


VALUES = st.recursive(
    st.integers(0, 99) | st.sampled_from(["a", "on", "1 mm", "x: y", "# no", "two\nlines", ""]),
    lambda inside: (
        st.lists(inside, max_size=3) | st.dictionaries(st.sampled_from("abcd"), inside, max_size=3)
    ),
    max_leaves=8,
)
MAPPINGS = st.dictionaries(st.sampled_from("abcd"), VALUES, min_size=1, max_size=4)


@settings(max_examples=60)
@given(MAPPINGS, MAPPINGS, st.sampled_from([None, True, False]))
def test_any_change_reads_back(old: Any, new: Any, style: bool | None) -> None:
    text = yaml.safe_dump(old, sort_keys=False, default_flow_style=style)
    assert parse_yaml(edited(text, new), "r").data == new
