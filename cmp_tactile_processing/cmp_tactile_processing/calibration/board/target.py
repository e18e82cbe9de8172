"""The flat board that cameras are calibrated with: a chessboard, or one with ArUco markers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError

__all__ = ["BoardTarget"]

KINDS = ("chessboard", "charuco")
FEWEST_CORNERS, MOST_CORNERS = 3, 60
DEFAULT_DICTIONARY = "DICT_4X4_1000"


@dataclass(frozen=True)
class BoardTarget:
    """A board: cols x rows inner corners, `square` m apart.

    kind: chessboard or charuco.  marker: side of the markers, m, and dictionary: OpenCV's name of
    their set, such as DICT_5X5_100; of a ChArUco board alone.

    Board frame: origin at corner (0, 0), x along increasing column, y along increasing row, z into
    the board: someone who looks at its front sees x to the right and y downwards.  Corner (i, j) is
    number i * cols + j, as OpenCV counts those of a ChArUco board.  On a chessboard (0, 0) is the
    corner whose square between it and (1, 1) is dark, where that tells the ends apart.

    Raises CalibrationError naming the field, what was found and what is expected.
    """

    kind: str
    cols: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = DEFAULT_DICTIONARY

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            _refuse("kind", self.kind, " or ".join(KINDS))
        for name in ("cols", "rows"):
            found = getattr(self, name)
            if not FEWEST_CORNERS <= found <= MOST_CORNERS:
                allowed = f"{FEWEST_CORNERS} to {MOST_CORNERS} inner corners"
                _refuse(name, found, f"{allowed} (a board of n squares has n - 1)")
        if not 0 < self.square < float("inf"):
            _refuse("square", self.square, "a length in m above 0")
        if self.kind == "charuco":
            self._check_markers()

    def _check_markers(self) -> None:
        if not 0 < self.marker < self.square:
            _refuse(
                "marker", self.marker, f"a length in m between 0 and the square's {self.square}"
            )
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or not isinstance(number, int):
            _refuse("dictionary", self.dictionary, "a name of OpenCV's, such as DICT_5X5_100")
        there = len(_dictionary(self.dictionary).bytesList)
        needed = (self.cols + 1) * (self.rows + 1) // 2
        if there < needed:
            _refuse("dictionary", f"{self.dictionary} of {there}", f"at least {needed} markers")

    @property
    def count(self) -> int:
        """Number of inner corners."""
        return self.rows * self.cols

    @property
    def points(self) -> NDArray[np.float64]:
        """Corners (rows * cols, 3) in the board frame, m."""
        y, x = np.mgrid[: self.rows, : self.cols] * self.square
        return np.stack([x.ravel(), y.ravel(), np.zeros(self.count)], axis=1)

    @property
    def symmetries(self) -> list[NDArray[np.intp]]:
        """Orders in which the corners may be numbered and the board looks the same.

        Each is a permutation (rows * cols,); the first leaves all in place.  A ChArUco board and a
        chessboard of even by odd corners have no other.
        """
        numbers = np.arange(self.count).reshape(self.rows, self.cols)
        turns = [0]
        if self.kind == "chessboard" and (self.rows + self.cols) % 2 == 0:
            turns = [0, 1, 2, 3] if self.rows == self.cols and self.rows % 2 == 0 else [0, 2]
        return [np.rot90(numbers, turn).ravel() for turn in turns]

    def charuco_board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's model of a ChArUco board."""
        size = self.cols + 1, self.rows + 1
        return cv2.aruco.CharucoBoard(size, self.square, self.marker, _dictionary(self.dictionary))

    def picture(self, square_px: int) -> NDArray[np.uint8]:
        """The board as it is printed, ((rows + 1) * square_px, (cols + 1) * square_px), 0 or 255.

        Its first pixel's corner lies one square outside corner (0, 0) in x and y.
        """
        height, width = (self.rows + 1) * square_px, (self.cols + 1) * square_px
        if self.kind == "charuco":
            drawn = self.charuco_board().generateImage((width, height), marginSize=0)
            return np.asarray(drawn, dtype=np.uint8)
        y, x = np.mgrid[:height, :width] // square_px
        return np.where((x + y) % 2 == 0, 0, 255).astype(np.uint8)

    def __str__(self) -> str:
        return f"{self.kind} of {self.cols} x {self.rows} corners, {1e3 * self.square:g} mm squares"


@lru_cache(maxsize=8)
def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _refuse(field: str, found: object, expected: str) -> None:
    msg = f"board target: {field}: found {found}, expected {expected}"
    raise CalibrationError(msg)
