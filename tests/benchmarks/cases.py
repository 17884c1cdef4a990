"""The stages and their baselines, on one simulated PhoXi M scan of 3.2 M points."""

import atexit
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flangeye import types as t
from flangeye.files.clouds import read_cloud, write_cloud
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import kabsch
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import Recipe, load_recipe
from flangeye_plugins.fit.ransac import fit_ransac_circle
from flangeye_plugins.fit.rim import fit_rim
from flangeye_plugins.segment.flange import segment_flange
from flangeye_plugins.solve.robust import RobustParams, solve_robust
from flangeye_plugins.solve.svd import solve_svd


class Work(NamedTuple):
    """A call to measure.

    Attributes:
        call: The call.
        input: What it works on, or what the baseline is.
        points: How many points go in, where that is the measure.
        scale: What the measured seconds are multiplied by, where only a part is run.
    """

    call: Callable[[], object]
    input: str
    points: int = 0
    scale: float = 1.0


@cache
def recipe() -> Recipe:
    """Return the demo."""
    return load_recipe(find_recipe("ur5_phoxi-m_simulated"), load_registry())


class Seen(NamedTuple):
    """One full scan and its flange."""

    capture: t.Capture
    flange: t.FlangeCloud


@cache
def stages() -> Seen:
    """Return what the benchmarks work on."""
    capture = next(iter(_acquire()))
    assert isinstance(capture, t.Capture)
    return Seen(capture, segment_flange(capture, **_asked(segment_flange)))


def _acquire() -> t.Captures:
    step = recipe().steps[0]
    return step.stage(**_asked(step.stage), params=step.params)


def _asked(stage) -> dict[str, object]:
    """Return what a stage asks the recipe's header for, and default parameters."""
    context = recipe().context
    given = {n: context[need] for n, need in stage.needs.items() if need in context}
    if stage.params and stage.kind != "acquire":
        given["params"] = stage.params()
    return given


def acquire() -> tuple[Work, Work]:
    """A simulated scan, beside casting as many rays alone."""
    import open3d as o3d

    captures = iter(_acquire())
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.t.geometry.TriangleMesh.create_sphere(0.3))
    ends = ([0, 0, 0], [0, 0, -1], [0, 1, 0])
    centre, eye, up = (o3d.core.Tensor.from_numpy(np.array(end, np.float32)) for end in ends)
    rays = scene.create_rays_pinhole(47, centre, eye, up, 2064, 1544)
    return (
        Work(lambda: next(captures), "2064 x 1544 pixels", 2064 * 1544),
        Work(lambda: scene.cast_rays(rays, nthreads=1), "as many rays cast at a sphere by open3d"),
    )


def _pass_over_depths() -> Work:
    xyz = stages().capture.cloud.xyz
    return Work(lambda: np.isfinite(xyz[..., 2]), "one isfinite over its depths")


def segment() -> tuple[Work, Work]:
    """The flange out of a full scan."""
    capture = stages().capture
    return (
        Work(
            lambda: segment_flange(capture, **_asked(segment_flange)),
            "organised scan", capture.cloud.xyz.size // 3,
        ),
        _pass_over_depths(),
    )  # fmt: skip


def segment_unorganised() -> tuple[Work, Work]:
    """The same without the scanner's image."""
    from dataclasses import replace

    capture = stages().capture
    loose = replace(capture, cloud=t.PointCloud(t.CAMERA, capture.cloud.points()))
    return (
        Work(
            lambda: segment_flange(loose, **_asked(segment_flange)),
            "unorganised scan", len(loose.cloud.xyz),
        ),
        _pass_over_depths(),
    )  # fmt: skip


def fit() -> tuple[Work, Work]:
    """fit.rim beside the paper's 10,000 draws as fit.ransac_circle does them."""
    flange = stages().flange
    return (
        Work(lambda: fit_rim(flange, **_asked(fit_rim)), "flange", len(flange.cloud.xyz)),
        Work(lambda: fit_ransac_circle(flange, **_asked(fit_ransac_circle)), "fit.ransac_circle"),
    )


def ransac() -> tuple[Work, Work]:
    """The paper's fit beside a loop that draws one circle at a time, 1 % of its draws timed."""
    flange = stages().flange
    points = flange.cloud.points().astype(float)
    rng = np.random.default_rng(0)

    def loop() -> None:
        for _ in range(100):
            a, b, c = points[rng.integers(0, len(points), 3)]
            np.count_nonzero(np.abs(np.linalg.norm(points - (a + b + c) / 3, axis=1) - 0.03) < 3e-4)

    return (
        Work(
            lambda: fit_ransac_circle(flange, **_asked(fit_ransac_circle)),
            "flange, 10,000 draws", len(points),
        ),
        Work(loop, "a loop over draws in numpy", scale=100),
    )  # fmt: skip


def _observations(n: int = 75) -> list[t.Observation]:
    rng = np.random.default_rng(0)
    observations = []
    for i in range(n):
        pose = np.eye(4)
        pose[:3, 3] = rng.uniform(-0.15, 0.15, 3)
        centre = pose[:3, 3] + rng.normal(0, 1e-4, 3)
        circle = t.CircleFeature(centre, None, {"rim": 0.03}, 1e-8 * np.eye(3), None, 1.0)
        observations.append(
            t.Observation(f"{i}", circle, t.by_frame(t.Transform(t.BASE, t.FLANGE, pose)))
        )
    return observations


def _solver(stage, observations: list[t.Observation]) -> object:
    return stage(
        observations=t.Observations(observations, t.Source("")),
        **_asked(stage) | {"robot": None} if "robot" in stage.needs else _asked(stage),
    )


def solve() -> tuple[Work, Work]:
    """solve.svd beside the registration alone."""
    observations = _observations()
    camera = np.array([o.circle.centre for o in observations])
    base = np.array([o.tcp_in_base for o in observations])
    return (
        Work(lambda: _solver(solve_svd, observations), "75 poses"),
        Work(lambda: kabsch(camera, base), "one SVD of a 3 x 3 matrix"),
    )


def _matrix() -> Work:
    """A yardstick that no change of ours moves."""
    square = np.random.default_rng(0).normal(size=(300, 300))
    return Work(lambda: np.linalg.eigh(square @ square.T), "eigenvectors of a 300 x 300 matrix")


def _calibrated(kind: str, count: int) -> tuple[Work, Work]:
    """solve.robust with held-out errors, of poses of an arm by a foreign generator."""
    from flangeye.models.loading import load_model
    from flangeye_plugins.verify.holdout import HoldoutParams, verify_holdout
    from tests.estimation import foreign

    rotation, place = (size**2 * np.eye(3) for size in foreign.NOISE[kind])
    both, joined = np.kron(np.diag([1.0, 0.0]), rotation), np.kron(np.diag([0.0, 1.0]), place)
    session = foreign.session(kind, foreign.UR5E, 0.3e-3, count, 1)
    observations = [
        t.Observation(
            f"{i}",
            t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, seen), both + joined)
            if kind == "marker"
            else t.CircleFeature(seen[:3, 3], seen[:3, 2], {"rim": 0.03}, place, rotation, 1.0),
            t.by_frame(t.Transform(t.BASE, t.FLANGE, pose)),
        )
        for i, (pose, seen) in enumerate(zip(session.reported, session.seen, strict=True))
    ]
    configuration = Configuration(stands=None if kind == "marker" else ORIGIN)
    asked = {"robot": load_model("robots", "ur5e"), "configuration": configuration}

    def calibrate() -> None:
        found = solve_robust(t.Observations(observations, t.Source("")), RobustParams(), **asked)
        verify_holdout(found, lambda _: found, HoldoutParams(), **asked)

    return Work(calibrate, f"{count} of a {kind}, with held-out errors"), _matrix()


def _session_of_many(command: str, count: int) -> tuple[Work, Work]:
    """A command on so many marker poses in two tables, a whole process, beside importing numpy."""
    from tests.estimation import foreign
    from tools.injected import plain, recipe_of

    folder = Path(tempfile.mkdtemp())
    session = foreign.session("marker", foreign.UR5E, 0.1e-3, count, 1)
    rows = plain(session.reported, session.seen)
    np.savetxt(folder / "arm.txt", rows.arm)
    np.savetxt(folder / "marker.txt", rows.marker)
    (folder / "recipe.yaml").write_text(recipe_of(rows, in_hand=False))
    out, given = folder / "out", () if command == "doctor" else ("--out", str(folder / "out"))
    call = _flangeye(command, str(folder / "recipe.yaml"), *given)

    def anew() -> object:
        shutil.rmtree(out, ignore_errors=True)
        return call()

    return Work(anew, f"flangeye {command}, {count} poses"), help_text()[1]


def read() -> tuple[Work, Work]:
    """A binary PCD of a full scan beside numpy's reading of its bytes."""
    cloud = stages().capture.cloud
    path = Path(tempfile.mkdtemp()) / "scan.pcd"
    write_cloud(path, cloud)
    return (
        Work(lambda: read_cloud(path, "m"), "binary PCD", cloud.xyz.size // 3),
        Work(lambda: np.fromfile(path, np.uint8), "the bytes, by numpy"),
    )


def record() -> tuple[Work, Work]:
    """A full scan into the log beside compressing its bytes."""
    from flangeye.workflow.log.record import Recorder

    capture, folder = stages().capture, Path(tempfile.mkdtemp())
    recorder = Recorder(folder / "run.mcap", {}, full_clouds=True)
    atexit.register(recorder.close)

    def compressed() -> None:
        import zstandard

        zstandard.compress(capture.cloud.xyz.tobytes())

    return (
        Work(
            lambda: recorder.flangeye_captured("0.acquire", capture, 0.0),
            "a whole scan to MCAP", capture.cloud.xyz.size // 3,
        ),
        Work(compressed, "zstandard on the same bytes"),
    )  # fmt: skip


def finger() -> tuple[Work, Work]:
    """Reading one image of a finger beside blurring it; 60 images a second are asked for."""
    import cv2

    from flangeye.devices import SensorFrame
    from flangeye.files.paths import bundled
    from flangeye.models.finger import Finger
    from flangeye.models.model import read_model
    from flangeye_emulators.finger.sensor import FingerCamera, typical_compliance
    from flangeye_plugins.weld.finger_camera import FingerReader

    model = read_model(bundled("data") / "fingers" / "srm.yaml", Finger)
    camera = FingerCamera(model, np.random.default_rng(0))
    frame = SensorFrame(camera.image(*typical_compliance().tag(np.array([2e-3, 0.0, 1e-3]))), 0)
    reader = FingerReader(model)
    pixels = frame.image.pixels
    return (
        Work(lambda: reader.read(frame), "an image of a finger", pixels.size),
        Work(lambda: cv2.GaussianBlur(pixels, (0, 0), 3.0), "OpenCV's Gaussian blur of it"),
    )


def cycle() -> tuple[Work, Work]:
    """A cycle of the weld's controller with a new touch in it, the slowest kind; 2 ms are allowed."""
    from flangeye.motion.seam_following import ToolPose, Touch
    from flangeye_plugins.weld.following.follower import Follower
    from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
    from flangeye_plugins.weld.following.task import WeldTask
    from flangeye_plugins.weld.path import Path as Plan
    from flangeye_plugins.weld.settings import Following

    x = np.linspace(0.0, 2.0, 2000)
    plan = Plan(np.column_stack([x, 0.02 * np.sin(x / 0.1), 0.0 * x]))
    follower, clock = Follower(WeldTask(plan, ModelPrior(40e-3), Following())), itertools.count()

    def turn() -> None:
        time = next(clock) * 2e-3
        at = plan.at(5e-3 + 5e-3 * max(time - 1.0, 0.0))
        position = np.array([*(at.point + 2e-3 * at.normal), at.height - 1.5e-3])
        angle = float(np.arctan2(at.tangent[1], at.tangent[0]))
        if follower.phase == "probing":  # a sweep that found nothing wrong
            follower._follow(SweepFit())
        assert follower.phase in ("seeking", "following"), follower.reason
        bent = np.array([0, -2e-3, 1.5e-3]) if time > 0.5 else np.zeros(3)  # free at first
        follower.step(ToolPose(time, position, angle), [Touch(time, bent)])

    for _ in range(6000):  # until the torch has what was felt on both of its sides
        turn()
    square = np.random.default_rng(0).normal(size=(40, 40))
    return (
        Work(turn, "a cycle of the controller"),
        Work(lambda: np.linalg.inv(square), "the inverse of a 40 x 40 matrix"),
    )


def _command(*words: str, **variables: str) -> Callable[[], object]:
    """Return a call of Python in a process of its own, its bytecode cached.

    It returns what the process held at most [MB].
    """
    environment = os.environ | {"PYTHONPYCACHEPREFIX": tempfile.mkdtemp()} | variables
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command, silent = [sys.executable, "-P", *words], subprocess.DEVNULL

    def call() -> float:
        process = subprocess.Popen(command, env=environment, stdout=silent, stderr=silent)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, command)
        return used.ru_maxrss / 1024

    return call


def _flangeye(*words: str) -> Callable[[], object]:
    return _command("-m", "flangeye.cli", *words)


def help_text() -> tuple[Work, Work]:
    """The help of the command, beside importing numpy."""
    return (
        Work(_flangeye("--help"), "flangeye --help"),
        Work(_command("-c", "import numpy"), "python -c 'import numpy'"),
    )


def check() -> tuple[Work, Work]:
    """Checking a recipe, a whole process, beside importing numpy."""
    words = ("check", "ur5_phoxi-m_simulated")
    return Work(_flangeye(*words), "flangeye check"), help_text()[1]


PUBLISHED = Path(__file__).parents[3] / "shared" / "data" / "ancorasir"
"""The authors' recordings, where they are."""


def _run_of_published(out: Path) -> Callable[[], object]:
    words = ("run", "aubo-i5_phoxi-s_archive", "--archive", str(PUBLISHED), "--out", str(out))
    return _flangeye(*words)


def archive() -> tuple[Work, Work] | None:
    """The published clouds to a verified matrix, a whole process, beside reading their bytes."""
    if not PUBLISHED.is_dir():
        return None
    clouds = sorted((PUBLISHED / "data" / "aubo").rglob("*.pcd"))
    out = Path(tempfile.mkdtemp()) / "run"
    run = _run_of_published(out)

    def anew() -> None:
        shutil.rmtree(out, ignore_errors=True)
        run()

    return (
        Work(anew, "the published recordings"),
        Work(lambda: [np.fromfile(path, np.uint8) for path in clouds], "their clouds' bytes"),
    )


def report() -> tuple[Work, Work] | None:
    """The report of that run once more, a whole process, beside importing numpy."""
    if not PUBLISHED.is_dir():
        return None
    out = Path(tempfile.mkdtemp()) / "run"
    _run_of_published(out)()
    return Work(_flangeye("report", str(out)), "the run of 30 published clouds"), help_text()[1]


CASES: dict[str, Callable[[], tuple[Work, Work] | None]] = {
    "segment.flange": segment,
    "segment.flange, loose": segment_unorganised,
    "fit.rim": fit,
    "fit.ransac_circle": ransac,
    "solve.svd": solve,
    "calibrate, 50": partial(_calibrated, "flange", 50),
    "calibrate, 200": partial(_calibrated, "marker", 200),
    "calibrate, 5000": partial(_calibrated, "marker", 5000),
    "run, 5000": partial(_session_of_many, "run", 5000),
    "doctor, 1000": partial(_session_of_many, "doctor", 1000),
    "archive to matrix": archive,
    "report": report,
    "acquire.simulated": acquire,
    "read_cloud": read,
    "log": record,
    "flangeye check": check,
    "flangeye --help": help_text,
    "finger": finger,
    "cycle": cycle,
}

GOALS = {
    "segment.flange": "20",
    "segment.flange, loose": "40",
    "fit.rim": "0.06",
    "calibrate, 50": "0.15 s",
    "calibrate, 200": "0.4 s",
    "calibrate, 5000": "8 s, 300 MB",
    "doctor, 1000": "20 s",
    "archive to matrix": "3 s",
    "report": "0.5 s",
    "acquire.simulated": "1.2",
    "log": "0.4",
    "flangeye check": "2",
    "flangeye --help": "1.2",
}
"""The ratio, or the seconds, that is aimed at."""
