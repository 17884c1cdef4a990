"""Every mistake a recipe can hold, word for word."""

import json

import pytest
import yaml

from flangeye.errors import RecipeError
from flangeye.recipe import find_recipe, load_recipe, parse_recipe
from flangeye.schema import header_line, recipe_schema
from flangeye.units import Length
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


def test_a_good_recipe_resolves_to_itself(toy_registry):
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
            ["r.yaml:5: steps.2.fit.toy.inlier: '2 deg' is no length, it has a unit of angle: a "
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
            ["r.yaml:4: steps.1: a step is a stage's name, or one mapping {name: parameters}",
             "r.yaml:5: steps.2.fit.toy: needs a FlangeCloud, which no earlier step gives; put a "
             "segment step before it"],
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
             "description, robot, second_robot, scanner, configuration, feature, workspace, seed, "
             "log, steps)"],
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
            "seed: -1\n" + STEPS,
            ["r.yaml:1: seed: must be greater than or equal to 0, not '-1'"],
        ),
    ],
)  # fmt: skip
def test_each_mistake_names_place_and_cure(text, expected, toy_registry):
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
        ("steps.2=fit.toy", "--set steps.2: name a parameter of the step, for example "
         "steps.2.inlier"),
        ("title.x=1", "--set title.x: 'title' holds a single value, nothing below it"),
        ("seed=!!int 3", "--set seed:1: tags (tag:yaml.org,2002:int) are not allowed; use plain "
         "values"),
    ],
)  # fmt: skip
def test_an_override_is_validated_like_the_file(override, expected, toy_registry, tmp_path):
    assert mistakes(STEPS, toy_registry, [override], tmp_path) == [expected]


@pytest.mark.parametrize("path", ["steps.2.inlier", "steps.2.fit.toy.inlier"])
def test_an_override_changes_one_value(path, toy_registry, tmp_path):
    file = tmp_path / "r.yaml"
    file.write_text(STEPS)
    recipe = load_recipe(file, toy_registry, [f"{path}=0.2 mm", "seed=7"])
    assert recipe.steps[2].params.inlier == 0.0002
    assert recipe.header.seed == 7


def test_a_recipe_is_found_by_name_or_path(tmp_path):
    with pytest.raises(RecipeError, match=r"^no recipe 'zzz'; 'flangeye recipes' lists them$"):
        find_recipe("zzz")
    with pytest.raises(RecipeError, match=r"none.yaml: no such recipe file$"):
        find_recipe(str(tmp_path / "none.yaml"))


def test_the_schema_knows_every_stage_and_unit(toy_registry):
    schema = recipe_schema(toy_registry)
    text = json.dumps(schema)
    for name in toy_registry.stages:
        assert f'"{name}"' in text
    assert schema["$comment"] == "# yaml-language-server: $schema=recipe.schema.json"
    assert header_line(None) == schema["$comment"]
    assert '"x-flangeye-quantity": "length"' in text
    assert '"scaled"' in text  # parts are offered where they are chosen
    assert Length
