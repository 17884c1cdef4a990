"""The corners of a printed board in an image, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.models.boards import DICTIONARIES, Board, charuco_of, dictionary_of
from flangeye.models.square_edges import corners_of_square
from flangeye.types import Floats, Image, Rejected

Grey = NDArray[np.uint8]

FEWEST_CHARUCO = 6
"""Corners of a ChArUco board below which too little of it is seen."""

FAMILIES = tuple(name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_1000")))
"""One of each kind: the first markers of 4X4_250 are those of 4X4_50, and few prints need more."""
WIDTH = 640
"""Of an image in which other families are looked for [px]: each tries every square in it."""


class Corners(NamedTuple):
    """N corners.

    Attributes:
        pixels: (N, 2) in the image; the middle of the first pixel is (0, 0).
        points: (N, 3) in ``target`` [m].
    """

    pixels: Floats
    points: Floats


def find_corners(board: Board, image: Image, thorough: bool = True) -> Corners | Rejected:
    """Find a board's corners in an image.

    Args:
        board: What to look for.
        image: Where.
        thorough: Whether a checkerboard that is not found is looked for in every way; a large
            image without one takes seconds then.
    """
    grey = _grey(image)
    if board.kind == "checkerboard":
        return _checkerboard(board, grey, thorough)
    finders = {"charuco": _charuco, "marker": _marker, "circles": _circles}
    return finders[board.kind](board, grey, image)


def board_seen(image: Image) -> str:
    """Return which board an image shows, of any that is known, and what to write for it."""
    import cv2

    grey = _grey(image)
    markers = _of_other_families(Board("charuco", 3, 3, 1.0, 0.5), grey)
    if markers:
        return markers.removeprefix("; ") + " and kind: charuco, or fit.aruco"
    by = min(1.0, 2 * WIDTH / grey.shape[1])
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
            return (
                f"a checkerboard of {long} x {short} squares is seen: write kind: checkerboard, "
                f"columns: {long}, rows: {short}"
            )
    return "no board that is known is seen in it"


def _grey(image: Image) -> Grey:
    import cv2

    pixels = np.ascontiguousarray(image.pixels)
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))


def _charuco(board: Board, grey: Grey, _image: Image) -> Corners | Rejected:
    import cv2

    detector = cv2.aruco.CharucoDetector(charuco_of(board))
    corners, ids, _, markers = detector.detectBoard(grey)
    count = 0 if ids is None else len(ids)
    if count < FEWEST_CHARUCO:
        seen = 0 if markers is None else len(markers)
        return Rejected(
            f"{count} corners of the ChArUco board found, at least {FEWEST_CHARUCO} are needed "
            f"({seen} of its markers were{'' if seen else _of_other_families(board, grey)})"
        )
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return Corners(pixels, board.inner_corners()[np.asarray(ids).ravel()])


def _of_other_families(board: Board, grey: Grey) -> str:
    """Return what to write where the image shows markers, and none of the board's family."""
    import cv2

    by = min(1.0, WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
    for name in FAMILIES:
        family = cv2.aruco.ArucoDetector(dictionary_of(replace(board, dictionary=name)))
        _, ids, _ = family.detectMarkers(small)
        if ids is not None:
            return f"; {len(ids)} of {name} are seen: write dictionary: {name}"
    return ""


def _marker(board: Board, grey: Grey, image: Image) -> Corners | Rejected:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary_of(board), parameters)
    corners, ids, _ = detector.detectMarkers(grey)
    found = [] if ids is None else [int(each) for each in np.asarray(ids).ravel()]
    if found.count(board.marker_id) != 1:
        others = ", ".join(map(str, sorted(found))) or f"none{_of_other_families(board, grey)}"
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
            f"{wrong} of the {board.columns} x {board.rows} squares are not as they should be: a "
            "part of the board is covered or cut off, or it has more squares"
        )
    return upright


def _circles(board: Board, grey: Grey, _image: Image) -> Corners | Rejected:
    """Find the middles of the discs' images; they lie a little beside the images of the centres."""
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
    """Return how many squares are not darker, or lighter, than those beside them as they should.

    A grid that is found one square beside the board's own, where a part is covered, has the sheet
    about the board in the place of its outer squares.
    """
    import cv2

    rows, columns = np.indices((board.rows, board.columns))
    squares = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    middles = board.place((squares + 0.5) * board.square)
    to_image = cv2.findHomography(corners.points[:, :2], corners.pixels)[0]
    at = cv2.perspectiveTransform(middles[None, :, :2], to_image)[0]
    values = np.array([_value(grey, pixel) for pixel in at]).reshape(rows.shape)
    sense = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    around = np.pad(values, 1, constant_values=np.nan)
    beside = [around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]]
    contrast = float(np.ptp(np.percentile(values, [20, 80])))
    differs = sense * (values - np.nanmean(beside, axis=0))
    # Between a square and those beside it, over that between black and white
    return int((differs < 0.3 * contrast).sum())


def _upright(pixels: Floats, grey: Grey) -> Floats:
    """Return a grid of corners (rows, columns, 2) in the board's own order.

    Detection may give them mirrored, or begin at the wrong end: seen from the front the board's
    axes keep their sense, and its first square is black.
    """
    across, down = pixels[0, -1] - pixels[0, 0], pixels[-1, 0] - pixels[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        pixels = pixels[:, ::-1]
    first = 1.5 * pixels[0, 0] - 0.5 * pixels[1, 1]
    beside = 0.5 * (pixels[0, 0] + pixels[1, 1]) + 0.5 * (pixels[0, 0] - pixels[0, 1])
    if _value(grey, first) > _value(grey, beside):
        pixels = pixels[::-1, ::-1]
    return pixels


def _value(grey: Grey, at: Floats) -> float:
    x, y = np.clip(np.round(at).astype(int), 1, np.array(grey.shape[::-1]) - 2)
    return float(grey[y - 1 : y + 2, x - 1 : x + 2].mean())
