"""The corners of a printed board in an image, to a fraction of a pixel.

Corners of a dark square are found as the intersections of its sides.

A corner's own neighbourhood is rounded by the lens, which draws the corner inwards by a quarter
of a pixel; a straight side is blurred on both sides alike. Sides are straight only without the
lens's distortion, which bends a side of 200 px away from the image's middle by half a pixel.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.models.boards import DICTIONARIES, Board, BoardKind, charuco_of, dictionary_of
from flangeye.types import Floats, Image, Rejected

Grey = NDArray[np.uint8]

FEWEST_CHARUCO = 6
"""Fewest corners of a ChArUco board from which its pose is estimated."""

FIRST_WIDTH = 640
"""Width to which an image is reduced before all families are tried [px], to save time."""


PROFILE = 4.0
"""Half the length of the profiles across a side [px]."""

PROFILES = 60
"""Profiles along a side."""


class Corners(NamedTuple):
    """N corners of a board: where they are in the image and on the board.

    Attributes:
        pixels: (N, 2) corners in the image; the middle of the first pixel is (0, 0).
        points: (N, 3) the same corners on the board, in ``target`` [m].
    """

    pixels: Floats
    points: Floats


def find_corners(board: Board, image: Image, thorough: bool = True) -> Corners | Rejected:
    """Find a board's corners in an image.

    Args:
        board: The board to find.
        image: The image to search.
        thorough: Whether to search again exhaustively for a checkerboard that is not found; on a
            large image without one this takes seconds.
    """
    grey = _grey(image)
    if board.kind == "checkerboard":
        return _checkerboard(board, grey, thorough)
    finders = {"charuco": _charuco, "marker": _marker, "circles": _circles}
    return finders[board.kind](board, grey, image)


class SeenBoard(NamedTuple):
    """A board of unknown size in an image.

    Attributes:
        kind: Which kind of board.
        params: Parameters of the board that the image shows: columns, rows, dictionary, id.
        what: The board's parameters as text.
    """

    kind: BoardKind
    params: dict[str, Any]
    what: str

    @property
    def fit(self) -> str:
        """The fit stage for the board, with the known parameters, as a recipe writes it."""
        name = "aruco" if self.kind == "marker" else self.kind
        return f"{name}: {{{', '.join(f'{key}: {value}' for key, value in self.params.items())}}}"


def board_seen(view: Grey) -> SeenBoard | None:
    """Return the board in an image, of any family and size; None if there is none.

    Args:
        view: (H, W) grey or (H, W, 3) RGB.
    """
    import cv2

    grey = _grey(Image(view, np.eye(3)))
    if markers := _family_in(grey):
        return _board_of(*markers, grey)
    # The search for a board of any size is slow, so the image is reduced: a board worth fitting is
    # large in it.
    by = min(1.0, 2 * FIRST_WIDTH / grey.shape[1])
    small: Grey = cv2.resize(grey, None, fx=by, fy=by, interpolation=cv2.INTER_AREA).astype(
        np.uint8
    )
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    if found:
        rows, columns = (length + 1 for length in np.asarray(meta).shape[:2])
        pixels = np.asarray(corners, dtype=np.float64).reshape(rows - 1, columns - 1, 2)
        board = Board("checkerboard", columns, rows, 1.0)
        upright = Corners(_upright(pixels, small).reshape(-1, 2), board.inner_corners())
        if not _wrong_squares(upright, board, small):
            long, short = max(columns, rows), min(columns, rows)
            what = f"a checkerboard of {long} x {short} squares"
            return SeenBoard("checkerboard", {"columns": long, "rows": short}, what)
    return None


def _board_of(dictionary: str, ids: list[int], grey: Grey) -> SeenBoard:
    """Return the ChArUco board that the markers belong to, or the markers alone.

    Markers are numbered row by row, so their corners are found only if the number of columns is
    right. The number of rows is the smallest that holds the seen markers, because rows outside the
    image are unknown.
    """
    import cv2

    count = max(ids) + 1
    # Half of a ChArUco board's squares hold a marker: the fewest rows that hold the highest id.
    sizes = [(c, next(r for r in range(count) if c * r // 2 >= count)) for c in range(3, count)]
    boards = [Board("charuco", c, r, 1.0, 0.75, dictionary) for c, r in sizes if r >= 3]
    # Detected once for all candidate boards, which only interpolate corners between the markers.
    markers = cv2.aruco.ArucoDetector(dictionary_of(dictionary)).detectMarkers(grey)[:2]
    found = {board: len(_charuco_corners(board, grey, *markers)[1]) for board in boards}
    best = max(found, key=lambda board: found[board], default=None)
    if best is not None and found[best] >= FEWEST_CHARUCO:
        params = {"columns": best.columns, "rows": best.rows, "dictionary": dictionary}
        what = f"a ChArUco board of {best.columns} x {best.rows} squares, markers of {dictionary}"
        return SeenBoard("charuco", params, what)
    listed = ", ".join(map(str, ids[:8])) + (", …" if len(ids) > 8 else "")
    what = f"{len(ids)} markers of {dictionary} (id {listed})"
    return SeenBoard("marker", {"id": ids[0], "dictionary": dictionary}, what)


def _grey(image: Image) -> Grey:
    import cv2

    pixels = np.ascontiguousarray(image.pixels)
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))


def _charuco(board: Board, grey: Grey, _image: Image) -> Corners | Rejected:
    pixels, ids, seen = _charuco_corners(board, grey)
    if len(ids) < FEWEST_CHARUCO:
        told = _of_other_size(board, seen) if seen else _of_other_families(grey)
        return Rejected(
            f"{len(ids)} corners of the ChArUco board found, at least {FEWEST_CHARUCO} are needed "
            f"({len(seen)} of its markers were{told})"
        )
    return Corners(pixels, board.inner_corners()[ids])


def _charuco_corners(
    board: Board, grey: Grey, outlines: Any = None, numbers: Any = None
) -> tuple[Floats, list[int], list[int]]:
    """Return the corners (n, 2) [px], their indices on the board, and the ids of the markers.

    The markers are looked for, unless their outlines and numbers are given as OpenCV has them.

    OpenCV before 4.6 printed boards with an even number of rows with a marker at the top left,
    where now a black square is; the corners are the same.
    """
    import cv2

    print_ = charuco_of(board)
    # Both prints of an even board are in use, and a corner has the same place on either.
    for legacy in (False, True)[: 1 + (board.rows % 2 == 0)]:
        print_.setLegacyPattern(legacy)
        corners, ids, _, markers = cv2.aruco.CharucoDetector(print_).detectBoard(
            grey, None, None, outlines, numbers
        )
        if ids is not None and len(ids) >= FEWEST_CHARUCO:
            break
    pixels = np.asarray(() if corners is None else corners, dtype=np.float64).reshape(-1, 2)
    return pixels, _ids(ids), _ids(markers)


def _ids(found: Any) -> list[int]:
    return [] if found is None else [int(each) for each in np.asarray(found).ravel()]


def _of_other_size(board: Board, seen: Sequence[int]) -> str:
    """Return which markers are seen, and which the board has; empty if too few are seen.

    The markers of a board are numbered row by row, so corners between them are found only with the
    columns and rows of the print.
    """
    if len(seen) < FEWEST_CHARUCO:
        return ""
    last = board.columns * board.rows // 2 - 1
    return (
        f": {min(seen)} to {max(seen)}, and a board of {board.columns} x {board.rows} squares has "
        f"0 to {last}; count the squares of the print"
    )


def _of_other_families(grey: Grey) -> str:
    """Return the dictionary to write if the image shows markers of another family; else empty."""
    if found := _family_in(grey):
        return f"; {len(found[1])} of {found[0]} are seen: write dictionary: {found[0]}"
    return ""


def _family_in(grey: Grey) -> tuple[str, list[int]] | None:
    """Return the first family of which an image shows markers, and their ids in order."""
    import cv2

    by = min(1.0, FIRST_WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
    # One dictionary of each kind: 4X4_250 begins with the markers of 4X4_50.
    for name in DICTIONARIES:
        if name.endswith(("_50", "_100", "_1000")):
            continue
        family = cv2.aruco.ArucoDetector(dictionary_of(name))
        if ids := _ids(family.detectMarkers(small)[1]):
            return name, sorted(ids)
    return None


def _marker(board: Board, grey: Grey, image: Image) -> Corners | Rejected:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary_of(board.dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(grey)
    found = _ids(ids)
    if found.count(board.marker_id) != 1:
        others = ", ".join(map(str, sorted(found))) or f"none{_of_other_families(grey)}"
        return Rejected(
            f"marker {board.marker_id} found {found.count(board.marker_id)} times, once is needed "
            f"(found: {others})"
        )
    pixels = np.asarray(corners[found.index(board.marker_id)], dtype=np.float64).reshape(4, 2)
    return Corners(corners_of_square(grey, pixels, image), board.outer_corners())


def _checkerboard(board: Board, grey: Grey, thorough: bool) -> Corners | Rejected:
    import cv2

    pattern = (board.columns - 1, board.rows - 1)
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCornersSB(grey, pattern, flags=flags)
    if not found and thorough:  # slower, and seldom needed
        flags |= cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(grey, pattern, flags=flags)
    if not found:
        return Rejected(f"no checkerboard of {board.columns} x {board.rows} squares found")
    pixels = np.asarray(corners, dtype=np.float64).reshape(board.rows - 1, board.columns - 1, 2)
    upright = Corners(_upright(pixels, grey).reshape(-1, 2), board.inner_corners())
    wrong = _wrong_squares(upright, board, grey)
    if wrong:
        return Rejected(
            f"{wrong} of the {board.columns} x {board.rows} squares have the wrong colour: a "
            "part of the board is covered or cut off, or it has more squares"
        )
    return upright


def _circles(board: Board, grey: Grey, _image: Image) -> Corners | Rejected:
    """Find the middles of the discs' images.

    Under perspective they lie a little beside the images of the discs' centres.
    """
    import cv2

    # Clustering, the other method, can take minutes for a grid that is cut off.
    size, flags = (board.columns, board.rows), cv2.CALIB_CB_ASYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(grey, size, flags=flags)
    if not found:
        return Rejected(
            f"no grid of {board.rows} rows of {board.columns} circles found; all of it must be seen"
        )
    return Corners(np.asarray(centres, dtype=np.float64).reshape(-1, 2), board.circle_centres())


def _wrong_squares(corners: Corners, board: Board, grey: Grey) -> int:
    """Return the number of squares without the expected contrast to their neighbours.

    A grid that is found one square beside the board's own, where a part is covered, has the sheet
    about the board in the place of its outer squares.
    """
    import cv2

    rows, columns = np.indices((board.rows, board.columns))
    squares = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    middles = board.place((squares + 0.5) * board.square)
    # A homography maps the board's plane to the image, up to lens distortion, which is far below
    # half a square.
    to_image = cv2.findHomography(corners.points[:, :2], corners.pixels)[0]
    at = cv2.perspectiveTransform(middles[None, :, :2], to_image)[0]
    values = np.array([_value(grey, pixel) for pixel in at]).reshape(rows.shape)
    sense = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    around = np.pad(values, 1, constant_values=np.nan)
    beside = [around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]]
    # Percentiles, so that a highlight or a shadow on a few squares does not set the scale.
    contrast = float(np.ptp(np.percentile(values, [20, 80])))
    differs = sense * (values - np.nanmean(beside, axis=0))
    # Least contrast of a square to its neighbours: 0.3 of that between black and white
    return int((differs < 0.3 * contrast).sum())


def _upright(pixels: Floats, grey: Grey) -> Floats:
    """Return a grid of corners (rows, columns, 2) in the board's own order.

    Detection may give them mirrored, or begin at the wrong end: seen from the front the board's
    axes keep their sense, and its first square is black.
    """
    # In an image, its y down, right x down is positive; negative where the grid is mirrored
    across, down = pixels[0, -1] - pixels[0, 0], pixels[-1, 0] - pixels[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        pixels = pixels[:, ::-1]
    # The first square's middle is half a diagonal outside the first corner; `beside` is on the edge
    # between two squares, as grey as half way between black and white
    first = 1.5 * pixels[0, 0] - 0.5 * pixels[1, 1]
    beside = 0.5 * (pixels[0, 0] + pixels[1, 1]) + 0.5 * (pixels[0, 0] - pixels[0, 1])
    if _value(grey, first) > _value(grey, beside):
        pixels = pixels[::-1, ::-1]
    return pixels


def _value(grey: Grey, at: Floats) -> float:
    x, y = np.clip(np.round(at).astype(int), 1, np.array(grey.shape[::-1]) - 2)
    return float(grey[y - 1 : y + 2, x - 1 : x + 2].mean())


def corners_of_square(grey: NDArray[np.uint8], rough: Floats, image: Image) -> Floats:
    """Return the (4, 2) corners [px] of a dark square on white, from rough ones in order.

    Where a side cannot be followed the rough corners are kept.

    Args:
        grey: (H, W) values.
        rough: (4, 2) corners, to a pixel or two.
        image: Image with the camera's matrix and distortion.
    """
    lines = [_side(grey, rough[i], rough[(i + 1) % 4], image) for i in range(4)]
    if any(line is None for line in lines):
        return rough
    # Two homogeneous lines meet in their cross product
    crossed = [np.cross(lines[i - 1], lines[i]) for i in range(4)]  # type: ignore[arg-type]
    # Lines are straight only without distortion, so they meet there and the corner is distorted
    # back.
    corners = _bent(np.array([c[:2] / c[2] for c in crossed]), image)
    # A corner that moves farther than the profiles reach was found on another edge.
    near = np.linalg.norm(corners - rough, axis=1).max() < PROFILE
    return np.asarray(corners) if near else rough


def _straight(pixels: Floats, image: Image) -> Floats:
    """Return pixels (N, 2) with the lens's distortion removed."""
    import cv2

    if not (len(pixels) and image.distortion.any()):
        return pixels
    matrix = image.camera_matrix
    found = cv2.undistortPoints(pixels[:, None], matrix, image.distortion, P=matrix)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _bent(pixels: Floats, image: Image) -> Floats:
    """Return undistorted pixels (N, 2) with the lens's distortion applied."""
    import cv2

    if not image.distortion.any():
        return pixels
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(image.camera_matrix).T
    none = np.zeros(3)
    found = cv2.projectPoints(rays, none, none, image.camera_matrix, image.distortion)[0]
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _side(grey: NDArray[np.uint8], start: Floats, end: Floats, image: Image) -> Floats | None:
    """Return the line (3,) of a side, homogeneous and undistorted; None with too few edges."""
    along = end - start
    length = float(np.linalg.norm(along))
    # A marker's border is a tenth of its side: longer profiles would reach its inner pattern
    reach = min(PROFILE, 0.07 * length)
    # Profiles shorter than this [px] are steep all along
    if reach < 1.5:
        return None
    across = np.array([-along[1], along[0]]) / length * reach
    edges = _straight(_edges(grey, start, along, across), image)
    for _ in range(2):
        if len(edges) < PROFILES / 3:
            return None
        middle = edges.mean(axis=0)
        # Total least squares: both coordinates of an edge point have noise.
        direction = np.linalg.svd(edges - middle)[2][0]
        normal = np.array([-direction[1], direction[0]])
        # Edges farther than this from the fitted line belong to something else [px]
        edges = edges[np.abs((edges - middle) @ normal) < 0.5]
    return np.array([*normal, -normal @ middle])


def _edges(grey: NDArray[np.uint8], start: Floats, along: Floats, across: Floats) -> Floats:
    """Return a side's edge points (N, 2) [px]: the middle of the slope of profiles across it."""
    import cv2

    ends = 0.12  # share of a side at each end that is left out: there the next side is near
    shares = np.linspace(ends, 1 - ends, PROFILES)
    # Places along a profile at which grey values are sampled
    steps = np.linspace(-1.0, 1.0, 33)
    places = start + shares[:, None, None] * along + steps[None, :, None] * across
    x, y = (places[..., i].astype(np.float32) for i in (0, 1))
    profiles = cv2.remap(grey, x, y, cv2.INTER_LINEAR).astype(np.float64)
    slope = np.abs(np.diff(profiles, axis=1))
    # Noise makes slopes too: only those near the steepest count.
    slope = np.where(slope > 0.25 * slope.max(axis=1, keepdims=True), slope, 0.0)
    middle = 0.5 * (steps[1:] + steps[:-1])
    # The centroid of the slope is the edge under any symmetric blur.
    at = (slope * middle).sum(axis=1) / np.maximum(slope.sum(axis=1), 1e-9)
    # Grey levels between black and white: less is shadow, a highlight, or no edge.
    strong = np.ptp(profiles, axis=1) > 30
    return np.asarray((start + shares[:, None] * along + at[:, None] * across)[strong])
