"""Every mistake a recipe can hold, word for word."""

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from flangeye.errors import RecipeError
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import Flange
from flangeye.plugin.registry import Registry, load_registry
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye.workflow.recipe.schema import header_line, recipe_schema
from tests.conftest import TOY_RECIPE

STEPS = "title: T\nsteps:\n  - acquire.toy\n  - segment.toy\n  - fit.toy\n  - solve.toy\n"


def mistakes(text, registry, overrides=(), tmp_path=None):
    with pytest.raises(RecipeError) as error:
        if overrides:
            path = tmp_path / "r.yaml"
            path.write_text(text)
            load_recipe(path, registry, overrides)
        else:
            parse_recipe(text, "r.yaml", registry)
    return str(error.value).splitlines()


def test_a_good_recipe_resolves_to_itself(toy_registry: Registry) -> None:
    recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
    assert [step.label for step in recipe.steps] == [
        "0.acquire.toy", "1.segment.toy", "2.fit.toy", "3.solve.toy", "4.verify.toy",
    ]  # fmt: skip
    again = parse_recipe(recipe.resolved(), "toy", toy_registry)
    assert again.resolved() == recipe.resolved()
    assert yaml.safe_load(recipe.resolved())["steps"][2] == {"fit.toy": {"inlier": "0.3 mm"}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            STEPS.replace("fit.toy", "fit.toi"),
            ["r.yaml:5: steps.2: no stage 'fit.toi'; did you mean fit.toy?"],
        ),
        (
            STEPS.replace("- fit.toy", "- fit.toy: {inlir: 0.2 mm}"),
            ["r.yaml:5: steps.2.fit.toy.inlir: unknown key 'inlir'; did you mean 'inlier'? "
             "(allowed: inlier)"],
        ),
        (
            STEPS.replace("- fit.toy", "- fit.toy: {inlier: 0.2}"),
            ["r.yaml:5: steps.2.fit.toy.inlier: '0.2' has no unit: a length needs one "
             "(mm, m, um, for example '31.5 mm')"],
        ),
        (
            STEPS.replace("- fit.toy", "- fit.toy: {inlier: 2 deg}"),
            ["r.yaml:5: steps.2.fit.toy.inlier: '2 deg' is not a length, it has a unit of angle: a "
             "length needs mm, m, um, for example '31.5 mm'"],
        ),
        (
            STEPS.replace("- fit.toy", "- fit.toy: {inlier: 0 mm}"),
            ["r.yaml:5: steps.2.fit.toy.inlier: must be greater than 0 in SI units, not '0 mm'"],
        ),
        (
            STEPS.replace("- fit.toy", "- fit.toy: [1]"),
            ["r.yaml:5: steps.2.fit.toy: parameters are a mapping, for example {inlier: 0.2 mm}"],
        ),
        (
            STEPS.replace("- segment.toy", "- segment.toy: {a: 1}"),
            ["r.yaml:4: steps.1.segment.toy: segment.toy takes no parameters"],
        ),
        (
            STEPS.replace("- segment.toy", "- {segment.toy: , fit.toy: }"),
            ["r.yaml:4: steps.1: a step is a stage's name, or one mapping {name: parameters}"],
        ),
        (
            STEPS.replace("  - solve.toy\n", ""),
            ["r.yaml:2: steps: no solve step, so there is no calibration; add one after the fit: "
             "solve.svd"],
        ),
        (
            STEPS + "  - weld.toy\n",
            ["r.yaml:7: steps.4.weld.toy: needs a VerifiedHandEye, which no earlier step gives; "
             "put a verify step before it",
             "r.yaml:7: steps.4.weld.toy: needs a Seam, which no earlier step gives; put a seam "
             "step before it"],
        ),
        (
            STEPS + "  - weld.unknown\n",
            ["r.yaml:7: steps.4: no stage 'weld.unknown'; did you mean weld.toy?",
             "r.yaml:7: steps.4.weld.unknown: needs a VerifiedHandEye, which no earlier step "
             "gives; put a verify step before it"],
        ),
        (
            STEPS + "  - fit.toy\n",
            ["r.yaml:7: steps.4.fit.toy: a recipe has one fit step, and this is the second"],
        ),
        (
            "title: T\nsteps: [segment.toy, acquire.toy, fit.toy, solve.toy]",
            ["r.yaml:2: steps.0.segment.toy: needs a Capture, which no earlier step gives; put an "
             "acquire step before it",
             "r.yaml:2: steps.1.acquire.toy: an acquire step cannot come after a segment step"],
        ),
        (
            STEPS.replace("- solve.toy", "- solve.toy: {cost: {scald: {}}}"),
            ["r.yaml:6: steps.3.solve.toy.cost: no part 'cost.scald'; did you mean cost.scaled?"],
        ),
        (
            STEPS.replace("- solve.toy", "- solve.toy:\n      cost:\n        scaled:\n          radius: 5"),
            ["r.yaml:9: steps.3.solve.toy.cost.scaled.radius: '5' has no unit: a length needs one "
             "(mm, m, um, for example '31.5 mm')"],
        ),
        (
            STEPS.replace("- solve.toy", "- solve.toy: {cost: 3}"),
            ["r.yaml:6: steps.3.solve.toy.cost: choose one cost by name, for example {name: {}}, "
             "not '3'"],
        ),
        ("- a", ["r.yaml:1: a recipe is a mapping with 'title' and 'steps'"]),
        ("", ["r.yaml:1: a recipe is a mapping with 'title' and 'steps'"]),
        (
            "title: T",
            ["r.yaml:1: steps: is missing"],
        ),
        (
            STEPS.replace("title: T", "titel: T"),
            ["r.yaml:1: title: is missing",
             "r.yaml:1: titel: unknown key 'titel'; did you mean 'title'? (allowed: title, "
             "description, robot, second_robot, scanner, configuration, cell, feature, target, "
             "workspace, seed, log, steps)"],
        ),
        (
            "robot: {model: ur55}\n" + STEPS,
            ["r.yaml:1: robot.model: no robot 'ur55'; known: ur5, ur5e, or a .yaml file"],
        ),
        (
            "robot: {model: ur5}\nfeature: {standard: ISO 9409-1-50-5-M6}\n" + STEPS,
            ["r.yaml:2: feature: no flange standard 'ISO 9409-1-50-5-M6'; known: "
             "ISO 9409-1-50-4-M6, ISO 9409-1-40-4-M6, ISO 9409-1-250-8-M12"],
        ),
        (
            STEPS.replace("title: T", "title: 12"),
            ["r.yaml:1: title: must be a text, not '12'; write it in quotes"],
        ),
        ("title: T\nsteps: []", ["r.yaml:2: steps: is empty; at least one entry is needed"]),
        (
            STEPS.replace("- solve.toy", "- 1: 2\n  - verify.toy"),
            ["r.yaml:6: steps.3: no stage '1'"],
        ),
        (
            STEPS.replace("- solve.toy", '- "solve.x\\nerror: y"'),
            [r"r.yaml:6: steps.3: no stage 'solve.x\nerror: y'; did you mean solve.toy?"],
        ),
        (
            "seed: -1\n" + STEPS,
            ["r.yaml:1: seed: must be greater than or equal to 0, not '-1'"],
        ),
    ],
)  # fmt: skip
def test_each_mistake_names_place_and_cure(
    text: Any, expected: list[Any], toy_registry: Registry
) -> None:
    assert mistakes(text, toy_registry) == expected


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("steps.2.inlier", "--set steps.2.inlier: write PATH=VALUE, for example "
         "steps.2.inlier='0.2 mm'"),
        ("steps.9.inlier=1", "--set steps.9.inlier: no step '9'; steps are 0 to 3"),
        ("steps.2.inlir=0.2 mm", "--set steps.2.fit.toy.inlir: unknown key 'inlir'; did you mean "
         "'inlier'? (allowed: inlier)"),
        ("steps.2.inlier=0.2", "--set steps.2.fit.toy.inlier: '0.2' has no unit: a length needs "
         "one (mm, m, um, for example '31.5 mm')"),
        ("steps.2=3", "--set steps.2: give a stage, for example steps.2=solve.svd, or a parameter "
         "of the step, for example steps.2.inlier='0.2 mm'"),
        ("fit.toi.inlier=1", "--set fit.toi.inlier: the recipe has no such step; its steps: "
         "acquire.toy, segment.toy, fit.toy, solve.toy"),
        ("fit.toy.inlir=1 mm", "--set steps.2.fit.toy.inlir: unknown key 'inlir'; did you mean "
         "'inlier'? (allowed: inlier)"),
        ("title.x=1", "--set title.x: 'title' holds a single value, nothing below it"),
        ("seed=!!int 3", "--set seed:1: tags (tag:yaml.org,2002:int) are not allowed; use plain "
         "values"),
    ],
)  # fmt: skip
def test_an_override_is_validated_like_the_file(
    override: str, expected: str, toy_registry: Registry, tmp_path: Path
) -> None:
    assert mistakes(STEPS, toy_registry, [override], tmp_path) == [expected]


@pytest.mark.parametrize("path", ["steps.2.inlier", "steps.2.fit.toy.inlier", "fit.toy.inlier"])
def test_an_override_changes_one_value(path: str, toy_registry: Registry, tmp_path: Path) -> None:
    file = tmp_path / "r.yaml"
    file.write_text(STEPS)
    recipe = load_recipe(file, toy_registry, [f"{path}=0.2 mm", "seed=7"])
    assert recipe.steps[2].params.inlier == 0.0002
    assert recipe.header.seed == 7


def test_a_recipe_that_is_no_file_is_named_as_what_it_is(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    for name, told in (
        ("pipe.yaml", "is a device, a FIFO or a socket; a file is needed"),
        ("zero.yaml", "is a device, a FIFO or a socket; a file is needed"),
        ("loop.yaml", "cannot be read: Too many levels of symbolic links"),
    ):
        with pytest.raises(RecipeError) as refused:
            find_recipe(str(tmp_path / name))
        assert str(refused.value) == f"{tmp_path / name}: {told}"


def test_the_home_of_an_unknown_user_is_one_line() -> None:
    text = """title: T
robot: {model: ur5}
steps:
  - acquire.archive: {path: ~nobody-here/session}
  - segment.flange
  - fit.rim
  - solve.svd
"""
    assert mistakes(text, load_registry()) == [
        "r.yaml:4: steps.0.acquire.archive.path: ~ and a name is the home folder of a user of "
        "this machine, not '~nobody-here/session'"
    ]


def test_a_recipe_is_found_by_name_or_path(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"^no recipe 'zzz'; 'flangeye recipes' lists them$"):
        find_recipe("zzz")
    with pytest.raises(RecipeError, match=r"none.yaml: no such recipe file; .* holds no recipe"):
        find_recipe(str(tmp_path / "none.yaml"))
    with pytest.raises(RecipeError, match=r"is a folder; write a recipe for it: flangeye init /"):
        find_recipe(str(tmp_path))
    (tmp_path / "my_cell.yaml").write_text("title: T")
    with pytest.raises(RecipeError, match=r"did you mean .*/my_cell.yaml\?$"):
        find_recipe(str(tmp_path / "my_cel.yaml"))
    with pytest.raises(RecipeError, match=r"there is no folder nowhere$"):
        find_recipe("nowhere/my_cell.yaml")
    with pytest.raises(RecipeError, match=r"did you mean ur5_phoxi-m_sample\?$"):
        find_recipe("ur5_phoxi-m_sampel.yaml")


def test_the_schema_knows_every_stage_and_unit(toy_registry: Registry) -> None:
    schema = recipe_schema(toy_registry)
    text = json.dumps(schema)
    for name in toy_registry.stages:
        assert f'"{name}"' in text
    assert schema["$comment"] == "# yaml-language-server: $schema=recipe.schema.json"
    assert header_line(None) == schema["$comment"]
    assert '"x-flangeye-quantity": "length"' in text
    assert '"scaled"' in text  # parts are offered where they are chosen


def test_a_step_is_exchanged_for_another_stage(toy_registry: Registry, tmp_path: Path) -> None:
    file = tmp_path / "r.yaml"
    file.write_text(STEPS.replace("- fit.toy", "- fit.toy: {inlier: 0.5 mm}"))
    plain = load_recipe(file, toy_registry, ["steps.2=fit.toy", "steps.3={solve.toy: {}}"])
    assert plain.steps[2].params.inlier == 0.0005  # the same stage keeps its parameters
    with pytest.raises(RecipeError, match=r"^--set steps.3: no stage 'solve.svt'"):
        load_recipe(file, toy_registry, ["steps.3=solve.svt"])


HEADER = """\
title: T
robot: {model: ur55, drivr: none, limits: {box: {centre: [1, 0 m, 0 m], sise: 3}, speed: 5}}
scanner: {name: ACME, range: [900 mm, 300 mm]}
feature: {standard: ISO 1}
workspce: {}
seed: x
steps:
  - acquire.toy: {cuont: 3, noise: 3}
  - segment.toi
  - fit.toy
  - solve.toy
"""


def test_every_mistake_at_once_and_nothing_that_follows_from_one(toy_registry: Registry) -> None:
    told = mistakes(HEADER, toy_registry)
    assert [line.split(": ")[1] for line in told] == [
        "robot.limits.box.centre.0", "robot.limits.box.size", "robot.limits.box.sise",
        "robot.limits.speed", "robot.drivr", "scanner", "seed", "workspce", "robot.model",
        "feature", "steps.0.acquire.toy.noise", "steps.0.acquire.toy.cuont", "steps.1",
    ]  # fmt: skip
    assert not any("section" in line or "LimitsSection" in line for line in told)


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        ("ur5", []),
        ("{model: ur5}", []),
        ("{flange: ISO 9409-1-50-4-M6}", []),
        ("{flange: ISO 9409-1-50-5-M6}", ["r.yaml:1: feature: no flange standard "
         "'ISO 9409-1-50-5-M6'; known: ISO 9409-1-50-4-M6, ISO 9409-1-40-4-M6, "
         "ISO 9409-1-250-8-M12"]),
        ("ur55", ["r.yaml:1: robot.model: no robot 'ur55'; known: ur5, ur5e, or a .yaml file"]),
        ("{}", ["r.yaml:1: robot: name the arm: model: ur10e ('flangeye robots' lists them), "
                "urdf: arm.urdf, or, where the flange's poses are recorded, its plate alone: "
                "flange: ISO 9409-1-50-4-M6"]),
    ],
)  # fmt: skip
def test_an_arm_is_a_word_a_model_or_its_plate_alone(
    robot: str, expected: list[Any], toy_registry: Registry
) -> None:
    text = f"robot: {robot}\n" + STEPS
    if expected:
        assert mistakes(text, toy_registry) == expected
    else:
        context = parse_recipe(text, "r.yaml", toy_registry).context
        assert context[Flange].name == "ISO 9409-1-50-4-M6"
        assert (RobotModel in context) == ("flange" not in robot)


def test_a_plate_named_beside_a_model_replaces_the_models_own(toy_registry: Registry) -> None:
    text = "robot: {model: ur5, flange: ISO 9409-1-80-6-M8}\n" + STEPS
    context = parse_recipe(text, "r.yaml", toy_registry).context
    assert context[Flange].name == "ISO 9409-1-80-6-M8"
    assert context[Flange].details == context[RobotModel].flange


@pytest.mark.parametrize(
    ("scanner", "range_", "whole"),
    [("phoxi-m", (0.458, 1.118), True), ("{name: ACME, range: [300 mm, 1 m]}", (0.3, 1.0), False),
     ("{name: ACME}", (0.1, 10.0), False)],
)  # fmt: skip
def test_a_scanner_is_a_word_or_a_name_and_a_range(
    scanner: str, range_: tuple[Any, ...], whole: bool, toy_registry: Registry
) -> None:
    context = parse_recipe(f"scanner: {scanner}\n" + STEPS, "r.yaml", toy_registry).context
    assert context[ScannerData].range == range_
    assert (ScannerModel in context) == whole


ARCHIVE = """\
title: T
steps:
  - acquire.archive
  - segment.flange
  - fit.rim
  - solve.robust
"""


def test_what_is_demanded_is_what_is_used() -> None:
    """An archive's poses need no kinematics; its flange needs a plate, a marker needs none."""
    registry = load_registry()
    assert mistakes(ARCHIVE, registry) == [
        *(f"r.yaml:{line}: steps.{line - 3}.{name}: needs the plate to look for: write feature: "
          "{standard: ISO 9409-1-50-4-M6} ('flangeye standards' lists them), or a robot's model"
          for line, name in ((4, "segment.flange"), (5, "fit.rim"))),
    ]  # fmt: skip
    plain = "robot: {flange: ISO 9409-1-50-4-M6}\n" + ARCHIVE
    parse_recipe(plain, "r.yaml", registry)
    marker = "  - acquire.images: {focal_length: [900, 900], principal_point: [640, 480]}\n"
    board = "  - fit.checkerboard: {columns: 8, rows: 5, square: 30 mm}\n"
    seen = "configuration: {name: eye-in-hand, place: unknown}\ntitle: T\nsteps:\n"
    parse_recipe(seen + marker + board + "  - solve.robust\n", "r.yaml", registry)


def test_live_and_simulated_runs_say_what_kinematics_are_for() -> None:
    registry = load_registry()
    live = "robot: {flange: ISO 9409-1-50-4-M6}\nscanner: {name: ACME}\n" + ARCHIVE.replace(
        "acquire.archive", "acquire.simulated"
    )
    told = mistakes(live, registry)
    assert told == [
        "r.yaml:5: steps.0.acquire.simulated: needs the arm's kinematics, to simulate it: write "
        "robot: ur10e ('flangeye robots' lists them), or robot: {urdf: arm.urdf}",
        "r.yaml:5: steps.0.acquire.simulated: needs the scanner's field of view and noise: write "
        "scanner: phoxi-m ('flangeye scanners' lists them, 'flangeye new-scanner' writes one)",
    ]


DRIVEN = """\
title: T
robot: {{model: {model}, driver: {{manual: {{convention: kuka}}}}, limits: {limits}}}
steps: [segment.flange]
"""
SOUND = "{centre: [450 mm, 0 mm, 500 mm], size: [1 m, 1 m, 900 mm]}"


@pytest.mark.parametrize(
    ("model", "limits", "expected"),
    [
        ("ur10e", f"{{box: {SOUND}, joint_speed: 120 deg/s}}", []),
        (
            "ur10e",
            f"{{box: {SOUND}, joint_speed: 121 deg/s}}",
            ["robot.limits.joint_speed: at most 120 deg/s for a ur10e, not 121 deg/s"],
        ),
        (
            "ur5e",
            f"{{box: {SOUND}, joint_speed: 3000 deg/s}}",
            ["robot.limits.joint_speed: at most 180 deg/s for a ur5e, not 3000 deg/s"],
        ),
        (
            "ur5e",
            "{box: {centre: [9 m, 0 m, 0 m], size: [1 m, 1 m, 1 m]}}",
            [
                "robot.limits.box: is not a box for a ur5e, which reaches 1.31 m from its base: each "
                "side is at most 5.25 m, and some of it is within reach"
            ],
        ),
        (
            "ur5e",
            "{box: {centre: [0 m, 0 m, 0 m], size: [1e300 m, 1 m, 1 m]}}",
            [
                "robot.limits.box: is not a box for a ur5e, which reaches 1.31 m from its base: each "
                "side is at most 5.25 m, and some of it is within reach"
            ],
        ),
        (
            "ur5e",
            "{box: {centre: [0 m, 0 m, 0 m], size: [-1 m, 0 m, 1 m]}}",
            [
                "robot.limits.box.size.0: must be greater than 0 in SI units, not '-1 m'",
                "robot.limits.box.size.1: must be greater than 0 in SI units, not '0 m'",
            ],
        ),
    ],
)
def test_limits_are_held_against_the_arms_own_data(
    model: str, limits: str, expected: list[Any]
) -> None:
    told = mistakes(DRIVEN.format(model=model, limits=limits), load_registry())
    assert [line.partition(": ")[2] for line in told if "robot.limits" in line] == expected


@pytest.mark.parametrize("each", ["k{}: 1\n", "k{}: {{a: {{b: 1}}}}\n"])
def test_ten_times_as_many_mistakes_take_ten_times_as_long(
    each: str, toy_registry: Registry
) -> None:
    def taken(count: int) -> float:
        text = STEPS + "".join(each.format(i) for i in range(count))
        begun = time.process_time()
        assert len(mistakes(text, toy_registry)) == count
        return time.process_time() - begun

    # The least of three: a collection of garbage falls into one of them
    few, many = (min(taken(count) for _ in range(3)) for count in (800, 8000))
    assert many < 25 * few
