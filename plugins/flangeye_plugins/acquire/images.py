"""``acquire.images``: recorded images with robot poses, of a camera known or to be calibrated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flangeye import Params, StageError, stage
from flangeye.errors import NothingSeen
from flangeye.files.cameras import CameraFile, camera_in, cameras_in
from flangeye.files.clouds import FileUnit
from flangeye.files.depth import read_scan
from flangeye.files.images import is_depth_image
from flangeye.files.recording import Recording, check_poses, digests_of
from flangeye.models.boards import Board, BoardKind, Dictionary
from flangeye.models.corners import Corners, board_seen, find_corners
from flangeye.models.scanners import ScannerData, detect_unit, median_distance
from flangeye.types import (
    CAMERA,
    ArchivePath,
    Capture,
    Captures,
    Floats,
    Image,
    PointCloud,
    Rejected,
    Warn,
)
from flangeye.units import Length, param
from flangeye_plugins.acquire.camera import pinhole, read_image
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_path,
    open_archive,
    poses_of,
    skipped_note,
    source_of,
)

TOO_ALIKE = (
    "they are too alike; tilt the board by 20 deg and more to both sides, or write focal_length: "
    "[fx, fy] and principal_point: [cx, cy]"
)
SAMPLED_VIEWS = 8
"""Images that are looked at first: a set that shows the board in half of its images passes."""

Grey = NDArray[np.uint8]


class SeenBoardParams(Params):
    """The board for calibrating the camera, with the parameters of its fit step."""

    kind: BoardKind = "charuco"
    """charuco, checkerboard, or circles."""
    columns: int = Field(ge=3, le=200)
    """Squares, or circles of a row, from left to right."""
    rows: int = Field(ge=3, le=200)
    """Squares, or rows of circles, from top to bottom."""
    square: Length = param(gt=0)
    """Edge of a square, or distance of rows of circles."""
    marker: Length = param("0 mm", ge=0)
    """Edge of a ChArUco board's markers."""
    dictionary: Dictionary = "4X4_50"
    """Family of the markers."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.kind == "marker":
            raise ValueError("the four corners of a marker do not determine a camera; use a board")
        if self.kind == "charuco" and not 0 < self.marker < self.square:
            raise ValueError("marker: a ChArUco board's markers are smaller than its squares")
        if self.kind == "checkerboard" and min(self.columns, self.rows) < 4:
            raise ValueError("OpenCV finds checkerboards of at least 4 x 4 squares")
        return self

    @property
    def board(self) -> Board:
        """The printed board."""
        size = self.columns, self.rows, self.square
        return Board(self.kind, *size, self.marker, self.dictionary)


class CalibratedLens(NamedTuple):
    """A camera calibrated from views of a board.

    Attributes:
        matrix: (3, 3) camera matrix [px].
        distortion: (4,) coefficients k1, k2, p1, p2.
        covariance: (8, 8) covariance of fx, fy, cx, cy [px] and the coefficients.
        error: Root mean square of a corner's reprojection error [px].
        views: Number of views used.
        left_out: Images not used, because they show no board or are outliers.
    """

    matrix: Floats
    distortion: Floats
    covariance: Floats
    error: float
    views: int
    left_out: tuple[str, ...]

    @property
    def deviations(self) -> Floats:
        """Standard deviations (8,) of intrinsics and coefficients."""
        return np.sqrt(np.diag(self.covariance))

    def against(self, known: Floats) -> Warn | None:
        """Return a warning if the views contradict a given camera matrix (3, 3) [px]; else None."""
        stated, found = known[0, 0], self.matrix[0, 0]
        # By what share of itself a focal length may be off before a calibration is another camera's
        if abs(stated / found - 1) < max(0.02, 5 * self.deviations[0] / found):
            return None
        return Warn(
            f"the camera's calibration states a focal length of {stated:.0f} px; {self.views} "
            f"views of the board give {found:.0f} +- {self.deviations[0]:.0f} px, which is used",
            "calibrate the camera again, or give the calibration that belongs to these images: it "
            "changes with camera, lens and image size",
        )

    def note(self) -> str:
        """Return a note with the parameters, their standard deviations and the fit's error."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        s = self.deviations
        # The views of an arm's calibration determine these coefficients and no others.
        named = zip(("k1", "k2", "p1", "p2"), self.distortion, s[4:], strict=True)
        lens = ", ".join(f"{name} {value:.4f} +- {sigma:.4f}" for name, value, sigma in named)
        left = f"; without {', '.join(self.left_out)}" if self.left_out else ""
        return (
            f"camera by {self.views} views of the board: focal length {fx:.2f}, {fy:.2f} +- "
            f"{s[0]:.2f}, {s[1]:.2f} px, principal point {cx:.2f}, {cy:.2f} +- {s[2]:.2f}, "
            f"{s[3]:.2f} px, {lens}; corners fit to {self.error:.3f} px{left}"
        )


def lens_of(images: Mapping[str, Grey], board: Board, start: Image | None = None) -> CalibratedLens:
    """Return the intrinsics of a camera from its images of a board, by least squares (Zhang 2000).

    Args:
        images: Images (H, W) by name.
        board: The board in the images.
        start: Initial camera, which is refined; None if unknown.

    Raises:
        StageError: Too few images show the board, or its poses are too similar.
    """
    sizes = {pixels.shape[::-1] for pixels in images.values()}
    if len(sizes) > 1:
        raise StageError(f"images of {len(sizes)} sizes are not one camera's")
    (size,) = sizes
    looked = _looked(images, board)
    seen = {name: found for name, found in looked.items() if isinstance(found, Corners)}
    _require_views(len(seen), looked)
    # Before the fit, which converges for parallel boards too, to any focal length
    _require_tilted(seen)
    lens = camera_of(seen, size, start)
    # Views with a larger reprojection error take no part
    limit = 4.0 * float(np.median(lens[1]))
    kept = {n: c for (n, c), e in zip(seen.items(), lens[1], strict=True) if e <= limit}
    if len(kept) < len(seen):
        _require_views(len(kept), looked)
        lens = camera_of(kept, size, start)
    left_out = tuple(name for name in images if name not in kept)
    found = lens[0]._replace(left_out=left_out)
    _require_certain(found)
    return found


def _looked(images: Mapping[str, Grey], board: Board) -> dict[str, Corners | Rejected]:
    """Return the corners of the board in each image, or the reason why there are none.

    Raises:
        NothingSeen: None of a first sample, spread over all images, shows the board.
    """
    views = {name: Image(pixels, np.eye(3)) for name, pixels in images.items()}
    if len(views) <= SAMPLED_VIEWS:
        return {name: find_corners(board, view) for name, view in views.items()}
    first = _spread_over(list(views))
    early = {name: find_corners(board, views[name], thorough=False) for name in first}
    early |= {n: find_corners(board, views[n]) for n in first[:2] if isinstance(early[n], Rejected)}
    missed = {name: found for name, found in early.items() if isinstance(found, Rejected)}
    if len(missed) == len(early):
        raise _not_shown(board, missed, len(images), views[first[0]])
    seen = {name: found for name, found in early.items() if isinstance(found, Corners)}
    return {name: seen.get(name) or find_corners(board, view) for name, view in views.items()}


def _spread_over(names: Sequence[str]) -> list[str]:
    return [names[i] for i in np.linspace(0, len(names) - 1, SAMPLED_VIEWS).astype(int)]


def _not_shown(
    board: Board, missed: Mapping[str, Rejected], count: int, first: Image
) -> NothingSeen:
    """Return the error that no image shows the board; it names a board seen in the first one."""
    name, found = next(iter(missed.items()))
    seen = board_seen(first.pixels)
    instead = f"it shows {seen.what}: write fit.{seen.fit}" if seen else found.reason
    mirrored = Image(np.ascontiguousarray(first.pixels[:, ::-1]), first.camera_matrix)
    # Squares alone look the same in a mirror
    marked = board.kind in ("charuco", "marker")
    if marked and isinstance(find_corners(board, mirrored), Corners):
        instead = "it shows the board mirrored: switch off image flipping in the driver"
    what = board.kind if board.kind == "marker" else f"{board.kind}, {board.columns} x {board.rows}"
    return NothingSeen(
        f"none of {len(missed)} of the {count} images, taken evenly from the session, shows the "
        f"board ({what}); "
        f"{name}: {instead}"
    )


def _require_shown(
    usable: Sequence[Recording], cameras: Mapping[str, CameraNumbers], board: Board
) -> None:
    """Refuse images if none of a sample shows the board, before searching all of them.

    Raises:
        NothingSeen: None of the sample shows it; the message names a board that is seen.
    """
    files = {r.id: r.image for r in usable if r.image is not None}
    first = _spread_over(list(files))
    views = {name: Image(read_image(files[name]), *cameras[name]) for name in first}
    missed: dict[str, Rejected] = {}
    # A checkerboard is looked for in every way in two of them; the others have one way
    looks = [(name, False) for name in first]
    looks += [(name, True) for name in first[:2] if board.kind == "checkerboard"]
    for name, thorough in looks:
        found = find_corners(board, views[name], thorough)
        if isinstance(found, Corners):
            return
        missed[name] = found
    raise _not_shown(board, missed, len(files), views[first[0]])


def _require_views(seen: int, looked: Mapping[str, Corners | Rejected]) -> None:
    fewest = 6
    if seen < fewest:
        missed = {n: found.reason for n, found in looked.items() if isinstance(found, Rejected)}
        why = next((f"; {name}: {reason}" for name, reason in missed.items()), "")
        raise StageError(
            f"{seen} of {len(looked)} images show the board, {fewest} are needed to calibrate the "
            "camera; take more, or write focal_length: [fx, fy] and principal_point: [cx, cy]"
            f"{why}"
        )


def camera_of(
    seen: Mapping[str, Corners], size: tuple[int, ...], start: Image | None
) -> tuple[CalibratedLens, Floats]:
    """Return the calibrated camera, and each view's rms reprojection error [px]."""
    import cv2

    points = [corners.points.astype(np.float32) for corners in seen.values()]
    pixels = [corners.pixels.astype(np.float32) for corners in seen.values()]
    # k3 matters at the rim of wide lenses only, where boards on an arm have no corners: it would
    # fit noise
    flags = cv2.CALIB_FIX_K3 | (cv2.CALIB_USE_INTRINSIC_GUESS if start else 0)
    matrix = np.eye(3) if start is None else np.array(start.camera_matrix)
    lens = np.zeros(5) if start is None else np.resize(np.append(start.distortion, np.zeros(5)), 5)
    _, found_matrix, found_lens, turns, moves, _, _, errors = cv2.calibrateCameraExtended(
        points, pixels, size, matrix, lens, flags=flags
    )
    errors = np.asarray(errors, dtype=np.float64).ravel()
    counts = np.array([len(each) for each in pixels])
    squares = (errors**2 * counts).sum()
    # OpenCV's errors are of points, ours of a coordinate.
    total = float(np.sqrt(squares / counts.sum() / 2))
    # Two coordinates a corner, less six numbers a pose and eight of the camera
    freedom = max(2 * counts.sum() - 6 * len(points) - 8, 1)
    views = zip(points, turns, moves, strict=True)
    found = CalibratedLens(
        np.asarray(found_matrix, dtype=np.float64),
        np.asarray(found_lens, dtype=np.float64).ravel()[:4],
        squares / freedom * _spread(views, found_matrix, found_lens), total, len(seen), (),
    )  # fmt: skip
    return found, errors


def _spread(views: Iterable[tuple[Any, Any, Any]], matrix: Any, lens: Any) -> Floats:
    """Return the camera's covariance (8, 8) for a corner noise of 1 px, with free poses."""
    import cv2

    information = np.zeros((8, 8))
    for points, turn, move in views:
        jacobian = np.asarray(cv2.projectPoints(points, turn, move, matrix, lens)[1])
        pose, camera = jacobian[:, :6], jacobian[:, 6:14]
        # What the view's free pose can explain says nothing about the camera (Schur complement)
        told = camera - pose @ np.linalg.lstsq(pose, camera, rcond=None)[0]
        information += told.T @ told
    return np.asarray(np.linalg.inv(information))


def _require_tilted(seen: Mapping[str, Corners]) -> None:
    """Refuse parallel board poses: the intrinsics are not observable then.

    The residual of the least-squares fit does not show this.
    """
    changes = np.array([_depth_change(corners) for corners in seen.values()])
    spread = np.linalg.norm(changes - changes.mean(axis=0), ord=2) / np.sqrt(len(changes))
    # How much the board's depth, as a share of it, has to change across it otherwise between
    # views: the root mean square of it along the direction in which it changes most
    least = 0.02
    if spread < least:
        raise StageError(
            f"the {len(seen)} views do not determine the focal length: {TOO_ALIKE} (depth changes "
            f"by {spread:.1%} across the board between them, {least:.0%} is needed)"
        )


def _depth_change(corners: Corners) -> Floats:
    """Return the relative change of the board's depth across it, to the right and up (2,).

    The last row of the homography is the depth up to scale, for any camera.
    """
    import cv2

    plane = corners.points[:, :2] / np.ptp(corners.points[:, :2], axis=0).max()
    homography = np.asarray(cv2.findHomography(plane, corners.pixels)[0], dtype=np.float64)
    return np.asarray(homography[2, :2] / homography[2, 2])


def _require_certain(lens: CalibratedLens) -> None:
    share = float(lens.deviations[0] / lens.matrix[0, 0])
    largest = 0.01  # as a share of the focal length; beyond, nothing is believed
    if not share <= largest:
        raise StageError(
            f"the {lens.views} views determine the focal length to {share:.1%} only (at most "
            f"{largest:.0%} is allowed): {TOO_ALIKE}"
        )


CameraNumbers = tuple[Floats, Floats] | tuple[Floats, Floats, Floats]
"""Matrix (3, 3) [px], OpenCV's distortion and, where it was found, their covariance (8, 8)."""


class ImagesParams(OpeningParams):
    """Parameters of ``acquire.images``."""

    focal_length: tuple[float, float] | None = None
    """fx and fy of the camera's matrix [px]; the archive's own if not given."""
    principal_point: tuple[float, float] | None = None
    """cx and cy [px]; goes with focal_length."""
    distortion: tuple[float, ...] = Field((), max_length=14)
    """OpenCV's coefficients k1, k2, p1, p2, k3, …; none if given."""
    camera_file: str | None = None
    """The camera's calibration, beside the images: camera_info, OpenCV's storage, kalibr's
    camchain, COLMAP's cameras.txt, RealSense's or Zivid's intrinsics, .npz; the only one there if
    not given."""
    board: SeenBoardParams | None = None
    """Find the camera by the views of this board; refine focal_length, if given."""
    cloud_unit: FileUnit | None = None
    """Unit of the clouds that lie beside the images, where the archive's layout does not say;
    metres or millimetres, whichever scanners can see, if not given."""

    def camera(self, recording: Recording) -> CameraNumbers | None:
        """Return the recipe's camera matrix (3, 3) [px] and distortion, else the archive's."""
        if self.focal_length is None or self.principal_point is None:
            return recording.camera
        return pinhole(self.focal_length, self.principal_point), np.array(self.distortion)


@stage("acquire.images")
def acquire_images(
    archive: ArchivePath, params: ImagesParams, board: Board | None = None
) -> Captures:
    """Replay recorded images and robot poses, for targets that are found in images.

    A cloud with the name of an image is read with it. If it is organised like the image, fits of
    printed targets use its depth.
    """
    recorded = open_archive(archive_path("acquire.images", archive, params), params)
    usable = [r for r in recorded.recordings if r.image is not None]
    if not usable:
        raise StageError(f"{recorded.root}: holds no images ({recorded.layout})")
    check_poses(recorded.root, usable, whole=True, fewest=params.fewest)
    cameras, told = _cameras(recorded.root, usable, params)
    if board is not None and params.board is None and len(usable) > SAMPLED_VIEWS:
        _require_shown(usable, cameras, board)
    files = [path for r in usable for path in (r.image, r.cloud) if path is not None]
    skipped = skipped_note(recorded, lambda r: r.image is not None, "image")
    source = source_of(recorded, [*skipped, *told], digests_of([*files, *recorded.files]))
    # A depth image is seldom aligned with the colour image, so it is left out
    usable = [replace(r, cloud=None) if r.cloud and is_depth_image(r.cloud) else r for r in usable]
    unit = recorded.cloud_unit or params.cloud_unit or _unit_of_clouds(usable)
    return Captures(_captures(usable, cameras, unit), source, total=len(usable), recorded=True)


def _cameras(
    root: Path, usable: Sequence[Recording], params: ImagesParams
) -> tuple[dict[str, CameraNumbers], list[str]]:
    """Return the camera of each image by the pose's name, and notes on its source."""
    given = {r.id: camera for r in usable if (camera := params.camera(r)) is not None}
    filed = None if given else _filed(root, params.camera_file)
    if params.board is None:
        cameras = given or dict.fromkeys((r.id for r in usable), filed and filed[1:3])
        if len(cameras) < len(usable) or None in cameras.values():
            raise StageError(
                f"{root}: has images, but no camera that took them; put its calibration beside "
                "them, write focal_length: [fx, fy] and principal_point: [cx, cy], or board: "
                "{kind: charuco, …} to find it"
            )
        notes = [filed.note(), *_off_centre(usable, filed)] if filed else []
        return {n: c for n, c in cameras.items() if c}, notes
    images = {r.id: read_image(r.image) for r in usable if r.image is not None}
    known = given.get(usable[0].id) or (filed and filed[1:3])
    start = None if known is None else Image(images[usable[0].id], *known[:2])
    try:
        lens = lens_of(images, params.board.board, start)
    except StageError as error:
        raise type(error)(f"{root}: {error}") from None
    told: list[str] = [filed.note()] if filed else []
    told += [odd] if known and (odd := lens.against(known[0])) else []
    camera = lens.matrix, lens.distortion, lens.covariance
    return dict.fromkeys(images, camera), [*told, lens.note()]


def _off_centre(usable: Sequence[Recording], camera: CameraFile) -> list[Warn]:
    """Return a warning if a calibration is for another image size."""
    first = next(r.image for r in usable if r.image is not None)
    height, width = read_image(first).shape
    middle = camera.matrix[:2, 2] / [0.5 * width, 0.5 * height]
    # Lenses are centred to a few per cent, and a cropped image seldom moves it by a quarter
    if (np.abs(np.log2(middle)) < 0.4).all():
        return []
    cx, cy = camera.matrix[:2, 2]
    text = (
        f"{camera.path.name} has its principal point at {cx:.0f}, {cy:.0f} px, far from the middle "
        f"of {width} x {height} px: it belongs to images of about {2 * cx:.0f} x {2 * cy:.0f} px"
    )
    fix = f"calibrate at {width} x {height} px, or scale its matrix by {1 / middle.mean():.3g}"
    return [Warn(text, fix)]


def _filed(root: Path, name: str | None) -> CameraFile | None:
    """Return the camera calibration file in the images' folder; None without one.

    Raises:
        StageError: The named file has no calibration, or there are several and none is named.
    """
    folder = root if root.is_dir() else root.parent
    if name is not None:
        camera = camera_in(folder / name)
        if camera is None:
            raise StageError(f"{folder / name}: holds no camera's matrix")
        return camera
    found = cameras_in(folder)
    if len(found) > 1:
        names = ", ".join(str(camera.path.relative_to(folder)) for camera in found)
        raise StageError(
            f"{folder}: holds several camera calibrations; state which camera took the images, "
            f"camera_file: one of {names}"
        )
    return found[0] if found else None


def _unit_of_clouds(usable: Sequence[Recording]) -> FileUnit:
    for path in (recording.cloud for recording in usable):
        if path and np.isfinite(raw := median_distance(read_scan(path))):
            return detect_unit(path, raw, ScannerData(model="the scanner"))
    return "m"


def _captures(
    usable: Sequence[Recording], cameras: Mapping[str, CameraNumbers], unit: FileUnit
) -> Iterator[Capture]:
    """Yield the captures, reading one image at a time."""
    nothing = PointCloud(CAMERA, np.zeros((0, 3), dtype=np.float32))
    for recording in usable:
        if recording.image is not None:
            image = Image(read_image(recording.image), *cameras[recording.id])
            cloud = read_scan(recording.cloud, unit) if recording.cloud else nothing
            yield Capture(
                recording.id, cloud, poses_of(recording), recording.joints,
                recording.time_ns, recording.role, image, motion=recording.motion,
            )  # fmt: skip
