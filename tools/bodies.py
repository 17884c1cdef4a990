"""Write data/bodies: three bodies of our own making, as binary STL in millimetres.

    python -m tools.bodies

Each is in the flange's frame: its origin in the face, z outwards.
"""

from pathlib import Path

import numpy as np
import trimesh

from flangeye_emulators.world.mesh import Mesh, box, circle, lathe, merged, region, wall

FOLDER = Path(__file__).parents[1] / "data" / "bodies"
AROUND = 64
"""Segments of a circle."""


def cylinder(start, end, radius):
    """A cylinder with flat ends between two points."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length
    side = np.linalg.svd(axis[None])[2][1:]
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([*side, axis])
    frame[:3, :3] *= [np.sign(np.linalg.det(frame[:3, :3])), 1, 1]
    frame[:3, 3] = start
    profile = [(1e-9, 0.0), (radius, 0.0), (radius, length), (1e-9, length)]
    return lathe(profile, AROUND).moved(frame)


def gripper() -> Mesh:
    """A parallel gripper: adapter, housing, two fingers; one side differs by its cable gland."""
    return merged([
        cylinder([0, 0, 0], [0, 0, 14], 37.5),
        box([-45, -32, 14], [45, 32, 92]),
        box([-60, -14, 92], [60, 14, 106]),
        box([-38, -10, 106], [-26, 10, 168]),
        box([26, -10, 106], [38, 10, 168]),
        box([-26, -8, 150], [-20, 8, 168]),
        box([20, -8, 150], [26, 8, 168]),
        cylinder([20, 32, 40], [20, 52, 40], 9),
    ])  # fmt: skip


def torch() -> Mesh:
    """A welding torch at 45 degrees on a bracket."""
    return merged([
        cylinder([0, 0, 0], [0, 0, 12], 31.5),
        box([-25, -30, 12], [25, 30, 22]),
        box([-25, -30, 22], [25, -20, 110]),
        box([-22, -20, 70], [22, 8, 106]),
        cylinder([-90, 22, 88], [70, 22, 88], 16),
        cylinder([70, 22, 88], [135, 22, 140], 12.5),
        cylinder([135, 22, 140], [170, 22, 168], 9),
        cylinder([-90, 22, 88], [-130, 22, 88], 10),
    ])  # fmt: skip


def ring_plate() -> Mesh:
    """A plate with a raised ring, as the paper's tool has: 63 mm outside, 31.5 mm bore, off centre."""
    face = region(circle(30.5, 180), [circle(16.5, 180)], 26.0)
    ring = lathe([(30.5, 26.0), (31.5, 25.0), (31.5, 20.0)], 180)
    bore = lathe([(16.5, 26.0), (15.75, 25.25), (15.75, 19.0)], 180)
    bottom = region(circle(15.75, 180), [], 19.0)
    moved = np.eye(4)
    moved[:3, 3] = [65, 0, 0]
    tilted = [part.moved(moved) for part in (face, ring, bore, bottom)]
    plate = np.array([[-40.0, -40.0], [105.0, -40.0], [105.0, 40.0], [-20.0, 40.0], [-40.0, 20.0]])
    loop = np.concatenate([
        np.linspace(a, b, 40, endpoint=False)
        for a, b in zip(plate, np.roll(plate, -1, axis=0), strict=True)
    ])  # fmt: skip
    top = region(loop, [], 20.0)
    back = region(loop, [], 12.0)
    bolt = cylinder([-15, -15, 12], [-15, -15, 30], 6)
    return merged([top, back, wall(loop, 20.0, 12.0), cylinder([0, 0, 0], [0, 0, 12], 31.5), bolt,
                   *tilted])  # fmt: skip


def write(name: str, mesh: Mesh) -> None:
    """Write one."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    (FOLDER / f"{name}.stl").write_bytes(trimesh.exchange.stl.export_stl(solid))
    print(name, len(mesh.triangles), np.ptp(mesh.vertices, axis=0))


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, mesh in (("gripper", gripper()), ("torch", torch()), ("ring-plate", ring_plate())):
        write(name, mesh)
