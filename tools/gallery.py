"""Writes the tables of recipes/README.md and README.md from the recipes: python -m tools.gallery"""

import re
from pathlib import Path

from flangeye.plugin.registry import load_registry
from flangeye.recipe.find import recipe_names
from flangeye.recipe.load import load_recipe
from tools.outcomes import outcomes

ROOT = Path(__file__).parents[1]
README = ROOT / "recipes" / "README.md"
FRONT = ROOT / "README.md"
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
        header.robot.model if header.robot else _arms(header.cell),
        header.scanner.model if header.scanner else "",
        INPUTS[steps[0]],
        solver,
        header.title,
    ]
    return "| " + " | ".join(cells) + " |"


def _arms(cell) -> str:
    return " and ".join(arm.model for arm in cell.arms.values())


def configurations() -> str:
    """Return one row for each configuration: marker or not, closed form or maximum likelihood."""
    rows = [
        "| configuration | marker: closed form | marker: maximum likelihood "
        "| no marker: closed form | no marker: maximum likelihood |",
        "|---|---|---|---|---|",
    ]
    for key, words in CONFIGURATIONS.items():
        cells = [
            ", ".join(_links(key, marker, how)) or "—"
            for marker in (True, False)
            for how in ("closed-form", "most-likely")
        ]
        rows.append(f"| {words} | " + " | ".join(cells) + " |")
    return "\n".join(rows) + "\n"


def _links(key: str, marker: bool, how: str) -> list[str]:
    found, known = [], outcomes()
    for name in recipe_names():
        folder, _, rest = name.partition("/")
        words = rest.split("_")
        if folder != "configurations" or words[0] != key or words[2] != how:
            continue
        if words[1].startswith("marker") is marker:
            row = known[name]
            error = f"{row['held_out_mm']} ({row['true_mm']})"
            found.append(f"[{words[1]}](recipes/{name}.yaml) {error}")
    return found


def renewed(text: str) -> str:
    """Return the page with its tables made again."""
    text = TABLE.sub(lambda m: m[1] + gallery() + m[2], text)
    return GRID.sub(lambda m: m[1] + configurations() + m[2], text)


if __name__ == "__main__":
    for page in (README, FRONT):
        page.write_text(renewed(page.read_text()))
