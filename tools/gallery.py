"""Writes the tables of recipes/README.md and docs/reference/configurations.md from the recipes: python -m tools.gallery"""

import re
from pathlib import Path

from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.find import recipe_names
from flangeye.workflow.recipe.load import load_recipe
from tools.outcomes import outcomes

ROOT = Path(__file__).parents[1]
README = ROOT / "recipes" / "README.md"
TABLES = ROOT / "docs" / "reference" / "configurations.md"
TABLE = re.compile(r"(<!-- begin gallery -->\n).*?(<!-- end -->)", re.S)
GRID = re.compile(r"(<!-- begin configurations -->\n).*?(<!-- end -->)", re.S)

CONFIGURATIONS = {
    "eye-on-base": "eye-on-base",
    "eye-in-hand": "eye-in-hand",
    "eye-on-arm-1": "eye-on-arm, case 1",
    "eye-on-arm-2": "eye-on-arm, case 2",
    "two-arms": "two arms",
    "four-axes": "four axes, eye-in-hand",
    "two-scanners": "two fixed scanners and one arm",
    "two-arms-three-scanners": "two arms with a scanner each and one between",
    "arm-on-rail": "an arm on a rail",
    "hand-and-wall": "a scanner in the hand, one on the wall",
    "forearm-and-wall": "a scanner on the forearm, one on the wall",
}
"""Recipes of recipes/configurations, by the first word of their name."""

INPUTS = {
    "acquire.simulated": "simulated cell",
    "acquire.simulated_cell": "simulated marker",
    "acquire.simulated_cell_scans": "simulated scans",
    "acquire.simulated_session": "simulated scans",
    "acquire.simulated_marker": "simulated marker",
    "acquire.simulated_images": "simulated images",
    "acquire.simulated_profiles": "simulated profiles",
    "acquire.archive": "recorded clouds",
    "acquire.centres": "published centres",
    "acquire.live": "live, on loopback",
}


def gallery() -> str:
    """Return one row for each recipe outside recipes/paper, which has a page of its own."""
    rows = [
        "| recipe | robot | scanner | input | solver | what it shows |",
        "|---|---|---|---|---|---|",
    ]
    registry = load_registry()
    for name, path in recipe_names().items():
        if not name.startswith("paper/"):
            rows.append(_row(name, load_recipe(path, registry)))
    return "\n".join(rows) + "\n"


def _row(name, recipe):
    header, steps = recipe.header, [step.stage.name for step in recipe.steps]
    solver = " + ".join(s for s in steps if s.startswith(("solve.", "refine.")))
    cells = [
        f"[{name}]({name}.yaml)",
        (header.robot.model or header.robot.urdf) if header.robot else _arms(header.cell),
        header.scanner.model if header.scanner else "",
        INPUTS[steps[0]],
        solver,
        header.title,
    ]
    return "| " + " | ".join(cells) + " |"


def _arms(cell) -> str:
    return " and ".join(arm.model for arm in cell.arms.values())


def configurations() -> str:
    """Return one row for each recipe of a configuration, with the errors it came to."""
    rows = [
        "| camera | target | solver | held-out [mm] | true [mm] | recipe in `configurations/` |",
        "|---|---|---|---|---|---|",
    ]
    known = outcomes()
    order = [*CONFIGURATIONS]
    names = [n.partition("/")[2] for n in recipe_names() if n.startswith("configurations/")]
    for name in sorted(names, key=lambda n: (order.index(n.split("_")[0]), n)):
        mounting, target, how, *_ = name.split("_")
        found = known[f"configurations/{name}"]
        errors = f"{found['held_out_mm']} | {found['true_mm']}"
        cells = [CONFIGURATIONS[mounting], target.replace("-", " "), how.replace("-", " ")]
        rows.append(f"| {' | '.join(cells)} | {errors} | `{name}` |")
    return "\n".join(rows) + "\n"


def renewed(text: str) -> str:
    """Return the page with its tables made again."""
    text = TABLE.sub(lambda m: m[1] + gallery() + m[2], text)
    return GRID.sub(lambda m: m[1] + configurations() + m[2], text)


if __name__ == "__main__":
    for page in (README, TABLES):
        page.write_text(renewed(page.read_text()))
