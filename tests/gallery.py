"""Writes the table of recipes/README.md from the recipes themselves: python -m tests.gallery"""

import re
from pathlib import Path

from flangeye.recipe import load_recipe, recipe_names
from flangeye.registry import load_registry

ROOT = Path(__file__).parents[1]
README = ROOT / "recipes" / "README.md"
TABLE = re.compile(r"(<!-- begin gallery -->\n).*?(<!-- end -->)", re.S)

INPUTS = {
    "acquire.simulated": "simulated cell",
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
        header.robot.model,
        header.scanner.model if header.scanner else "",
        INPUTS[steps[0]],
        solver,
        header.title,
    ]
    return "| " + " | ".join(cells) + " |"


def renewed(text: str) -> str:
    """Return the page with its table made again."""
    return TABLE.sub(lambda m: m[1] + gallery() + m[2], text)


if __name__ == "__main__":
    README.write_text(renewed(README.read_text()))
