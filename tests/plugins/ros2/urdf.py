"""A robot model of ours as the URDF that its ROS driver would publish, collision bodies included."""

import numpy as np

from flangeye.types.geometry import rigid, rotation_from_rpy, rpy_from_rotation


def names_of(model, prefix=""):
    return [f"{prefix}joint_{i + 1}" for i in range(len(model.joints))]


def urdf_of(model, prefix="", ends=("tool0",)):
    """Links base_link, link_1 … and ends of an arm with standard Denavit-Hartenberg parameters."""
    names, parts = names_of(model, prefix), []
    parts.append(_link(f"{prefix}base_link", [v for v in model.volumes if v.link == 0]))
    before, parent = np.eye(4), f"{prefix}base_link"
    for i, joint in enumerate(model.joints, 1):
        origin = before @ rigid(rotation_from_rpy(0, 0, joint.theta), np.zeros(3))
        # The link's frame is where its joint turns; the model's is at the link's far end.
        before = rigid(np.eye(3), np.array([0, 0, joint.d])) @ rigid(
            rotation_from_rpy(joint.alpha, 0, 0), np.array([joint.a, 0, 0])
        )
        child = f"{prefix}link_{i}"
        parts.append(
            f'<joint name="{names[i - 1]}" type="revolute">{_origin(origin)}<axis xyz="0 0 1"/>'
            f'<parent link="{parent}"/><child link="{child}"/>'
            f'<limit lower="{joint.lower}" upper="{joint.upper}" velocity="3.14" effort="1"/></joint>'
        )
        parts.append(_link(child, [v for v in model.volumes if v.link == i], before))
        parent = child
    end = before @ model.link_T_flange
    parts += [
        f'<joint name="{prefix}to_{name}" type="fixed">{_origin(end)}<parent link="{parent}"/>'
        f'<child link="{prefix}{name}"/></joint><link name="{prefix}{name}"/>'
        for name in ends
    ]
    return f'<robot name="{model.model}">{"".join(parts)}</robot>'


def _link(name, volumes, link_T_end=None):
    frame = np.eye(4) if link_T_end is None else link_T_end
    return f'<link name="{name}">{"".join(_cylinder(v, frame) for v in volumes)}</link>'


def _cylinder(volume, frame):
    ends = [frame[:3, :3] @ np.asarray(end) + frame[:3, 3] for end in (volume.start, volume.end)]
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    z = axis / length
    x = np.cross(z, [1, 0, 0] if abs(z[0]) < 0.9 else [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = rigid(np.stack([x, np.cross(z, x), z], axis=1), (ends[0] + ends[1]) / 2)
    return (
        f'<collision>{_origin(pose)}<geometry><cylinder radius="{volume.radius}" '
        f'length="{length}"/></geometry></collision>'
    )


def _origin(pose):
    xyz = " ".join(map(repr, pose[:3, 3].tolist()))
    rpy = " ".join(repr(float(angle)) for angle in rpy_from_rotation(pose[:3, :3]))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'
