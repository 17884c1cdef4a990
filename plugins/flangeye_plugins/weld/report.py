"""Builds the report of a weld from its log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from flangeye.motion.seam_following import Controller, turned
from flangeye.types import Floats, Note, Seam, WeldReport
from flangeye.types.geometry import rows_at
from flangeye_plugins.weld.frame import LeaningTool, WorkSurface
from flangeye_plugins.weld.passes import follower_of
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.weld_log import WeldLog, columns

SAMPLES = 2000
"""Largest number of cycles in the report."""


def report_of(  # noqa: PLR0913  all that a weld had
    seam: Seam,
    surface: WorkSurface,
    body: LeaningTool,
    controller: Controller,
    weld_log: WeldLog,
    reason: str,
    truth: tuple[Floats, Floats] | None = None,
) -> WeldReport:
    """Return the report of a weld; ``truth`` is a simulation's true torch: times, positions."""
    plan, to_base = surface.path, surface.to_base
    reason = reason and f"{reason}; {_extent(controller, plan)}"
    every = columns(weld_log.cycles)
    kept = np.unique(np.linspace(0, len(weld_log.cycles) - 1, SAMPLES).round().astype(int))
    kept = kept[: len(weld_log.cycles)]  # none where there was no cycle
    cycle = {name: np.array(every[name])[kept] for name in ("time", "angle", "velocity", "turn")}
    robot = np.array(every["position"]).reshape(-1, 3)[kept]
    at_tip, at_torch = (np.array(every[name])[kept] for name in ("tip", "torch"))
    tip, deflection = _tip_displacements(weld_log, plan, body, kept)
    torch = robot + np.array([turned(body.torch, angle) for angle in cycle["angle"]]).reshape(-1, 3)
    velocity = cycle["velocity"].reshape(-1, 3)
    return WeldReport(
        mode=controller.mode,
        completed=not reason,
        reason=reason,
        planned=seam.points_in_base,
        refined=to_base(*_refined(controller, plan)),
        openings=seam.openings_in_base,
        time=cycle["time"] - cycle["time"][0] if len(kept) else np.zeros(0),
        tip=to_base(tip, at_tip),
        torch=to_base(torch, at_torch),
        robot=to_base(robot, at_tip),
        deflection=controller.side * deflection,
        wanted=np.array(every["wanted"])[kept],
        speed=np.linalg.norm(velocity[:, :2], axis=1),
        turn=cycle["turn"],
        along=at_torch,
        phases=tuple(every["phase"][i] for i in kept),
        figures={**_figures(weld_log), **learned_figures(controller)},
        sigma=_stated(np.array(every["sigma"])[kept]),
        bound=_stated(np.array(every["bound"])[kept]),
        band=_stated(np.array(every["band"])[kept]),
        true_torch=np.zeros((0, 3)) if truth is None else rows_at(cycle["time"], *truth),
        loop=_loop(weld_log),
        notes=_advice(controller),
    )


def _advice(controller: Controller) -> tuple[Note, ...]:
    """Return a note that recommends a profile sensor if it could reduce most of the variance."""
    root = follower_of(controller)
    # Below half of the variance the sensor would hardly improve the bound.
    if root is None or root.arc_from is None:
        return ()
    fixed = root.welding.share_fixed
    if root.welding.bias.looked or fixed < 0.5:
        return ()
    return (
        f"{fixed:.0%} of the torch's variance comes from the files' tolerances: "
        "only a profile sensor behind the torch ('profiler') can reduce it",
    )


def _extent(controller: Controller, plan: Path) -> str:
    """Return a text that says which part of the seam was welded before the stop."""
    root = follower_of(controller)
    if root is None:
        return f"the torch had reached {controller.torch * 1e3:.0f} mm"
    if root.arc_from is None:
        return "nothing was welded"
    begin, end = max(root.arc_from, 0.0), min(root.torch, plan.length)
    return (
        f"{root.welding.share:.0%} of the seam was welded, from {begin * 1e3:.0f} to "
        f"{end * 1e3:.0f} of {plan.length * 1e3:.0f} mm"
    )


def _stated(deviations: Floats) -> Floats:
    """Return standard deviations (K,), or an empty array if any is not finite."""
    return deviations if np.isfinite(deviations).all() else np.zeros(0)


def learned_figures(controller: Controller) -> Mapping[str, float]:
    """Return the sweep's estimates by name, for the report."""
    root = follower_of(controller)
    if root is None:
        return {}
    found = root.sensing.learned
    return {
        "finger_gain_error": found.gain,
        "finger_play": 2.0 * abs(found.width),
        "timestamps_late": found.stamp,
        "arm_dead_time": found.dead_time,
        "arm_lag": found.lag,
        "arc_from": -1.0 if root.arc_from is None else root.arc_from,
        "share_welded": root.welding.share,
    }


def _tip_displacements(
    weld_log: WeldLog, plan: Path, body: LeaningTool, kept: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Return the tip's positions in the plane (K, 3) and its deflections (K,) [m].

    A measurement is combined with the pose at its own time, and held until the next one.
    """
    every = columns(weld_log.cycles)
    robot = np.array(every["position"]).reshape(-1, 3)
    felt = [weld_log.felt[number] for touches in every["touches"] for number in touches]
    used = np.cumsum([len(touches) for touches in every["touches"]], dtype=int)[kept]
    if not felt:
        return robot[kept], np.zeros(len(kept))
    times = np.array([feeling.time_ns for feeling in felt]) * 1e-9
    then = rows_at(times, np.array(every["time"]), robot)
    angle = np.interp(times, every["time"], every["angle"])
    level = np.array([feeling.displacement for feeling in felt]) @ body.level_R_tool.T
    moved = np.array([turned(d, a) for d, a in zip(level, angle, strict=True)])
    _, tangents = plan.evaluate(np.interp(times, every["time"], every["tip"]))
    across = tangents[:, 1] * moved[:, 0] - tangents[:, 0] * moved[:, 1]
    newest = np.maximum(used - 1, 0)
    tip = np.where((used > 0)[:, None], (then + moved)[newest], robot[kept])
    return tip, np.where(used > 0, across[newest], 0.0)


def _refined(controller: Controller, plan: Path) -> tuple[Floats, Floats]:
    """Return the estimated seam in the plane (M, 3) and its arc lengths (M,) [m]."""
    root = follower_of(controller)
    if root is None or root.seam.refined.empty:
        return np.zeros((0, 3)), np.zeros(0)
    s = np.arange(0.0, plan.length, 1e-3)
    points, tangents = plan.evaluate(s)
    offsets = np.array([root.seam.refined.offset(x) for x in s.tolist()])
    points[:, :2] += offsets[:, None] * np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    return points, s


def _figures(weld_log: WeldLog) -> Mapping[str, float]:
    felt = list(weld_log.felt.values())
    return {
        "images": float(weld_log.sights),
        "images_with_tag": float(len(felt)),
        "turn_max": max((abs(c.turn) for c in weld_log.cycles), default=0.0),
    }


def _loop(weld_log: WeldLog) -> Mapping[str, float]:
    """Return the loop's timing statistics, which differ between identical runs."""
    if not weld_log.cycles:
        return {}
    cycles = weld_log.cycles
    figures = {"cycles": float(len(cycles))}
    for name, counted in (("computing", cycles), ("answering", cycles), ("period", cycles[1:])):
        times = [getattr(cycle, name) for cycle in counted] or [0.0]
        figures[f"{name}_median"] = float(np.median(times))
        figures[f"{name}_p99"] = float(np.quantile(times, 0.99))
    return figures
