"""Pictures of the catalogue, to scale: ``python -m tools.sizes`` writes docs/images/*.svg."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names
from flangeye.models.targets import known_standards

IMAGES = Path("docs/images")


def main() -> None:
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "flangeye"
    IMAGES.mkdir(parents=True, exist_ok=True)
    _save("robots", _robots)
    _save("scanners", _scanners)
    _save("standards", _standards)


def _save(name, draw):
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5))
    draw(axes)
    figure.tight_layout()
    figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})
    pyplot.close(figure)


def _robots(axes):
    """Return a drawing of each arm with all joints at zero, from its longest side."""
    for i, name in enumerate(model_names("robots")):
        arm = Arm(load_model("robots", name))
        zero = np.zeros(arm.n)
        points = np.vstack([np.zeros(3), arm.axes(zero)[1], arm.flange(zero)[:3, 3]])
        side = int(np.ptp(points[:, 1]) > np.ptp(points[:, 0]))
        x, z = points[:, side], points[:, 2]
        column, row = i % 7, i // 7
        axes.plot(2.2 * column + x, -2.2 * row + z, "o-", markersize=2)
        axes.text(2.2 * column - 0.9, -2.2 * row - 0.45, name, fontsize=5)
    axes.set_aspect("equal")
    axes.set_title("arms with all joints at zero, to one scale; metres")


def _scanners(axes):
    """Return a drawing of each scanner's range with the width of its field of view."""
    for name in model_names("scanners"):
        scanner = load_model("scanners", name)
        half = np.tan(scanner.field_of_view[0] / 2)
        near, far = scanner.near, scanner.far
        corners = np.array([[near, -1], [near, 1], [far, 1], [far, -1], [near, -1]])
        depth = corners[:, 0]
        axes.fill(depth, corners[:, 1] * depth * half, alpha=0.3, label=name)
    axes.set_aspect("equal")
    axes.legend(fontsize=7)
    axes.set_title("what scanners see from the side, from 0; metres")


def _standards(axes):
    """Return a drawing of each plate: rim, centring, threads."""
    from matplotlib.patches import Circle

    x = 0.0
    for plate in known_standards():
        x += plate.outer / 2
        for radius in (plate.outer / 2, plate.centring / 2):
            axes.add_patch(Circle((x, 0), radius, fill=False))
        for turn in 2 * np.pi * (np.arange(plate.threads) + 0.5) / plate.threads:
            place = plate.pitch_circle / 2 * np.array([np.cos(turn), np.sin(turn)])
            axes.add_patch(Circle((x + place[0], place[1]), plate.thread / 2))
        label = plate.designation.removeprefix("ISO 9409-1-")
        axes.text(x, -0.19, label, fontsize=6, ha="center", rotation=90)
        x += plate.outer / 2 + 0.02
    axes.set_xlim(-0.02, x)
    axes.set_ylim(-0.25, 0.2)
    axes.set_aspect("equal")
    axes.set_title("plates of ISO 9409-1; metres")


if __name__ == "__main__":
    main()
