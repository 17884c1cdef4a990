"""Layouts of folders that `init` reads: each made from own numbers, and not edited after."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.models.robots import UR_JOINTS
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from tests.plugins.ros2.urdf import urdf_of

NAMES = ["x", "y", "z", "qx", "qy", "qz", "qw"]
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "init.md"
SEED = 7
COUNT = 24
FLANGE_T_CAMERA = rigid(rotation_exp(np.array([0.1, -0.2, 1.1])), np.array([0.05, 0.02, 0.09]))


def session(seed: int) -> tuple[Floats, Floats, Floats]:
    """Return joints, base_T_flange and camera_T_target of a camera in a UR5e's hand, with noise."""
    rng = np.random.default_rng(seed)
    joints = np.array([0.3, -1.4, 1.6, -1.8, -1.5, 0.2]) + rng.uniform(-0.5, 0.5, (COUNT, 6))
    arm = np.asarray(Arm(load_model("robots", "ur5e")).flange(joints))
    base_T_target = rigid(rotation_exp(np.array([0.1, 0.2, 2.0])), np.array([-0.5, -0.1, 0.0]))
    noise = [rigid(rotation_exp(r), t) for r, t in zip(
        rng.normal(0, 3e-4, (COUNT, 3)), rng.normal(0, 1e-4, (COUNT, 3)), strict=True)]  # fmt: skip
    seen = np.linalg.inv(arm @ FLANGE_T_CAMERA) @ base_T_target @ np.array(noise)
    return joints, arm, seen


def vector(poses, scale=1.0):
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    return np.hstack([scale * poses[:, :3, 3], turns])


def euler(poses, order, scale=1e3):
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler(order, degrees=True)
    return np.hstack([scale * poses[:, :3, 3], turns])


def quaternion(poses):
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def text(rows, mark=","):
    return "\n".join(mark.join(f"{x:.9g}" for x in row) for row in rows) + "\n"


def indexed(rows):
    return np.column_stack([np.arange(1, len(rows) + 1), rows])


def blocks(f, j, a, s):
    (f / "both.txt").write_text(text(vector(a), " ") + "\n" + text(vector(s), " "))


def halves(f, j, a, s):
    (f / "poses.txt").write_text(text([*quaternion(a), *quaternion(s)], " "))


def index_column(f, j, a, s):
    for name, poses in (("gripper2base", a), ("target2cam", s)):
        (f / f"{name}.csv").write_text(text(indexed(vector(poses, 1e3)[:, [3, 4, 5, 0, 1, 2]])))


def index_with_gaps(f, j, a, s):
    kept = np.cumsum([1, 2] * (COUNT // 2))
    for name, poses in (("rob", a), ("mark", s)):
        (f / f"{name}.csv").write_text(text(np.column_stack([kept, vector(poses, 1e3)])))


def index_in_no_order(f, j, a, s):
    kept = 3 + np.random.default_rng(SEED).permutation(COUNT)
    for name, order in (("robot", kept), ("marker", np.sort(kept))):
        poses = (a if name == "robot" else s)[order - 3]
        rows = text(np.column_stack([order, vector(poses, 1e3)]))
        (f / f"{name}.csv").write_text("id,x_mm,y_mm,z_mm,rx,ry,rz\n" + rows)


def rotation_first(f, j, a, s):
    for name, poses in (("tcp", a), ("board", s)):
        (f / f"{name}.txt").write_text(text(vector(poses)[:, [3, 4, 5, 0, 1, 2]]))


def metres_and_degrees(f, j, a, s):
    (f / "tcp.txt").write_text("% controller V8\n" + text(euler(a, "ZYX", 1.0), " "))
    (f / "pattern.csv").write_text(text(vector(s), " "))


def blank_lines(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        lines = text(quaternion(poses), "  ").replace("\n", "\n\n")
        (f / f"{name}.txt").write_text(f"// exported from the pendant\n{lines}")


def cam2target(f, j, a, s):
    (f / "gripper2base.csv").write_text(text(indexed(vector(a, 1e3))))
    (f / "cam2target.csv").write_text(text(indexed(vector(np.linalg.inv(s), 1e3))))


def side_by_side(f, j, a, s):
    for name, poses in (("gripper2base", a), ("cam2target", np.linalg.inv(s)), ("target2cam", s)):
        (f / f"{name}.csv").write_text(text(vector(poses)))


def beside_images(f, j, a, s):
    side_by_side(f, j, a, s)
    (f / "images").mkdir()
    for k in range(COUNT):
        cv2.imwrite(str(f / "images" / f"{k}.png"), np.zeros((8, 8), np.uint8))


def storage(f, name, written):
    file = cv2.FileStorage(str(f / name), cv2.FILE_STORAGE_WRITE)
    for key, value in written:
        file.write(key, value)
    file.release()


def opencv_numbered(f, j, a, s):
    storage(f, "pairs.yml", [(f"{n}_{k}", p) for n, ps in (("robot", a), ("cam", s))
                             for k, p in enumerate(ps)])  # fmt: skip


def opencv_lists(f, j, a, s):
    for name, poses in (("robot", a), ("camera", s)):
        lines = [f"pose{k}: [ {', '.join(f'{x:.9g}' for x in row)} ]"
                 for k, row in enumerate(vector(poses), 1)]  # fmt: skip
        (f / f"{name}.yml").write_text("%YAML:1.0\n---\n" + "\n".join(lines) + "\n")


def opencv_vectors(f, j, a, s):
    written = {
        "Rotation_Vec": vector(s)[:, 3:].tolist(),
        "Translation_Vec": vector(s)[:, :3].tolist(),
    }
    (f / "camera.yml").write_text(
        "%YAML:1.0\n---\n" + "".join(f"{k}: {v}\n" for k, v in written.items())
    )
    np.save(f / "gripper2base.npy", a)


def json_per_image(f, j, a, s):
    for k, (arm, seen) in enumerate(zip(a, s, strict=True)):
        (f / f"{k}.json").write_text(json.dumps({"robot": arm.tolist(), "marker": seen.tolist()}))


def sections(f, j, a, s):
    for name, poses in (("robot.ini", a), ("marker.toml", s)):
        rows = [f"[{k}]\npose = [{', '.join(f'{x:.9g}' for x in row)}]\n"
                for k, row in enumerate(vector(poses), 1)]  # fmt: skip
        (f / name).write_text("# by hand\n" + "\n".join(rows))


def sections_of_names(f, j, a, s):
    pose = ("x", "y", "z", "qx", "qy", "qz", "qw")
    keys = [f"{who}_{each}" for who in ("tcp", "board") for each in pose]
    rows = np.column_stack([quaternion(a), quaternion(s)])
    (f / "session.ini").write_text("".join(
        f"[{k}]\n" + "".join(f"{key} = {x:.9g}\n" for key, x in zip(keys, row, strict=True))
        for k, row in enumerate(rows)
    ))  # fmt: skip


def lists_with_units(f, j, a, s):
    (f / "session.json").write_text(json.dumps([
        {name: {"quaternion_wxyz": row[[6, 3, 4, 5]].tolist(),
                "translation_mm": (1e3 * row[:3]).tolist()}
         for name, row in (("tcp", arm), ("marker", seen))}
        for arm, seen in zip(quaternion(a), quaternion(s), strict=True)
    ]))  # fmt: skip


def npz_opencv(f, j, a, s):
    np.savez(f / "handeye.npz", R_gripper2base=a[:, :3, :3], t_gripper2base=a[:, :3, 3:],
             R_target2cam=s[:, :3, :3], t_target2cam=s[:, :3, 3:])  # fmt: skip


def separate_files(f, j, a, s):
    for name, poses in (("gripper2base", a), ("target2cam", s)):
        np.savetxt(f / f"R_{name}.txt", poses[:, :3, :3].reshape(-1, 3))
        np.savetxt(f / f"t_{name}.txt", poses[:, :3, 3])


def matlab(f, j, a, s):
    savemat(f / "data.mat", {"bHg": np.moveaxis(a, 0, 2), "cHt": np.moveaxis(s, 0, 2)})


def folders(f, j, a, s):
    for name, poses in (("robot", a), ("camera", s)):
        (f / name).mkdir()
        for k, pose in enumerate(poses):
            np.savetxt(f / name / f"{k}.txt", pose)


def headings(f, j, a, s):
    names = [*"XYZABC", *(f"target_{n}" for n in NAMES)]
    (f / "log.csv").write_text(";".join(names) + "\n"
                               + text(np.hstack([euler(a, "ZYX"), quaternion(s)]), ";"))  # fmt: skip


def rx_ry_rz(f, j, a, s):
    names = [
        *("x", "y", "z", "rx", "ry", "rz"),
        *(f"cam_{n}" for n in NAMES),
    ]
    (f / "log.csv").write_text(",".join(names) + "\n"
                               + text(np.hstack([euler(a, "xyz"), quaternion(s)])))  # fmt: skip


def urscript(f, j, a, s):
    lines = [f"p[{', '.join(f'{x:.9g}' for x in row)}]" for row in vector(a)]
    (f / "program.script").write_text("\n".join(lines))
    (f / "marker.csv").write_text(text(s.reshape(-1, 16)))


def matrices_in_text(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        stacked = "\n\n".join(text(pose, " ").strip() for pose in poses)
        (f / f"{name}.txt").write_text(stacked + "\n")


def wxyz(f, j, a, s):
    for name, poses in (("arm", a), ("board", s)):
        (f / f"{name}.csv").write_text(text(quaternion(poses)[:, [0, 1, 2, 6, 3, 4, 5]]))


def tf_echo(f, j, a, s):
    line = "At time {}\n- Translation: [{:.6f}, {:.6f}, {:.6f}]\n- Rotation: in Quaternion "
    line += "(xyzw) [{:.7f}, {:.7f}, {:.7f}, {:.7f}]\n"
    for name, poses in (("base_to_tool0", a), ("camera_to_marker", s)):
        lines = [line.format(k, *row) for k, row in enumerate(quaternion(poses))]
        (f / f"{name}.txt").write_text("".join(lines))


def matrix_headings(f, j, a, s):
    names = [f"r{row}{column}" for row in "123" for column in "123"]
    for file, poses in (("robot", a), ("camera", s)):
        rows = np.hstack([poses[:, :3, :3].reshape(-1, 9), 1e3 * poses[:, :3, 3]])
        (f / f"{file}.csv").write_text(",".join([*names, "tx", "ty", "tz"]) + "\n" + text(rows))


def axis_first(f, j, a, s):
    names = [f"{n}_robot" for n in NAMES]
    names += [f"T{k // 4}{k % 4}_camera" for k in range(12)]
    rows = np.hstack([quaternion(a), s[:, :3].reshape(-1, 12)])
    (f / "measured.csv").write_text(",".join(names) + "\n" + text(rows))


def counted_entries(f, j, a, s):
    names = [f"tcp_{n}" for n in NAMES] + [f"cam_m{k}" for k in range(16)]
    rows = np.hstack([quaternion(a), s.reshape(-1, 16)])
    (f / "measured.tsv").write_text("\t".join(names) + "\n" + text(rows, "\t"))


def opencv_hand_eye(f, j, a, s):
    storage(f, "hand_eye.xml", [(f"{n}_{k}", p) for n, ps in (("flange", a), ("aruco", s))
                                for k, p in enumerate(ps)])  # fmt: skip


def yaml_nested(f, j, a, s):
    (f / "poses.yaml").write_text(json.dumps([
        {name: {"position": dict(zip("xyz", row[:3], strict=True)),
                "orientation": dict(zip(("roll", "pitch", "yaw"), row[3:], strict=True))}
         for name, row in (("robot", arm), ("marker", seen))}
        for arm, seen in zip(euler(a, "xyz").tolist(), euler(s, "xyz").tolist(), strict=True)
    ]))  # fmt: skip


def topic_echo(f, j, a, s):
    for name, poses in (("tcp_pose", a), ("marker_pose", s)):
        text = ""
        for *place, x, y, z, w in quaternion(poses).tolist():
            turn = dict(zip("xyzw", (x, y, z, w), strict=True))
            pose = {"position": dict(zip("xyz", place, strict=True)), "orientation": turn}
            text += f"header: {{frame_id: a}}\npose: {json.dumps(pose)}\n---\n"
        (f / f"{name}.yaml").write_text(text)


def json_arrays(f, j, a, s):
    (f / "calib.json").write_text(
        json.dumps({"T_base_flange": a.tolist(), "T_cam_board": s.tolist()})
    )


def joints_alone(f, j, a, s):
    (f / "robot.txt").write_text(text(np.degrees(j), " "))
    (f / "target2cam.csv").write_text(text(vector(s)))
    (f / "arm.urdf").write_text(urdf_of(load_model("robots", "ur5e")))


def joints_of_ros(f, j, a, s):
    order = [2, 1, 0, 3, 4, 5]  # as drivers of ROS write them: by alphabet
    names = [f"{UR_JOINTS[k]}_joint" for k in order] + [f"marker_{n}" for n in NAMES]
    rows = np.hstack([j[:, order], quaternion(s)])
    (f / "states.csv").write_text(",".join(names) + "\n" + text(rows))
    (f / "arm.urdf").write_text(urdf_of(load_model("robots", "ur5e")))


def stacked_matrices(f, j, a, s):
    storage(f, "pairs.yml", [("gripper2base", a.reshape(-1, 4)), ("target2cam", s.reshape(-1, 4))])


def by_columns(f, j, a, s):
    (f / "log.json").write_text(json.dumps([
        {"O_T_EE": arm.T.ravel().tolist(), "cam_T_tag": seen.ravel().tolist()}
        for arm, seen in zip(a, s, strict=True)
    ]))  # fmt: skip


def times_as_names(f, j, a, s):
    for name, poses in (("arm", a), ("aruco", s)):
        (f / name).mkdir()
        for k, pose in enumerate(poses):
            np.savetxt(f / name / f"{1690000000 + 3.125 * k:.3f}.txt", pose)


def dates_as_names(f, j, a, s):
    for k, (arm, seen) in enumerate(zip(vector(a), vector(s), strict=True)):
        records = {"robot": arm.tolist(), "board": seen.tolist()}
        (f / f"202601{28 + k // 7}_10150{k % 7}.yaml").write_text(json.dumps(records))


def printed_arrays(f, j, a, s):
    for name, poses in (("robot", a), ("board", s)):
        (f / f"{name}.txt").write_text("\n".join(map(repr, poses)))


def nested(f, j, a, s):
    (f / "2026-01-31" / "first").mkdir(parents=True)
    headings(f / "2026-01-31" / "first", j, a, s)


def rostopic(f, j, a, s):
    columns = [f"field.pose.{part}.{axis}" for part, axes in (("position", "xyz"),
               ("orientation", "xyzw")) for axis in axes]  # fmt: skip
    for name, poses in (("tcp_pose", a), ("aruco_pose", s)):
        lines = [f"{1690000000 + 4 * k}000000000,{k},{row}" for k, row in
                 enumerate(text(quaternion(poses)).splitlines())]  # fmt: skip
        heading = ",".join(["%time", "field.header.seq", *columns])
        (f / f"{name}.csv").write_text("\n".join([heading, *lines]) + "\n")


def centimetres(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        rows = quaternion(poses) * [100, 100, 100, 1, 1, 1, 1]
        (f / f"{name}.csv").write_text("x_cm,y_cm,z_cm,qx,qy,qz,qw\n" + text(rows))


def counted_apart(f, j, a, s):
    names = [f"r{k}" for k in range(1, 10)] + ["t1", "t2", "t3"]
    for name, poses in (("robot", a), ("marker", s)):
        rows = np.hstack([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]])
        (f / f"{name}.csv").write_text(",".join(names) + "\n" + text(rows))


def bracketed_units(f, j, a, s):
    names = [f"{n}-Position [mm]" for n in "XYZ"] + [f"Winkel {n} [°]" for n in "ABC"]
    for name, poses in (("Roboter", a), ("Kamera", s)):
        rows = text(euler(poses, "ZYX"), ";").replace(".", ",")
        (f / f"{name}.csv").write_text(";".join(names) + "\n" + rows)


def units_below(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        rows = text(euler(poses, "xyz"), " ")
        (f / f"{name}.txt").write_text("x y z rx ry rz\nmm mm mm deg deg deg\n" + rows)


def empty_cells(f, j, a, s):
    names = [f"{who}_{n}" for who in ("tcp", "tag") for n in NAMES]
    rows = text(np.hstack([quaternion(a), quaternion(s)])).splitlines()
    for k in (0, 5):
        rows[k] = ",".join(rows[k].split(",")[:7]) + 7 * ","
    (f / "log.csv").write_text("\n".join([",".join(names), *rows]) + "\n")


def zeros(f, j, a, s):
    names = [f"{who}_{n}" for who in ("tcp", "tag") for n in NAMES]
    seen = quaternion(s)
    seen[[0, 5]] = 0
    (f / "log.csv").write_text(",".join(names) + "\n" + text(np.hstack([quaternion(a), seen])))


def matlab_cells(f, j, a, s):
    cells = {name: np.empty(COUNT, dtype=object) for name in ("robotPoses", "markerPoses")}
    for cell, poses in zip(cells.values(), (a, s), strict=True):
        cell[:] = list(poses)
    savemat(f / "data.mat", cells)


def fortran(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        lines = [" ".join(f"{x:.8E}".replace("E", "D") for x in row) for row in vector(poses)]
        (f / f"{name}.dat").write_text("\n".join(lines) + "\n")


def centres(f, j, a, s):
    names = [*NAMES, "sphere_x", "sphere_y", "sphere_z"]
    rows = np.hstack([quaternion(a), s[:, :3, 3]])
    (f / "log.csv").write_text(",".join(names) + "\n" + text(rows))


def moveit(f, j, a, s):
    (f / "samples.yaml").write_text("".join(
        f"- effector_wrt_world: {arm.ravel().tolist()}\n"
        f"  object_wrt_sensor: {seen.ravel().tolist()}\n" for arm, seen in zip(a, s, strict=True)
    ))  # fmt: skip


def bars(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        (f / f"{name}.txt").write_text("x|y|z|qx|qy|qz|qw\n" + text(quaternion(poses), "|"))


def counted_quaternion(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        rows = text(quaternion(poses)[:, [0, 1, 2, 6, 3, 4, 5]])
        (f / f"{name}.csv").write_text("x,y,z,q0,q1,q2,q3\n" + rows)


def calibration(f, j, a, s):
    matrix = np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]])
    places, turns = vector(s)[:, :3, None], vector(s)[:, 3:, None]
    np.savez(f / "camera.npz", tvecs=places, rvecs=turns, mtx=matrix, dist=np.zeros(5))
    np.save(f / "gripper2base.npy", a)


def count_first(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        (f / f"{name}.txt").write_text(f"{COUNT}\n" + text(vector(poses), " "))


def in_turn(f, j, a, s):
    (f / "log.txt").write_text("".join(
        f"robot {k}\n{text(arm, ' ')}marker {k}\n{text(seen, ' ')}"
        for k, (arm, seen) in enumerate(zip(a, s, strict=True))
    ))  # fmt: skip


def named_as_in_ros(f, j, a, s):
    (f / "tf.json").write_text(json.dumps([
        {name: {"translation": dict(zip("xyz", row[:3], strict=True)),
                "rotation": dict(zip("xyzw", row[3:], strict=True))}
         for name, row in (("base_to_ee", arm), ("cam_to_tag", seen))}
        for arm, seen in zip(quaternion(a).tolist(), quaternion(s).tolist(), strict=True)
    ]))  # fmt: skip


def one_below_the_other(f, j, a, s):
    rows = [f"{i},{who},{text([row])}" for i in range(COUNT)
            for who, (row,) in (("robot", quaternion(a[[i]])), ("marker", quaternion(s[[i]])))]  # fmt: skip
    (f / "poses.csv").write_text("pose,frame,x,y,z,qx,qy,qz,qw\n" + "".join(rows))


def below_by_time(f, j, a, s):
    rows = [f"{100 + 2 * i};{who};{text([row], ';')}" for who, poses in (("tcp", a), ("tag", s))
            for i, row in enumerate(euler(poses, "ZYX")[:, [0, 1, 2, 5, 4, 3]])]  # fmt: skip
    (f / "log.csv").write_text(
        "timestamp;type;x_mm;y_mm;z_mm;rx_deg;ry_deg;rz_deg\n" + "".join(rows)
    )


def counted_vectors(f, j, a, s):
    axes = ",".join(f"Robot {axis}" for axis in ("X (mm)", "Y (mm)", "Z (mm)", "Rx", "Ry", "Rz"))
    seen = "tvec_0,tvec_1,tvec_2,rvec_0,rvec_1,rvec_2"
    (f / "r.csv").write_text(f"{axes},{seen}\n" + text(np.hstack([vector(a, 1e3), vector(s, 1e3)])))


def recorder_of_ur(f, j, a, s):
    names = [f"actual_{of}_{i}" for of in ("q", "TCP_pose") for i in range(6)]
    times = 2.0 * np.arange(COUNT)[:, None]
    rows = text(np.hstack([times, j, vector(a)]), " ")
    (f / "robot_data.csv").write_text(f"timestamp {' '.join(names)}\n{rows}")
    rows = text(np.hstack([times + 0.01, vector(s)]), " ")
    (f / "charuco.csv").write_text(f"timestamp t_x t_y t_z rvec_x rvec_y rvec_z\n{rows}")


def benchmark_of_poses(f, j, a, s):
    seen = {str(i): [{"cam_R_m2c": pose[:3, :3].ravel().tolist(), "obj_id": 1,
                      "cam_t_m2c": (1e3 * pose[:3, 3]).tolist()}]
            for i, pose in enumerate(s)}  # fmt: skip
    (f / "scene_gt.json").write_text(json.dumps(seen))
    (f / "robot.json").write_text(json.dumps({str(i): pose.tolist() for i, pose in enumerate(a)}))


def lists_in_cells(f, j, a, s):
    cells = zip(vector(a).tolist(), vector(s).tolist(), strict=True)
    rows = [f'img{i}.png,"{arm}","{seen if i else ""}"\n' for i, (arm, seen) in enumerate(cells)]
    (f / "poses.csv").write_text("image,robot_pose,marker_pose\n" + "".join(rows))


def entries_by_two_numbers(f, j, a, s):
    names = [f"{of}_{i}_{k}" for of in ("robot", "cam") for i in range(4) for k in range(4)]
    rows = text(np.hstack([a.reshape(-1, 16), s.reshape(-1, 16)]))
    (f / "all.csv").write_text(f"{','.join(names)}\n{rows}")


def entries_in_brackets(f, j, a, s):
    of = ("T_base_tcp", "T_cam_tag")
    names = [f"{name}[{i},{k}]" for name in of for i in range(3) for k in range(4)]
    rows = text(np.hstack([a[:, :3].reshape(-1, 12), s[:, :3].reshape(-1, 12)]), ";")
    (f / "all.csv").write_text(f"{';'.join(names)}\n{rows}")


def remarks_behind(f, j, a, s):
    for name, poses in (("robot", a), ("marker", s)):
        lines = text(quaternion(poses), " ").splitlines()
        (f / f"{name}.txt").write_text("".join(f"{x}   # pose {i}\n" for i, x in enumerate(lines)))


def kinova(f, j, a, s):
    arm = euler(a, "ZYX", 1.0)[:, [0, 1, 2, 5, 4, 3]].tolist()
    names = ("x", "y", "z", "theta_x", "theta_y", "theta_z")
    (f / "log.json").write_text(json.dumps({"measurements": [
        {"tool_pose": dict(zip(names, row, strict=True)),
         "aruco": {"tvec": seen[:3], "rvec": seen[3:]}}
        for row, seen in zip(arm, vector(s).tolist(), strict=True)
    ]}))  # fmt: skip


def matlab_structures(f, j, a, s):
    samples = np.zeros(COUNT, dtype=[("robot", object), ("cam", object)])
    samples["robot"], samples["cam"] = list(a), list(s)
    savemat(f / "samples.mat", {"samples": samples})


def names_of_abb(f, j, a, s):
    for name, poses in (("robot", a), ("camera_target", s)):
        rows = quaternion(poses)[:, [0, 1, 2, 6, 3, 4, 5]] * [1e3, 1e3, 1e3, 1, 1, 1, 1]
        heading = "trans.x,trans.y,trans.z,rot.q1,rot.q2,rot.q3,rot.q4"
        (f / f"{name}.csv").write_text(f"{heading}\n{text(rows)}")


def melfa(f, j, a, s):
    rows = text(euler(a, "ZYX")[:, [0, 1, 2, 5, 4, 3]]).splitlines()
    (f / "melfa.txt").write_text("".join(f"P{i}=({row})(7,0)\n" for i, row in enumerate(rows)))
    (f / "board.csv").write_text("tx,ty,tz,rx,ry,rz\n" + text(vector(s)))


def epson(f, j, a, s):
    (f / "epson.csv").write_text("X,Y,Z,U,V,W\n" + text(euler(a, "ZYX")))
    (f / "vision.csv").write_text("X,Y,Z,RX,RY,RZ\n" + text(vector(s, 1e3)))


def topic_as_csv(f, j, a, s):
    for name, frame, poses in (("robot", "base_link", a), ("aruco", "camera", s)):
        lines = text(quaternion(poses)).splitlines()
        rows = [f"{1700 + 2 * i},5000,{frame},{line}\n" for i, line in enumerate(lines)]
        (f / f"{name}.csv").write_text("".join(rows))


def names_of_visp(f, j, a, s):
    for name, poses in (("fMe", a), ("cMo", s)):
        (f / f"{name}.txt").write_text(text(poses.reshape(-1, 16), " "))


def xml_attributes(f, j, a, s):
    def attributes(row):
        return " ".join(f'{name}="{x:.9g}"' for name, x in zip(NAMES, row, strict=True))

    (f / "session.xml").write_text("<session>" + "".join(
        f'<sample id="{k}"><robot {attributes(arm)}/><marker {attributes(seen)}/></sample>\n'
        for k, (arm, seen) in enumerate(zip(quaternion(a), quaternion(s), strict=True))
    ) + "</session>")  # fmt: skip


def markdown(f, j, a, s):
    table = "| # | {} |\n|{}\n".format(" | ".join(NAMES), 8 * "---:|")
    (f / "notes.md").write_text("# Monday\n" + "".join(
        f"\n## {title}\n\n{table}"
        + "".join(f"| {row.strip()} |\n" for row in text(indexed(quaternion(poses)), " | ").splitlines())
        for title, poses in (("Robot (metres)", a), ("Marker in the camera", s))
    ))  # fmt: skip


def python_lists(f, j, a, s):
    lines = [f"robot.append(np.array({arm.tolist()}))" for arm in a]
    (f / "poses.py").write_text(
        "import numpy as np\n\nrobot = []\n" + "\n".join(lines)
        + f"\nmarker_poses = {vector(s).tolist()}\nprint(len(robot))\n"
    )  # fmt: skip


def lines_of_a_log(f, j, a, s):
    (f / "node.log").write_text("".join(
        f"[INFO] [16{k:02}.25] [calib]: {who} pose: [{text([row], ', ').strip()}]\n"
        for k, rows in enumerate(zip(quaternion(a), quaternion(s), strict=True))
        for who, row in zip(("robot", "marker"), rows, strict=True)
    ))  # fmt: skip


def labelled(f, j, a, s):
    axes = ("x", "y", "z", "rx", "ry", "rz")
    (f / "log.txt").write_text("".join(
        f"[{k}] " + "; ".join(
            f"{who}: " + " ".join(f"{n}={x:.9g}" for n, x in zip(axes, row, strict=True))
            for who, row in zip(("robot", "marker"), rows, strict=True)
        ) + "\n"
        for k, rows in enumerate(zip(vector(a), vector(s), strict=True))
    ))  # fmt: skip


def halcon(f, j, a, s):
    for name, poses in (("robot_pose", a), ("calib_obj_pose", s)):
        for k, row in enumerate(euler(poses, "XYZ", 1.0)):
            turn, place = text([row[3:] % 360], " "), text([row[:3]], " ")
            (f / f"{name}_{k:02}.dat").write_text(
                f"# 3D POSE PARAMETERS: rotation and translation\n\n# Used representation type:\nf 0\n"
                f"\n# Rotation angles [deg] or Rodriguez vector:\nr {turn}\n"
                f"# Translation vector (x y z [m]):\nt {place}\n"
            )  # fmt: skip


def colmap(f, j, a, s):
    (f / "images.txt").write_text("# Image list with two lines of data per image\n" + "".join(
        f"{k} {text([row[[6, 3, 4, 5]]], ' ').strip()} {text([3.7 * row[:3]], ' ').strip()} 1 {k}.jpg\n"
        "10.5 20.5 -1 33.1 44.2 7\n" for k, row in enumerate(quaternion(s), 1)
    ))  # fmt: skip
    (f / "robot.csv").write_text("x,y,z,qx,qy,qz,qw\n" + text(quaternion(a)))


def nerfstudio(f, j, a, s):
    places = np.linalg.inv(s) @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"file_path": f"images/{k:05}.png", "transform_matrix": pose.tolist()}
              for k, pose in enumerate(places)]  # fmt: skip
    camera = {"fl_x": 900, "fl_y": 900, "cx": 640, "cy": 480}
    (f / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    np.save(f / "robot.npy", a)


def metashape(f, j, a, s):
    (f / "cameras.xml").write_text("<document><chunk><cameras>" + "".join(
        f'<camera id="{k}" sensor_id="0" label="{k}"><transform>{text([pose.ravel()], " ")}</transform>'
        "</camera>" for k, pose in enumerate(np.linalg.inv(s))
    ) + "</cameras></chunk></document>")  # fmt: skip
    np.save(f / "robot.npy", a)


def apart_by_name(f, j, a, s):
    (f / "rec.json").write_text(json.dumps({
        f"{who}_{what}": quaternion(poses)[:, at].tolist() for who, poses in (("robot", a), ("marker", s))
        for what, at in (("positions", slice(3)), ("quaternions", slice(3, 7)))
    }))  # fmt: skip


def times_before_six(f, j, a, s):
    times = 1690000000 + 2.5 * np.arange(COUNT)[:, None]
    for name, poses in (("tcp", a), ("board", s)):
        rows = np.hstack([times, vector(poses)])
        (f / f"{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))


def cells_in(rows, number, mark=";"):
    return [mark.join([str(i), *map(number, row)]) for i, row in enumerate(rows, 1)]


def comma(x):
    return f"{x:.5f}".replace(".", ",")


def german(f, j, a, s):
    arm = "X Position [mm]\tY Position [mm]\tZ Position [mm]\tDrehung A [Grad]\tDrehung B [Grad]\tDrehung C [Grad]"
    seen = "\t".join(f"Marker {name}" for name in ["X [mm]", "Y [mm]", "Z [mm]", *NAMES[3:]])
    rows = np.hstack([euler(a, "ZYX"), 1e3 * quaternion(s)[:, :3], quaternion(s)[:, 3:]])
    lines = [f"Aufnahme\t{arm}\t{seen}", *cells_in(rows, comma, "\t")]
    (f / "Messung.txt").write_text("\r\n".join(lines), "utf-16")


def chinese(f, j, a, s):
    sides = (f"{side}{axis}" for side in ("机器人", "标定板")
             for axis in ("X(mm)", "Y(mm)", "Z(mm)", "RX(度)", "RY(度)", "RZ(度)"))  # fmt: skip
    rows = cells_in(np.hstack([euler(a, "xyz"), euler(s, "xyz")]), "{:.4f}".format, ",")
    (f / "数据.csv").write_text("\n".join([",".join(["序号", *sides]), *rows]), "gb18030")


def chinese_quaternions(f, j, a, s):
    heading = "序号,位置X/毫米,位置Y/毫米,位置Z/毫米,四元数W,四元数X,四元数Y,四元数Z"
    for name, poses in (("机器人位姿", a), ("标定板位姿", s)):
        rows = quaternion(poses)[:, [0, 1, 2, 6, 3, 4, 5]] * np.repeat([1e3, 1], [3, 4])
        lines = [heading, *cells_in(rows, "{:.7f}".format, ",")]
        (f / f"{name}.csv").write_text("\n".join(lines), "utf-8-sig")


def french(f, j, a, s):
    sides = (f"{word} {axis} ({unit})" for words in (("Position", "Rotation"), ("Mire", "Mire"))
             for word, axes, unit in zip(words, ("X Y Z", "RX RY RZ"), ("mm", "°"), strict=True)
             for axis in axes.split())  # fmt: skip
    rows = cells_in(np.hstack([euler(a, "xyz"), euler(s, "xyz")]), comma)
    (f / "mesures.csv").write_text("\n".join([";".join(["n°", *sides]), *rows]), "cp1252")


def spanish(f, j, a, s):
    heading = "Nº;Posición X;Posición Y;Posición Z;Giro X;Giro Y;Giro Z"
    for name, poses in (("robot", a), ("marcador", s)):
        lines = [heading, *cells_in(euler(poses, "xyz"), comma)]
        (f / f"{name}.csv").write_text("\n".join(lines), "cp1252")


def thousands(f, j, a, s):
    def printed(x):
        return f"{x:,.3f}".translate(str.maketrans(",.", ".,"))

    far = rigid(np.eye(3), np.array([-0.9, 0.8, 1.0])) @ a  # so that the base is a metre away
    rows = cells_in(np.hstack([euler(far, "ZYX"), euler(s, "ZYX")]), printed)
    heading = "Nr;X;Y;Z;A;B;C;Ziel X;Ziel Y;Ziel Z;Ziel A;Ziel B;Ziel C"
    (f / "Werte.csv").write_text("\n".join([heading, *rows]))


def other_comments(f, j, a, s):
    lines = text(np.hstack([quaternion(a), quaternion(s)]), " ").splitlines()
    told = ["; by hand on line 4", "! first the arm, then the marker", ""]
    (f / "poses.txt").write_text("\n".join([*told, *(f"{line}  ! shot" for line in lines)]))


def gaps(f, j, a, s):
    heading = ",".join(["name", *NAMES, *(f"target_{name}" for name in NAMES)])
    rows = cells_in(np.hstack([quaternion(a), quaternion(s)]), "{:.7f}".format, ",")
    rows[3:3] = [",".join(["25", *["nan"] * 14])]
    rows[9:9] = [""]
    (f / "log.csv").write_text("\n".join([heading, *(f"img{row}" * bool(row) for row in rows)]))


def names_of_images(f, j, a, s):
    for name, poses, kept in (("robot", a, COUNT), ("marker", s[2:], COUNT - 2)):
        rows = quaternion(poses)[:kept]
        lines = [
            f"{i + COUNT - kept:03}.png,{row}" for i, row in enumerate(text(rows).splitlines())
        ]
        (f / f"{name}.csv").write_text("\n".join([",".join(["frame", *NAMES]), *lines]))


LAYOUTS: dict[str, Callable[..., None]] = {
    "two blocks of rows in one text, arm above marker": blocks,
    "the same without a line between them": halves,
    "a running index, rotation vector before the position": index_column,
    "rows of one table in no order, with the `id` of the other's": index_in_no_order,
    "rotation vector before the position, in metres, without a heading": rotation_first,
    "position in metres and angles in degrees, without a heading": metres_and_degrees,
    "an index with gaps, where some images were left out": index_with_gaps,
    "a remark behind `//`, and a blank line after each row": blank_lines,
    "`cam2target.csv`: the camera in the target": cam2target,
    "`gripper2base`, `cam2target`, `target2cam` side by side": side_by_side,
    "the same beside images": beside_images,
    "OpenCV's storage, `robot_0`, `cam_0`, … matrices": opencv_numbered,
    "OpenCV's storage, `pose1: […]` in two files": opencv_lists,
    "OpenCV's storage, lists `Rotation_Vec` and `Translation_Vec`": opencv_vectors,
    "a JSON for each image, without leading zeros": json_per_image,
    "sections `[1]`, `[2]`, … with `pose = […]` (`.ini`, `.toml`)": sections,
    "sections with `tcp_x = …`, `board_qw = …`": sections_of_names,
    "JSON of lists `quaternion_wxyz`, `translation_mm`": lists_with_units,
    "`.npz` with `R_gripper2base`, `t_gripper2base`, …": npz_opencv,
    "`R_gripper2base.txt` and `t_gripper2base.txt`, …": separate_files,
    "MATLAB, 4×4×N": matlab,
    "a folder `robot/` and one `camera/` of 4×4 texts": folders,
    "headings X, Y, Z, A, B, C and target_x, …": headings,
    "rx, ry, rz in degrees, of no maker": rx_ry_rz,
    "URScript positions and a table of matrices": urscript,
    "4×4 matrices line by line in two texts": matrices_in_text,
    "quaternions w, x, y, z without a heading": wxyz,
    "what `ros2 topic echo` prints of two poses": topic_echo,
    "JSON of arrays, `T_base_flange`, `T_cam_board`": json_arrays,
    "what ROS's `tf_echo` prints, `base_to_tool0`": tf_echo,
    "headings r11, r12, … r33, tx, ty, tz": matrix_headings,
    "headings x_robot, qx_robot, …, T00_camera, T01_camera, …": axis_first,
    "headings of a matrix that count: cam_m0 to cam_m15": counted_entries,
    "`hand_eye.xml` of OpenCV, `flange_0`, `aruco_0`, …": opencv_hand_eye,
    "YAML of records: position, orientation.roll, …": yaml_nested,
    "joint angles without names, and the arm's `.urdf`": joints_alone,
    "joint angles of ROS by alphabet, and the arm's `.urdf`": joints_of_ros,
    "OpenCV's storage, 4×4 matrices below each other": stacked_matrices,
    "`O_T_EE` of Franka's logs, 16 numbers column by column": by_columns,
    "a 4×4 text for each time, `arm/1690000003.125.txt`": times_as_names,
    "a YAML for each date and time, `20260131_101502.yaml`": dates_as_names,
    "what Python prints of arrays, `array([[…]])`": printed_arrays,
    "a folder in a folder, alone": nested,
    "`rostopic echo -p`, times in ns without a unit": rostopic,
    "centimetres, `x_cm`": centimetres,
    "headings r1 to r9 and t1 to t3": counted_apart,
    "headings X-Position [mm], Winkel A [°], decimal commas": bracketed_units,
    "units in a line under the heading": units_below,
    "empty cells where the target was not seen": empty_cells,
    "zeros where the target was not seen": zeros,
    "MATLAB, cells of 4×4 matrices": matlab_cells,
    "Fortran's exponents, `1.5D+02`": fortran,
    "a sphere's centres beside the arm's poses": centres,
    "samples of MoveIt's calibration, the camera in the hand": moveit,
    "columns between vertical bars": bars,
    "headings q0 to q3": counted_quaternion,
    "`.npz` of a calibration by OpenCV, with its `rvecs` and `tvecs`": calibration,
    "the number of rows in the first line": count_first,
    "one text, `robot 0` above a matrix, then `marker 0`, `robot 1`, …": in_turn,
    "`base_to_ee` and `cam_to_tag`, as ROS names poses": named_as_in_ros,
    "one below the other, a column says `robot` or `marker`": one_below_the_other,
    "the same, first all `tcp`, then all `tag`, with times": below_by_time,
    "headings Robot X (mm), …, tvec_0, rvec_0, …": counted_vectors,
    "`actual_TCP_pose_0`, … of UR's recorder, and a table of the target": recorder_of_ur,
    "`scene_gt.json` of BOP's data sets, `cam_R_m2c`, `cam_t_m2c`": benchmark_of_poses,
    'a list in a cell, `"[0.4, -0.1, …]"`': lists_in_cells,
    "headings robot_0_0, robot_0_1, … of matrices": entries_by_two_numbers,
    "headings T_base_tcp[0,0], T_base_tcp[0,1], …": entries_in_brackets,
    "a remark behind each row, `# pose 3`": remarks_behind,
    "`tool_pose.theta_x`, as Kinova calls its angles": kinova,
    "MATLAB, an array of structures": matlab_structures,
    "headings trans.x, …, rot.q1, … rot.q4": names_of_abb,
    "Mitsubishi's positions, `P1=(…)(7,0)`": melfa,
    "Epson's X, Y, Z, U, V, W": epson,
    "`ros2 topic echo --csv`, a stamp and a frame before the pose": topic_as_csv,
    "`fMe.txt` and `cMo.txt`, as ViSP names poses": names_of_visp,
    "XML of elements with attributes, `<robot x=… y=…/>`": xml_attributes,
    "tables of Markdown, each under a title": markdown,
    "a Python file, `robot.append(np.array(…))`, `marker_poses = […]`": python_lists,
    "lines of a log, `[INFO] [1690.25] [calib]: robot pose: […]`": lines_of_a_log,
    "lines `robot: x=… y=…; marker: x=… y=…`": labelled,
    "HALCON's pose files, `r …` and `t …`": halcon,
    "COLMAP's `images.txt`, in no unit of length": colmap,
    "nerfstudio's `transforms.json`, with the camera's axes of OpenGL": nerfstudio,
    "Metashape's `cameras.xml`": metashape,
    "JSON of `robot_positions`, `robot_quaternions`, …": apart_by_name,
    "a time before position and rotation vector, without a heading": times_before_six,
    "German headings in UTF-16: Drehung A [Grad], Marker X [mm]": german,
    "Chinese headings in GB 18030: 机器人X(mm), 标定板RX(度)": chinese,
    "Chinese headings: 位置X/毫米, 四元数W, in `机器人位姿.csv` and `标定板位姿.csv`": chinese_quaternions,
    "French headings: Rotation RX (°), Mire X (mm)": french,
    "Spanish headings: Posición X, Giro X, in `robot.csv` and `marcador.csv`": spanish,
    "marks between thousands, `1.234,56`": thousands,
    "comments behind `;` and `!`": other_comments,
    "a row of `nan`, and a blank line between rows": gaps,
    "names of images, of which the marker's table lacks some": names_of_images,
}
"""What is in the folder, and how it is written."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_is_verified_without_an_edit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    LAYOUTS[name](tmp_path / "rec", *session(SEED))
    told = CliRunner().invoke(commands(), ["init", "rec", "--yes"])
    assert told.exit_code == 0, f"{told.output}{told.exception}"
    done = CliRunner().invoke(commands(), ["run", "recipe.yaml", "--out", "out"])
    assert done.exit_code == 0, f"{told.output}{done.output}{done.exception}"
    assert "\nVERIFIED " in done.output
    answer = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))["transforms"]
    assert np.allclose(answer["flange_T_camera"]["matrix"], FLANGE_T_CAMERA, atol=2e-3)


def test_the_page_lists_these_layouts() -> None:
    shelf = PAGE.read_text("utf-8").partition("## Layouts that are known")[2].partition("\n## ")[0]
    rows = [line.split("|") for line in shelf.splitlines() if line[:1] == "|"]
    listed = [row[1].strip() for row in rows[2:]]
    assert listed == list(LAYOUTS)


def test_joint_angles_are_no_poses_and_ask_for_their_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    joints_alone(tmp_path / "rec", *session(SEED))
    told = CliRunner().invoke(commands(), ["init", "rec", "--yes", "--robot", "none"])
    assert str(told.exception) == (
        "rec/robot.txt: 6 numbers a row; their rotation agrees with the target's in no usual convention of poses; joint angles? name the arm: --robot NAME ('flangeye robots' lists them), or "
        "its .urdf; or say --rotation (kuka, vector, …)"
    )


def test_positions_of_an_unclear_unit_ask_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    _, arm, seen = session(SEED)
    for name, poses in (("robot", arm), ("marker", seen)):
        (tmp_path / "rec" / f"{name}.txt").write_text(text(vector(poses, 100.0), " "))
    told = CliRunner().invoke(commands(), ["init", "rec", "--yes"])
    reach = np.abs(100 * arm[:, :3, 3]).max()
    assert str(told.exception) == (
        f"not known: unit of the positions of robot.txt, which reach {reach:.0f}: far for m, near "
        "for mm; add --length cm"
    )
    told = CliRunner().invoke(commands(), ["init", "rec", "--yes", "--length", "cm"])
    assert told.exit_code == 0, f"{told.output}{told.exception}"
    done = CliRunner().invoke(commands(), ["run", "recipe.yaml", "--out", "out"])
    answer = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))["transforms"]
    assert done.exit_code == 0
    assert np.allclose(answer["flange_T_camera"]["matrix"], FLANGE_T_CAMERA, atol=2e-3)
