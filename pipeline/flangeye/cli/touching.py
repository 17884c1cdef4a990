"""``flangeye touch``: move the arm to scanned points and compare with the prediction."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from flangeye.devices import RobotDriver
from flangeye.errors import StageError
from flangeye.files.regular import write_whole
from flangeye.files.yaml_lines import dumped
from flangeye.models.robots import RobotModel
from flangeye.motion.touching import Toucher, TouchResult
from flangeye.plugin.registry import Registry
from flangeye.types import Floats, FrameMismatchError
from flangeye.types.geometry import rpy_from_rotation
from flangeye.units import parse_quantity
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.header import LimitsSection
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.run.folder import recipe_of_log


def touch_points(  # noqa: PLR0913  one for each option
    run: Path,
    registry: Registry,
    given: tuple[Sequence[str], str],
    move: bool,
    ask: Callable[[str], None],
    out: Path,
    overrides: Sequence[str] = (),
) -> Iterator[str]:
    """Yield a line for each point that was touched, and write the step ``verify.touch``.

    Args:
        run: The calibration's run.
        registry: The plugins.
        given: Points in the camera and the tip in the flange, as text with units.
        move: Whether the arm moves near each point.
        ask: Function that shows an instruction and returns when it is carried out.
        out: File for the step.
        overrides: Changes to the calibration's recipe: another address of the arm.

    Raises:
        StageError: There is no calibration, its recipe names no arm, or a point cannot be read.
    """
    seen, tip = np.array([_point("--seen", x) for x in given[0]]), _point("--tip", given[1])
    log = read_run(run)
    calibration = log.calibration()
    if calibration is None:
        raise StageError(f"{log.path}: holds no calibration; name a run that has one")
    try:
        predicted = calibration.base_T_camera.transform.apply(seen)
    except FrameMismatchError as error:
        raise StageError(f"{log.path}: {error}") from None
    recipe = recipe_of_log(log, registry, overrides)
    touched = []
    for each in _toucher(recipe, tip, ask).touch(predicted, move):
        touched.append(each)
        yield _touched_line(len(touched), each)
    write_whole(out, _step(seen, tip, touched))
    sizes = [float(np.linalg.norm(t.error)) for t in touched]
    step = f"{out}: the verify.touch step to paste into the recipe"
    yield f"largest error {1e3 * max(sizes):.2f} mm; {step}"


def _toucher(recipe: Recipe, tip: Floats, ask: Callable[[str], None]) -> Toucher:
    robot, driver = recipe.context.get(RobotModel), recipe.context.get(RobotDriver)
    section = recipe.context.get(LimitsSection)
    if robot is None or driver is None or section is None:
        raise StageError(
            f"{recipe.name}: its recipe names no robot.driver with robot.limits, so no arm can be "
            "read; touch with the calibration of a live recipe, or write the step verify.touch "
            "with poses from the pendant ('flangeye stages verify.touch')"
        )
    return Toucher(driver, robot, section.for_robot(robot), tip, ask)


def _point(option: str, text: str) -> Floats:
    parts = text.split(",")
    try:
        if len(parts) != 3:
            raise ValueError(f"has {len(parts)} coordinates, not 3")
        return np.array([parse_quantity(part.strip(), "length") for part in parts])
    except ValueError as error:
        raise StageError(f"{option} '{text}': {error}; write '12 mm, -40 mm, 702 mm'") from None


def _touched_line(number: int, touched: TouchResult) -> str:
    at = ", ".join(f"{1e3 * x:.2f}" for x in touched.actual)
    off = ", ".join(f"{1e3 * x:+.2f}" for x in touched.error)
    size = 1e3 * float(np.linalg.norm(touched.error))
    return (
        f"point {number}: touched at ({at}) mm in base; predicted is off by ({off}), {size:.2f} mm"
    )


def _step(seen: Floats, tip: Floats, touched: Sequence[TouchResult]) -> str:
    """Return the step ``verify.touch`` with the touched points, as a line of a recipe."""
    touches = [
        {
            "seen": _lengths(point),
            "position": _lengths(each.base_T_flange[:3, 3]),
            "rpy": [f"{x:.9f} rad" for x in rpy_from_rotation(each.base_T_flange[:3, :3])],
        }
        for point, each in zip(seen, touched, strict=True)
    ]
    step = {"verify.touch": {"tip": _lengths(tip), "touches": touches}}
    return dumped([step], default_flow_style=None, width=120)


def _lengths(point: Floats) -> list[str]:
    return [f"{1e3 * x:.4f} mm" for x in point]
