"""Small scenes to look at, quick enough for tests."""

from __future__ import annotations

import numpy as np

from flangeye.models.loading import load_model
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange, plate_of
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye_emulators.world.mesh import MATERIALS, box, flange_mesh, wrist_mesh
from flangeye_emulators.world.raycast import RaycastScene, SolidBody

SCANNER = load_model("scanners", "phoxi-m")


def flange(robot: str = "ur5") -> Flange:
    model = load_model("robots", robot)
    return plate_of(model)


def quiet(scanner: ScannerModel = SCANNER, **changes) -> ScannerModel:
    """Return a scanner without edge effects, all else as it is."""
    return scanner.model_copy(update={"edge_loss": 0.0, "noise_grain": 0.0, **changes})


def facing(tilt: float = 0.0, depth: float = 0.7, aside: float = 0.0) -> np.ndarray:
    """Return ``camera_T_flange`` of a flange before the camera, turned about the image's x."""
    return rigid(rotation_from_rpy(np.pi + tilt, 0.0, 0.0), np.array([aside, 0.0, depth]))


def plate(depth: float, material=MATERIALS["matt"], half: float = 0.5) -> SolidBody:
    """Return a flat plate across the view."""
    return SolidBody(box([-half, -half, depth], [half, half, depth + 0.01]), material)


def flange_scene(camera_T_flange: np.ndarray, robot: str = "ur5") -> RaycastScene:
    """Return a flange on its wrist, 0.3 m before a table."""
    shape = flange(robot)
    carried = [
        SolidBody(flange_mesh(shape), MATERIALS["metal"]),
        SolidBody(wrist_mesh(shape), MATERIALS["metal"]),
    ]
    behind = float(camera_T_flange[2, 3]) + 0.3
    return RaycastScene([body.moved(camera_T_flange) for body in carried] + [plate(behind)])


def in_flange(points: np.ndarray, camera_T_flange: np.ndarray) -> np.ndarray:
    """Return (N, 3) finite points of a scan in the flange's frame [m]."""
    flat = points.reshape(-1, 3).astype(np.float64)
    flat = flat[np.isfinite(flat[:, 0])]
    return (flat - camera_T_flange[:3, 3]) @ camera_T_flange[:3, :3]


def zoomed(scanner: ScannerModel = SCANNER, columns: int = 400, rows: int = 300) -> ScannerModel:
    """Return the middle of a scanner's image: its own pixels, fewer of them."""
    pixel = 2 * np.tan(np.array(scanner.field_of_view) / 2) / (scanner.columns, scanner.rows)
    field = 2 * np.arctan(pixel * (columns, rows) / 2)
    changes = {"columns": columns, "rows": rows, "field_of_view": tuple(field.tolist())}
    return scanner.model_copy(update=changes)
