"""Makes data/samples/ur5_phoxi-m with the simulator: python -m tools.sample"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from flangeye.files.recording import OF_A_SIMULATOR
from flangeye.plugin.registry import load_registry
from flangeye.types import CAMERA, Capture, FlangeCloud, PointCloud
from flangeye.workflow.recipe.load import parse_recipe
from tools.folder_archive import write_folder

FOLDER = Path(__file__).parents[1] / "data" / "samples" / "ur5_phoxi-m"
REACH = 0.07
"""Half the size of what is kept of a scan, about the flange: the files stay small [m]."""

RECIPE = """\
title: The sample
robot: {model: ur5}
scanner: {model: phoxi-m}
seed: 11
steps:
  - acquire.simulated: {resolution: 0.35, verification: 0, poses: {grid: {counts: [3, 2, 2]}}}
  - segment.flange
  - fit.rim
  - solve.svd
"""


def captures(count: int = 8) -> Iterator[Capture]:
    """Yield the first captures of the cell in which the flange is found, cut out around it."""
    recipe = parse_recipe(RECIPE, "sample", load_registry())
    acquire, segment = recipe.steps[:2]
    context = recipe.context
    asked = {name: context.get(need) for name, need in acquire.stage.needs.items()}
    for capture in acquire.stage(**asked, params=acquire.params):
        given = {n: context[need] for n, need in segment.stage.needs.items() if need in context}
        found = segment.stage(capture, **given, params=segment.params)
        if isinstance(found, FlangeCloud) and count > 0:
            count -= 1
            points = capture.cloud.points()
            near = np.abs(points - found.centre).max(axis=1) < REACH
            yield replace(capture, cloud=PointCloud(CAMERA, points[near]))


if __name__ == "__main__":
    for old in FOLDER.glob("*"):
        old.unlink()
    write_folder(FOLDER, captures())
    (FOLDER / OF_A_SIMULATOR).write_text("Made by a simulator: python -m tools.sample\n")
