"""Flat printed targets: the places of their corners, and their images.

The frame ``target`` has its origin in the middle of the board, x to the right, y up and z towards
the viewer. Lengths are those of the print [m].
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from flangeye.types import Floats

BoardImage = NDArray[np.uint8]

BoardKind = Literal["charuco", "checkerboard", "marker", "circles"]

DICTIONARIES = (
    *(f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
)  # fmt: skip
"""Families of markers, as OpenCV names them after ``DICT_``; AprilTags are among them."""


def _known(name: str) -> str:
    name = name.removeprefix("DICT_")
    by_name = {known.lower(): known for known in DICTIONARIES}
    if name.lower() not in by_name:
        raise ValueError(f"no dictionary '{name}'; known: {', '.join(DICTIONARIES)}")
    return by_name[name.lower()]


Dictionary = Annotated[str, AfterValidator(_known)]
"""Name of a family in a recipe."""


@dataclass(frozen=True)
class Board:
    """One printed board.

    Attributes:
        kind: ChArUco board, plain checkerboard, or one marker alone.
        columns: Squares from left to right; 1 for a marker.
        rows: Squares from top to bottom.
        square: Edge of a square, or of the marker [m].
        marker: Edge of a ChArUco board's markers [m].
        dictionary: Family of the markers, one of :data:`DICTIONARIES`.
        marker_id: Number of the marker, for a single marker.
    """

    kind: BoardKind
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = "4X4_50"
    marker_id: int = 0

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        if self.kind == "circles":
            # OpenCV counts circles of one row, which are two squares apart, with a margin of one
            # square.
            return (2 * self.columns + 1) * self.square, (self.rows + 1) * self.square
        return self.columns * self.square, self.rows * self.square

    def inner_corners(self) -> Floats:
        """Return the (N, 3) corners between squares in ``target`` [m], row by row from the top."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.place(np.asarray(np.stack([x, y], axis=-1).reshape(-1, 2) * self.square))

    def circle_centres(self) -> Floats:
        """Return the (N, 3) centres of the circles in ``target`` [m], row by row from the top.

        Every other row begins half a step, which is one ``square``, further to the right.
        """
        row, column = np.indices((self.rows, self.columns)).reshape(2, -1)
        # OpenCV's asymmetric grid: circles of one row are two squares apart, and odd rows are
        # shifted by one
        places = np.stack([2 * column + row % 2 + 1, row + 1], axis=1)
        return self.place(np.asarray(places * self.square))

    def outer_corners(self) -> Floats:
        """Return the (4, 3) corners in ``target`` [m], clockwise from the top left."""
        width, height = self.size
        return self.place(np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]))

    def place(self, from_top_left: Floats) -> Floats:
        """Return positions (N, 2), right and down from the top left corner, in ``target`` [m]."""
        width, height = self.size
        # Print coordinates run down, ``target`` runs up, so that its z leaves the paper towards the
        # viewer.
        x, y = from_top_left[:, 0] - width / 2, height / 2 - from_top_left[:, 1]
        return np.stack([x, y, np.zeros(len(x))], axis=1)


def dictionary_of(name: str) -> Any:
    """Return OpenCV's dictionary of a family of markers, one of :data:`DICTIONARIES`."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def charuco_of(board: Board) -> Any:
    """Return OpenCV's description of a ChArUco board."""
    import cv2

    size = (board.columns, board.rows)
    return cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary_of(board.dictionary))


def print_of(board: Board, per_square: int = 120) -> BoardImage:
    """Return the print of a board, (rows, columns) x ``per_square`` pixels, without a margin."""
    import cv2

    size = (board.columns * per_square, board.rows * per_square)
    if board.kind == "charuco":
        return np.asarray(charuco_of(board).generateImage(size, marginSize=0), dtype=np.uint8)
    if board.kind == "marker":
        family = dictionary_of(board.dictionary)
        marker = cv2.aruco.generateImageMarker(family, board.marker_id, size[0])
        return np.asarray(marker, dtype=np.uint8)
    if board.kind == "circles":
        return _discs(board, per_square)
    rows, columns = np.indices((board.rows, board.columns))
    squares = np.where((rows + columns) % 2 == 0, 0, 255).astype(np.uint8)
    return np.kron(squares, np.ones((per_square, per_square), np.uint8))


def _discs(board: Board, per_square: int) -> BoardImage:
    """Return black discs on white."""
    import cv2

    width, height = board.size
    columns, rows = (round(length / board.square) * per_square for length in (width, height))
    page = np.full((rows, columns), 255, np.uint8)
    radius = round(board.marker / board.square / 2 * per_square)
    for x, y, _ in board.circle_centres():
        across, down = (x + width / 2) / board.square, (height / 2 - y) / board.square
        # Pixels have whole numbers at their centres, the print at their edges: half a pixel less
        middle = [round(16 * (place * per_square - 0.5)) for place in (across, down)]
        cv2.circle(page, middle, 16 * radius, 0, -1, cv2.LINE_AA, 4)  # in sixteenths of a pixel
    return page
