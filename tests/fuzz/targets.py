"""What is fuzzed: for each sort of input sound seeds, and the reader that must refuse or read."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flangeye.errors import FlangeyeError
from tests.crafted import rewritten

Seeds = Callable[[Path], list[bytes]]
SEEDS = Path(__file__).with_name("seeds")
"""Inputs that once broke something, by target: ``seeds/<target>/<anything>``."""


class Target(NamedTuple):
    """A sort of input.

    Attributes:
        suffix: Of its file.
        seeds: Sound examples, made in a folder.
        read: Reads the file at a path; whatever but FlangeyeError it raises is a find.
    """

    suffix: str
    seeds: Seeds
    read: Callable[[Path], object]


def survives(target: Target, path: Path) -> bool:
    """Return whether a file was read (True) or refused in one message (False).

    Raises:
        Exception: Anything else: a find.
    """
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            target.read(path)
    except FlangeyeError as error:
        assert str(error)
        return False
    return True


@cache
def _registry():
    from flangeye.plugin.registry import load_registry

    return load_registry()


@cache
def _toys():
    from tests.conftest import toy_plugins

    return toy_plugins()


@cache
def sound_log(folder: Path) -> Path:
    """Return a whole log of the toy stages."""
    from flangeye.workflow.recipe.load import load_recipe
    from flangeye.workflow.run.folder import RunFolder
    from flangeye.workflow.run.session import Start, record_run
    from tests.conftest import TOY_RECIPE

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "toy.yaml").write_text(TOY_RECIPE)
    made = RunFolder.create("toy", folder / "run")
    recipe = load_recipe(folder / "toy.yaml", _toys())
    record_run(recipe, _toys(), made, Start(), report=False)
    return made.log


def _recipes(folder):
    from flangeye.workflow.recipe.find import recipe_names

    names = ("ur5_phoxi-m_simulated", "ur5e_phoxi-m_loopback", "aubo-i5_phoxi-s_archive")
    return [recipe_names()[name].read_bytes() for name in names]


def _check_recipe(path):
    from flangeye.workflow.recipe.load import load_recipe

    load_recipe(path, _registry())


def _overrides(folder):
    return [
        b"steps.2.inlier=0.2 mm", b"robot.limits.box.size=[1 m, 1 m, 1 m]", b"seed=3", b"title=x",
        b"robot.limits.box.centre=[0 m, 0 m, 0 m]", b"steps.0.view={guess: {position: [1 m, 0 m, 1 m]}}",
    ]  # fmt: skip


def _check_override(path):
    from flangeye.workflow.recipe.find import find_recipe
    from flangeye.workflow.recipe.load import load_recipe

    text = path.read_bytes().decode("utf-8", "replace")
    load_recipe(find_recipe("ur5e_phoxi-m_loopback"), _registry(), [text])


def _models(folder):
    from flangeye.files.paths import bundled

    return [(bundled("data") / "robots" / f"{name}.yaml").read_bytes() for name in ("ur5", "ur5e")]


def _read_model(path):
    from flangeye.models.model import read_model
    from flangeye.models.robots import RobotModel

    read_model(path, RobotModel)


def _pcd(folder):
    from flangeye.files.clouds import write_cloud
    from flangeye.types import CAMERA, PointCloud

    xyz = np.random.default_rng(0).normal(size=(6, 8, 3)).astype(np.float32)
    write_cloud(folder / "a.pcd", PointCloud(CAMERA, xyz))
    raw = (folder / "a.pcd").read_bytes()
    head, _, _ = raw.partition(b"DATA")
    rows = "\n".join(" ".join(map(str, row)) for row in xyz.reshape(-1, 3))
    return [raw, head + b"DATA ascii\n" + rows.encode() + b"\n"]


PLY = (
    "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
)
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")


def _ply(folder):
    faces = b"".join(b"\x03" + np.array(f, "<i4").tobytes() for f in ([0, 1, 2], [0, 2, 3]))
    rows = "\n".join(" ".join(map(str, row)) for row in CORNERS)
    return [
        PLY.format("binary_little_endian").encode() + CORNERS.tobytes() + faces,
        f"{PLY.format('ascii')}{rows}\n3 0 1 2\n3 0 2 3\n".encode(),
    ]


def _stl(folder):
    facet = np.zeros(1, dtype=[("n", "<3f4"), ("v", "<9f4"), ("a", "<u2")])
    facet["v"] = CORNERS[:3].reshape(-1)
    return [b"solid".ljust(80) + (1).to_bytes(4, "little") + facet.tobytes(),
            b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
            b"endloop\nendfacet\nendsolid a\n"]  # fmt: skip


def _npy(folder):
    out = io.BytesIO()
    np.save(out, CORNERS)
    return [out.getvalue()]


def _npz(folder):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("arr_0.npy", _npy(folder)[0])
    return [out.getvalue()]


def _poses(folder):
    return [
        b"cloud,x_m,y_m,z_m,qx,qy,qz,qw\n00.pcd,0.1,0.2,0.3,0,0,0,1\n01.pcd,0.2,0,0.3,0,0,0,1\n"
    ]


def _images(folder):
    import cv2

    pixels = np.arange(48, dtype=np.uint8).reshape(6, 8)
    return [cv2.imencode(kind, pixels)[1].tobytes() for kind in (".png", ".bmp", ".jpg", ".tif")]


def _logs(folder):
    raw = sound_log(folder / "sound").read_bytes()
    return [raw, raw[:5000]]


def _rewritten(folder):
    """Texts that say which topic gets which content: the log's checksums are made anew."""
    topics = ["/source", "/capture", "/capture/cloud", "/step/1.segment.toy", "/step/2.fit.toy",
              "/step/3.solve.toy", "/step/4.verify.toy", "/capture/finished", "/log", "/rejection",
              "result.json", "recipe.yaml", "recipe.resolved.yaml"]  # fmt: skip
    held: dict[str, bytes] = {}
    rewritten(sound_log(folder / "sound"), folder / "copy.mcap",
              lambda name, data: (name, held.setdefault(name, data)))  # fmt: skip
    return [t.encode() + b"\n" + held[t] for t in topics if t in held]


def _read_log(path):
    from rich.console import Console

    from flangeye.cli.details import print_log
    from flangeye.workflow.log.read import read_notes, read_run

    log = read_run(path)
    print_log(Console(file=io.StringIO()), log)
    log.observations(), log.views(), list(log.readings())
    for message in log.notes:
        assert str(path) in message
    list(read_notes(path))


def _read_rewritten(path):
    topic, _, content = path.read_bytes().partition(b"\n")
    name = topic.decode("utf-8", "replace")
    source = sound_log(path.parent / "sound")
    changed = rewritten(source, path.with_suffix(".mcap"),
                        lambda n, data: (n, content if n == name else data))  # fmt: skip
    _read_log(changed)
    _follow(changed)


def _follow(path):
    from flangeye.errors import StageError
    from flangeye.workflow.log.watch import RunView, follow

    def wait():
        raise StageError("no more")

    view = RunView("run")
    for message in follow(path, wait, view.note):
        view.take(message)
    view.rendered()


def _read_cloud(path):
    from flangeye.files.clouds import read_cloud

    read_cloud(path)


def _read_mesh(path):
    from flangeye.models.workpiece import read_mesh

    read_mesh(path)


def _read_npz(path):
    from flangeye.files.arrays import read_arrays

    read_arrays(path)


def _read_image(path):
    from flangeye_plugins.acquire.camera import read_image

    read_image(path)


def _read_poses(path):
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    (folder / "poses.csv").write_bytes(path.read_bytes())
    for name in ("00.pcd", "01.pcd"):
        (folder / name).touch()
    _registry().part("reader.folder").bind()(folder)


def _records(folder):
    record = {"robot": {"x": 0.4, "y": -1e-3}, "seen": [[1, 0], [0, 1]], "image": "0.png"}
    return [json.dumps([record, record]).encode(), json.dumps({"a.ply": [1, 2.5]}).encode()]


def _programs(folder):
    return [
        b"movel(p[0.4, -0.1, 0.3, 2.2, 0.1, 0], a=1.2)\nend\n",
        b"XP={X 400,Y -1.5e2,Z 300,A 10,B 0,C 180,S 2,T 35}\n",
        b"X = 4.0 mm,\tY = 1 mm,\tZ = 3 mm,\n W = 1 deg,\tP = 0 deg,\tR = 2 deg\n",
        b"p:=[[400,-100,300],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
        b"# t x y\n1;2,5;3\n4;5;6\n",
    ]


def _read_table(path):
    from flangeye.files.tables import number_of, read_table

    table = read_table(path.parent, path.name)
    first = table.rows[0][1] if table.rows else ()
    table.numbers([i for i, cell in enumerate(first) if number_of(cell) is not None])


def _matrices(suffix):
    def written(folder):
        import cv2

        file = folder / f"sound{suffix}"
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
        for i in range(3):
            storage.write(f"T1_{i}", np.eye(4))
        storage.release()
        return [file.read_bytes()]

    return written


def _bags(suffix):
    def recorded(folder):
        from tests.plugins.reader import bags

        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 0, 3] = 0.3, 0.4, 0.5
        times, held, middles = bags.stops(poses, rate=10)
        told = [
            ("/pose", t, bags.pose_stamped(t, pose)) for t, pose in zip(times, held, strict=True)
        ]
        told += [("/points", t, bags.point_cloud(t, np.ones((4, 3)))) for t in middles]
        bag = bags.write_bag(folder / f"bag{suffix}", suffix.removeprefix("."), told)
        return [next(bag.glob(f"*{suffix}")).read_bytes()]

    return recorded


def _read_bag(path):
    _registry().part("reader.ros2_bag").bind()(path)


def _read_arrays(path):
    from flangeye.files.tables import tables_in

    tables_in(path.parent, path.name)


def _read_json(path):
    from flangeye.errors import StageError
    from flangeye.workflow.log.read import decode_json

    try:
        decode_json(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise StageError(str(error) or type(error).__name__) from None


def _histories(folder):
    from flangeye.types import BASE, FLANGE, CircleFeature, Observation, Transform, by_frame
    from flangeye.workflow.doctor.monitor.history import CheckFinding, History, MonitorCheck

    def seen(i):
        circle = CircleFeature(
            np.array([0.1, 0.2, 1.0 + i / 1000]), np.array([0.0, 0.0, -1.0]), {"rim": 0.03},
            1e-9 * np.eye(3), 1e-8 * np.eye(3), 0.9,
        )  # fmt: skip
        pose = by_frame(Transform(BASE, FLANGE, np.eye(4)))
        return Observation(f"scan-{i}", circle, pose, np.zeros(6))

    history = History(folder / "sound.jsonl", "a calibration")
    for i in range(3):
        history.checks.append(MonitorCheck(f"run {i}", (seen(2 * i), seen(2 * i + 1)), 10**18 + i))
        history.findings.append(CheckFinding(i, "MOVED", 1e-3, (0.0,) * 6, i, 2.0, "scanner", 0.9))
    history.write()
    return [history.path.read_bytes()]


def _read_history(path):
    from flangeye.workflow.doctor.monitor.chart import _axis, sentence
    from flangeye.workflow.doctor.monitor.history import History, as_json

    history = History.read(path, "a calibration")
    for finding in history.findings:
        json.loads(as_json(history, finding, False))
        sentence(finding)
    _axis(history)
    history.sightings()


def _read_spoilt_history(path):
    """What is read of a spoilt file is what was written, to the last bit."""
    _read_history(path)
    sound = _histories(path.parent)[0]
    assert path.read_bytes().partition(b"\n")[2] == sound.partition(b"\n")[2], "read, and changed"


def _read_signed_history(path):
    """Its checksum is made anew, as whoever forges one would."""
    body = path.read_bytes().partition(b"\n")[2]
    digest = hashlib.sha256(b"a calibration\n" + body).hexdigest()
    head = {"format": "flangeye.monitor.2", "calibration": "a calibration", "sha256": digest}
    path.write_bytes(json.dumps(head).encode() + b"\n" + body)
    _read_history(path)


def _urdfs(folder):
    joint = (
        '<link name="link_{1}"><collision><origin xyz="0 0 0.1"/><geometry>{2}</geometry></collision>'
        '</link><joint name="j{1}" type="revolute"><parent link="link_{0}"/><child link="link_{1}"/>'
        '<origin xyz="0.1 0 0.2" rpy="0 1.57 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-2" upper="2" effort="0" velocity="1"/></joint>'
    )
    bodies = ('<cylinder radius="0.1" length="0.2"/>', '<box size="0.1 0.2 0.3"/>',
              '<mesh filename="m.stl" scale="1 1 1"/>')  # fmt: skip
    links = "".join(joint.format(i, i + 1, bodies[i]) for i in range(3))
    flange = ('<link name="flange"/><joint name="f" type="fixed"><parent link="link_3"/>'
              '<child link="flange"/></joint>')  # fmt: skip
    return [f'<robot name="r"><link name="link_0"/>{links}{flange}</robot>'.encode()]


def _read_urdf(path):
    from flangeye.models.urdf import robot_from_urdf

    (path.parent / "m.stl").write_bytes(_stl(path.parent)[0])
    robot = robot_from_urdf(path)
    assert max(len(str(note)) for note in robot.notes) < 2000
    robot.filled()


def _urdf_mesh(kind):
    def made(folder):
        import trimesh

        box = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
        raw = trimesh.exchange.export.export_mesh(box, None, file_type=kind)
        return [raw.encode() if isinstance(raw, str) else raw]

    return made


def _read_urdf_mesh(path):
    from flangeye.models.urdf_meshes import vertices

    vertices(path)


def _factories(folder):
    rows = "\n".join(
        f"delta_{name} = [ 0.001, -0.002, 0.0, 1e-4, 0.0, 0.0]"
        for name in ("theta", "a", "d", "alpha")
    )
    return [f"[mounting]\n{rows}\ncalibration_status = 0 # Linearised\n".encode()]


def _ros_factories(folder):
    from flangeye.models.factory import LINKS, PLACE

    each = {name: dict.fromkeys(PLACE, 0.1) for name in LINKS}
    return [json.dumps({"kinematics": {**each, "hash": "calib_1"}}).encode()]


def _read_factory(path):
    from flangeye.models.factory import as_built
    from flangeye.models.loading import load_model

    as_built(load_model("robots", "ur5e"), path)


def _names(folder):
    return [b"poses.csv", b"*.json", b"a/pose_*.json", b"poses.csv:1/2", b"poses.json:robot,marker"]


def _read_named(path):
    from flangeye.files.tables import read_table

    folder = path.with_suffix("")
    (folder / "a").mkdir(parents=True, exist_ok=True)
    (folder / "poses.csv").write_bytes(b"1,2,3\n4,5,6\n")
    for i in range(3):
        (folder / "a" / f"pose_{i}.json").write_text('{"x": 1, "y": 2}')
    (folder / "poses.json").write_text('{"robot": [[1, 2, 3]], "marker": [[1, 2, 3]]}')
    read_table(folder, path.read_bytes().decode("utf-8", "replace"))


def _read_url(path):
    from flangeye.files.remote import is_url, remote_fingerprint, results_at, system_of

    url = path.read_bytes().decode("utf-8", "replace")
    if is_url(url):
        system_of(url)
        remote_fingerprint(url)
    else:
        with results_at(url):
            pass


def _read_request(path):
    """A request as it comes over the wire: first line, then headers with cookies."""
    import asyncio

    from flangeye_ui.server import Gate, Keys

    first, *lines = path.read_bytes().split(b"\n")
    method, _, rest = first.partition(b" ")
    where, _, query = rest.partition(b"?")
    headers = [(k.lower(), v.strip()) for k, _, v in (line.partition(b":") for line in lines)]
    text = where.decode("latin-1")
    scope = {"type": "http", "method": method.decode("latin-1"), "path": text, "root_path": "",
             "raw_path": where, "query_string": query, "headers": headers, "scheme": "http",
             "http_version": "1.1", "server": ("127.0.0.1", 8080), "client": ("127.0.0.1", 1)}  # fmt: skip
    answers = []

    async def receive():
        return {"type": "http.request", "body": b""}

    async def send(message):
        answers.append(message)

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    keys = Keys.__new__(Keys)
    keys.path, keys.token, keys._cookie, keys._sessions = "/x", "secret", "flangeye", [b"known"]
    keys._issued = lambda token: None
    asyncio.run(Gate(app, keys, "127.0.0.1", 8080)(scope, receive, send))
    assert 200 <= answers[0]["status"] < 500, answers


def _requests(folder):
    return [
        b"GET /x/archive?a=b HTTP/1.1\nHost: 127.0.0.1:8080\nCookie: a=b; flangeye=known\n",
        b"GET /?token=secret HTTP/1.1\nHost: localhost:8080\nOrigin: http://localhost:8080\n",
    ]


def _results(folder):
    held: dict[str, bytes] = {}
    rewritten(sound_log(folder / "sound"), folder / "copy.mcap",
              lambda name, data: (name, held.setdefault(name, data)))  # fmt: skip
    return [held["result.json"]]


def _read_certified(path):
    from flangeye.workflow.report.certificate import write_certificate
    from flangeye.workflow.report.certificate.budget import Conditions

    content, source = path.read_bytes(), sound_log(path.parent / "sound")
    changed = rewritten(source, path.with_suffix(".mcap"),
                        lambda n, data: (n, content if n == "result.json" else data))  # fmt: skip
    write_certificate(changed, path.with_suffix(".html"), Conditions(None, None, "", ""))


def _parquets(folder):
    import pyarrow as pa
    import pyarrow.parquet as pq

    out = io.BytesIO()
    rows = [{"session": "a", "status": "verified", "report": None, "rms": 1.0}]
    pq.write_table(pa.Table.from_pylist(rows, _batch_columns()), out)
    return [out.getvalue()]


@cache
def _batch_columns():
    import pyarrow as pa

    return pa.schema({"session": pa.string(), "status": pa.string(), "report": pa.string(),
                      "rms": pa.float64()})  # fmt: skip


def _read_batch(path):
    from flangeye.files.paths import storage_at
    from flangeye.workflow.batch.dataset import FOLDER, Dataset

    folder = path.with_suffix("")
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    (folder / FOLDER / "000000-a.parquet").write_bytes(path.read_bytes())
    schema = _batch_columns()
    dataset = Dataset(storage_at(str(folder)), dict(zip(schema.names, schema.types, strict=True)))
    dataset._read(f"{FOLDER}/000000-a.parquet").to_pylist()


def _live(*made):
    """Return seeds of messages as they come on a running graph, serialised."""

    def serialised(folder):
        from flangeye_plugins.ros2.messages import encoded
        from tests.plugins.reader import bags

        return [encoded(message) for message in made_by(bags)]

    def made_by(bags):
        return [getattr(bags, name)(1.0, *given) for name, *given in made]

    return serialised


def _read_live(kind):
    def read(path):
        from flangeye_plugins.ros2 import messages
        from flangeye_plugins.scanner.opened import cloud_of

        uses = {
            messages.Type.CLOUD: lambda told: cloud_of(messages.cloud_of(told), 1.0),
            messages.Type.IMAGE: lambda told: (messages.values_of(told), messages.pixels_of(told)),
            messages.Type.COMPRESSED: messages.pixels_of, messages.Type.INFO: messages.intrinsics_of,
            messages.Type.JOINT_STATE: messages.positions_of,
        }  # fmt: skip
        data = path.read_bytes()
        messages.stamp_of(data), messages.frame_of(data)
        asked = messages.Type[kind]
        messages.decoded(data, asked, uses[asked])

    return read


LINES = [
    "0\nSECTION\n2\nENTITIES\n0\nLINE\n10\n0\n20\n1\n11\n5\n21\n1\n0\nENDSEC\n0\nEOF\n",
    "0\nSECTION\n2\nHEADER\n9\n$INSUNITS\n70\n4\n0\nENDSEC\n0\nSECTION\n2\nENTITIES\n"
    "0\nARC\n10\n0\n20\n0\n40\n2\n50\n0\n51\n90\n0\nLWPOLYLINE\n90\n2\n70\n1\n10\n0\n20\n0\n42\n"
    "0.5\n10\n1\n20\n1\n0\nPOLYLINE\n0\nVERTEX\n10\n1\n0\nVERTEX\n10\n2\n0\nENDSEC\n0\nEOF\n",
]  # fmt: skip
"""Drawings, each of a few lines."""


def _read_drawing(path):
    from flangeye.files.drawings import read_dxf

    read_dxf(path)


def _cameras(folder):
    return [
        b"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [600, 0, 320, 0, 600, 240, 0, 0, 1]\n"
        b"distortion_model: plumb_bob\ndistortion_coefficients:\n  data: [0.1, 0, 0, 0, 0]\n",
        b"cam0:\n  camera_model: pinhole\n  intrinsics: [600, 600, 320, 240]\n"
        b"  distortion_model: radtan\n  distortion_coeffs: [0.1, 0, 0, 0]\n",
        b"fx: 600\nfy: 600\nppx: 320\nppy: 240\ncoeffs: [0, 0, 0, 0, 0]\n",
    ]


def _read_camera(path):
    from flangeye.files.cameras import camera_in

    camera = camera_in(path)
    assert camera is None or camera.note()


def _read_colmap(path):
    from flangeye.files.cameras import cameras_in

    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_bytes(path.read_bytes())
    cameras_in(folder)


TARGETS = {
    "ros2-cloud": Target(".cdr", _live(("point_cloud", np.ones((4, 3)))), _read_live("CLOUD")),
    "ros2-image": Target(".cdr", _live(("image", np.zeros((4, 5), np.uint8))), _read_live("IMAGE")),
    "ros2-compressed": Target(
        ".cdr", _live(("compressed", np.zeros((4, 5), np.uint8))), _read_live("COMPRESSED")
    ),
    "ros2-info": Target(
        ".cdr", _live(("camera_info", np.eye(3), (4, 5), "eye")), _read_live("INFO")
    ),
    "ros2-joints": Target(".cdr", _live(("joint_state", np.zeros(6))), _read_live("JOINT_STATE")),
    "drawing": Target(".dxf", lambda f: [text.encode() for text in LINES], _read_drawing),
    "camera": Target(".yaml", _cameras, _read_camera),
    "camera-json": Target(
        ".json",
        lambda f: [
            b'{"fx": 600, "fy": 600, "cx": 320, "cy": 240, "k": [0.1, 0, 0, 0, 0]}',
            b'{"CameraMatrix": {"FX": 1.0, "FY": 1.0, "CX": 2.0, "CY": 3.0}, "d": [0.1]}',
        ],
        _read_camera,
    ),
    "colmap": Target(
        ".txt",
        lambda f: [
            b"# Camera list\n1 OPENCV 640 480 600 600 320 240 0.1 0 0 0\n"
            b"2 SIMPLE_RADIAL 640 480 600 320 240 0.1\n"
        ],
        _read_colmap,
    ),
    "history": Target(".jsonl", _histories, _read_spoilt_history),
    "history-signed": Target(".jsonl", _histories, _read_signed_history),
    "urdf": Target(".urdf", _urdfs, _read_urdf),
    "urdf-stl": Target(".stl", _urdf_mesh("stl"), _read_urdf_mesh),
    "urdf-obj": Target(".obj", _urdf_mesh("obj"), _read_urdf_mesh),
    "urdf-dae": Target(".dae", _urdf_mesh("dae"), _read_urdf_mesh),
    "factory": Target(".conf", _factories, _read_factory),
    "factory-ros": Target(".yaml", _ros_factories, _read_factory),
    "name": Target(".txt", _names, _read_named),
    "url": Target(
        ".txt",
        lambda f: [b"s3://a/b.csv", b"zip://x::https://h/a.zip", b"az://a/b", b"runs/a"],
        _read_url,
    ),
    "request": Target(".http", _requests, _read_request),
    "certificate": Target(".json", _results, _read_certified),
    "batch": Target(".parquet", _parquets, _read_batch),
    "recipe": Target(".yaml", _recipes, _check_recipe),
    "set": Target(".txt", _overrides, _check_override),
    "model": Target(".yaml", _models, _read_model),
    "pcd": Target(".pcd", _pcd, _read_cloud),
    "ply": Target(".ply", _ply, _read_cloud),
    "npy": Target(".npy", _npy, _read_cloud),
    "npz": Target(".npz", _npz, _read_npz),
    "xyz": Target(".xyz", lambda folder: [b"0 0 1\n1 0 1\n", b"x,y,z\n1,2,3\n"], _read_cloud),
    "mesh-ply": Target(".ply", _ply, _read_mesh),
    "mesh-stl": Target(".stl", _stl, _read_mesh),
    "opencv-yaml": Target(".yml", _matrices(".yml"), _read_arrays),
    "opencv-xml": Target(".xml", _matrices(".xml"), _read_arrays),
    "bag-mcap": Target(".mcap", _bags(".mcap"), _read_bag),
    "bag-db3": Target(".db3", _bags(".db3"), _read_bag),
    "image": Target(".png", _images, _read_image),
    "poses": Target(".csv", _poses, _read_poses),
    "records": Target(".json", _records, _read_table),
    "table": Target(".txt", _programs, _read_table),
    "log": Target(".mcap", _logs, _read_log),
    "log-rewritten": Target(".txt", _rewritten, _read_rewritten),
    "json": Target(".json", lambda f: [json.dumps({"a": [1.5, "x"]}).encode()], _read_json),
}
