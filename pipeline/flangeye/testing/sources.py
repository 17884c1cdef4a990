"""``acquire`` stages, ``reader``, ``plan`` and ``view`` parts: where captures come from."""

import itertools
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from flangeye import types as t
from flangeye.files.recording import Archive, check_ids
from flangeye.maths.kinematics import Arm
from flangeye.motion.reach import Site
from flangeye.testing.base import (
    Conformance,
    only,
    plain,
    require,
    require_close,
    require_refusal,
    require_round_trip,
    require_type,
)
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder

REACH = 5.0
"""No arm's flange is farther from its base: a larger number is in millimetres [m]."""


SOURCE_CAMERA = rigid(rotation_exp(np.array([np.pi, 0.0, 0.0])), np.array([0.5, 0.0, 1.1]))
"""``base_T_camera`` of the kit's cell: it looks down at the work."""


class AcquireConformance(Conformance):
    """An ``acquire`` stage: returns a lazy stream of captures or of observations.

    Attributes:
        archive: Recordings to run on, if the stage needs any.
    """

    kind = "acquire"
    archive: ClassVar[Path | None] = None

    def acquired(self, count: int = 3) -> tuple[Any, list[Any]]:
        """Return the stream, and its first captures or observations."""
        stream = self.call({t.ArchivePath: t.ArchivePath(self.archive)})
        require(
            isinstance(stream, (t.Captures, t.Observations)),
            f"gave {type(stream).__name__}, not Captures or Observations",
        )
        items = list(itertools.islice(iter(stream), count))
        if isinstance(stream, t.Captures):
            stream.close()
        require(items, "gave nothing")
        return stream, items

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input and seed give equal captures, to the last bit."""
        (first, some), (again, same) = self.acquired(), self.acquired()
        require(first.source.fingerprint, "the source has no fingerprint")
        require(
            first.source.fingerprint == again.source.fingerprint,
            "the fingerprint differs in a second call",
        )
        require(list(map(plain, some)) == list(map(plain, same)), "two runs' captures differ")

    def test_captures_are_named_and_in_order(self) -> None:
        """Ids are unique; those kept for verifying come first."""
        stream, items = self.acquired(10_000)
        ids = [item.id for item in items]
        require(len(set(ids)) == len(ids), "two captures have the same id")
        total = stream.total
        require(total is None or total == len(items), f"{total} were promised, {len(items)} came")
        roles = [capture.role for capture in only(items, t.Capture)]
        require(
            roles == sorted(roles, key="calibration".__eq__),
            "verification captures must come before calibration captures",
        )

    def test_poses_and_points_are_in_metres_and_frames(self) -> None:
        """Poses are within the arm's reach and points within the scanner's range, in metres."""
        for item in self.acquired()[1]:
            pose = item.base_T_flange
            require((pose.parent, pose.child) == (t.BASE, t.FLANGE), f"a pose is {pose.name}")
            far = float(np.linalg.norm(pose.translation))
            require(far < REACH, f"a flange is {far:.3g} m from its base: not in metres?")
        times = 20.0  # so much nearer or farther than the scanner sees is in another unit
        for capture in only(self.acquired()[1], t.Capture):
            require(capture.cloud.frame == t.CAMERA, f"a cloud is in '{capture.cloud.frame}'")
            points = capture.cloud.points()
            depth = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
            near, limit = self.scanner.near / times, self.scanner.far * times
            require(near < depth < limit, f"a scan's middle is {depth:.3g} m away: not in metres?")

    def test_captures_survive_the_log(self) -> None:
        """Scans, poses and joints come back from MCAP as they went in."""
        for capture in only(self.acquired()[1], t.Capture):
            require_round_trip(capture, logged)

    def test_a_missing_archive_is_refused(self) -> None:
        """A stage without the recordings that it needs is refused in one line."""
        if t.ArchivePath in self.plugin.needs.values():
            for path in (None, Path("no/such/recordings")):
                given = {t.ArchivePath: t.ArchivePath(path)}

                def pull(given: dict[Any, Any] = given) -> Any:
                    return list(self.call(given))

                require_refusal(pull, t.Rejected, f"archive {path}")


def logged(capture: t.Capture) -> t.Capture:
    """Return a capture after a round trip through an MCAP log with whole clouds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with closing(Recorder(path, {"recipe.yaml": ""}, full_clouds=True)) as recorder:
            recorder.flangeye_captured("0.kit", capture, 0.0)
        (back,) = read_run(path).captures()
    require(back.cloud.xyz.shape == capture.cloud.xyz.shape, "the scan's rows and columns are lost")
    return back


class ReaderConformance(Conformance):
    """A ``reader`` part: takes a path, returns an Archive.

    Attributes:
        archive: A folder or file in the reader's layout.
    """

    kind = "reader"
    archive: ClassVar[Path]

    def read(self, path: Path | None = None) -> Archive:
        """Return the reader's output for a path."""
        return require_type(self.call({}, path or self.archive), Archive)

    def test_it_gives_the_same_twice(self) -> None:
        """Reading equal files twice gives equal recordings in equal order."""
        first, again = ([_traits(r) for r in self.read().recordings] for _ in range(2))
        require(first == again, "two readings differ")

    def test_its_recordings_are_complete(self) -> None:
        """Recordings have names, poses within reach, and files that exist below the root."""
        archive = self.read()
        require(archive.recordings, "no recordings")
        check_ids(archive)
        for recording in archive.recordings:
            pose = np.asarray(recording.base_T_flange, dtype=float)
            t.Transform(t.BASE, t.FLANGE, pose)
            far = float(np.linalg.norm(pose[:3, 3]))
            require(far < REACH, f"{recording.id} is {far:.3g} m from the base: not in metres?")
            if recording.cloud is not None:
                require(recording.cloud.is_file(), f"{recording.id}: no file {recording.cloud}")

    def test_what_is_no_such_archive_is_refused(self) -> None:
        """An empty folder and a missing one are refused in one line."""
        with tempfile.TemporaryDirectory() as empty:
            for path in (Path(empty), Path(empty) / "missing"):
                require_refusal(lambda path=path: self.read(path), t.Rejected, str(path))  # type: ignore[misc]


def _traits(recording: Any) -> tuple[Any, ...]:
    return recording.id, np.asarray(recording.base_T_flange).tobytes(), recording.cloud


class PlanConformance(Conformance):
    """A ``plan`` part: takes a site and a random generator, returns poses to visit."""

    kind = "plan"

    def planned(self, seed: int = 0, moved: Floats | None = None) -> Any:
        """Return the plan for the kit's site, or for one whose work is at another place."""
        shift = np.zeros(3) if moved is None else moved
        arm = Arm(self.robot)
        eye = SOURCE_CAMERA[:3, 3] + shift
        site = Site(
            centre=SOURCE_CAMERA[:3, 3] + 0.7 * SOURCE_CAMERA[:3, 2] + shift,
            eye=eye,
            facing_rotation=lambda point: _facing(np.asarray(point), eye),
            joints=lambda pose: np.zeros(arm.n),
        )
        return self.call({}, site, np.random.default_rng(seed))

    def poses(self, seed: int = 0, moved: Floats | None = None) -> Floats:
        """Return the (N, 4, 4) poses of the plan's first captures."""
        found = [p.base_T_flange for p in itertools.islice(self.planned(seed, moved).poses, 30)]
        require(found, "a plan without poses")
        return np.array(found)

    def test_it_gives_the_same_twice(self) -> None:
        """Two plans with equal random generators are equal."""
        require(np.array_equal(self.poses(3), self.poses(3)), "two plans with one seed differ")

    def test_its_poses_are_poses_inside_its_box(self) -> None:
        """Poses are rigid, in metres, and in the planned region."""
        plan = self.planned()
        for pose in self.poses():
            t.Transform(t.BASE, t.FLANGE, pose)
            outside = np.abs(pose[:3, 3] - plan.centre) - np.asarray(plan.size) / 2
            require((outside < 1e-6).all(), f"a pose is {outside.max():.3g} m outside the box")

    def test_its_poses_tell_the_camera(self) -> None:
        """The plan has three poses or more, not on a line, so that the camera is observable."""
        centres = self.poses()[:, :3, 3]
        require(len(centres) >= 3, f"{len(centres)} poses, 3 are needed")
        spread = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
        require(spread[1] > 0.02 * np.sqrt(len(centres)), "all poses are on a line")

    def test_it_moves_with_the_site(self) -> None:
        """If scanner and work are moved, the planned poses move with them."""
        shift = np.array([0.1, -0.2, 0.05])
        here, there = self.poses(), self.poses(moved=shift)
        require_close(there[:, :3, 3], here[:, :3, 3] + shift, 1e-6, "a pose of a moved site [m]")

    def test_a_site_that_shows_nothing_is_no_crash(self) -> None:
        """If the arm cannot show its flange anywhere, the plan is empty or is refused."""
        site = Site(
            centre=np.zeros(3),
            eye=np.ones(3),
            facing_rotation=lambda p: None,
            joints=lambda p: None,
        )

        def planned() -> Any:
            plan = self.call({}, site, np.random.default_rng(0))
            return None if not list(itertools.islice(plan.poses, 1)) else plan

        require_refusal(planned, type(None), "a site where no pose shows the flange")


def _facing(point: Floats, eye: Floats) -> Floats:
    """Return the rotation whose z points from ``point`` to ``eye``."""
    z = (eye - point) / np.linalg.norm(eye - point)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


class ViewConformance(Conformance):
    """A ``view`` part: returns the scanner's pose before any scan."""

    kind = "view"

    def guess(self) -> Floats:
        """Return the part's guess of ``base_T_camera`` (4, 4) [m]."""
        return np.asarray(self.call({}, Arm(self.robot), self.scanner), dtype=float)

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input give equal guesses, to the last bit."""
        require(np.array_equal(self.guess(), self.guess()), "two guesses differ")

    def test_it_is_a_pose_in_metres(self) -> None:
        """The guess is a rigid ``base_T_camera`` in metres, within a cell's size."""
        pose = self.guess()
        t.Transform(t.BASE, t.CAMERA, pose)
        far = float(np.linalg.norm(pose[:3, 3]))
        require(far < REACH, f"the scanner is {far:.3g} m from the base: not in metres?")
