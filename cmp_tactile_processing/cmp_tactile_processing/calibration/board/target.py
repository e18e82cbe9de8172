"""The flat board that cameras are calibrated with, and where images show it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.split import to_grey
from cmp_tactile_processing.image.prepared import Prefilter, contrast_of
from cmp_tactile_processing.tracking.corners.saddle_point import MODEL_PER_SIDE, SaddlePointFit

KINDS = ("chessboard", "charuco")
FEWEST_CORNERS, MOST_CORNERS = 3, 60
DEFAULT_DICTIONARY = "DICT_4X4_1000"
# A part of a board with fewer corners says next to nothing.
FEWEST_SEEN = 6
# How far a refined corner may lie from where the detector saw it, in sides of a square.
REACH_PER_SIDE, LEAST_REACH_PX = 0.15, 1.5
LEAST_CONTRAST = 10.0
# Beside the board are corners of a larger one where most of a line are about as sharp as its own.
ALIKE, MOST = 0.5, 0.6
LEAST_SIDE_PX = 4.0
CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
# Longer side, px.  The time of OpenCV's older search grows with the square of the pixels where
# there is noise and no board: 1 s at this size, 144 s at 2592 x 1944 px.
MOST_CLASSIC_SIDE_PX = 1000


@dataclass(frozen=True)
class BoardTarget:
    """A board: cols x rows inner corners, `square` m apart.

    kind: chessboard or charuco.  marker: side of the markers, m, and dictionary: OpenCV's name of
    their set, such as DICT_5X5_100; of a ChArUco board alone.

    Board frame: origin at corner (0, 0), x along increasing column, y along increasing row, z into
    the board: someone who looks at its front sees x to the right and y downwards.  Corner (i, j) is
    number i * cols + j, as OpenCV counts those of a ChArUco board.  On a chessboard (0, 0) is the
    corner whose square between it and (1, 1) is dark, where that makes the ends differ.

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
                _refuse(name, found, f"{allowed} (a board with n squares along a side has n - 1)")
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
            _refuse(
                "dictionary",
                f"{self.dictionary} with {there} markers",
                f"at least {needed} markers",
            )

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


@dataclass(frozen=True)
class BoardSighting:
    """A board, or part of one, in an image.

    number (n,): of each corner; pixels (n, 2) of the view image; std (n,): of a pixel coordinate,
    by the image's noise.  blur_px: standard deviation of the edges' blur where it is worst;
    side_px: side of the smallest squares.  size: width and height of the image, px.
    """

    view: str
    number: NDArray[np.intp]
    pixels: NDArray[np.float64]
    std: NDArray[np.float64]
    blur_px: float
    side_px: float
    size: tuple[int, int]


def find_board(
    image: NDArray[np.uint8], target: BoardTarget, view: str = ""
) -> BoardSighting | None:
    """The board in an un-mirrored image (H, W) or (H, W, 3) uint8, None where it is not seen.

    A ChArUco board may be partly hidden, but for two lines of corners; a chessboard must be seen
    as a whole.  Found by OpenCV,
    then each corner is refined as those of the gel's pattern are: on photographs that leaves less
    reprojection error than cv2.cornerSubPix.  Where a chessboard looks the same turned round, one
    of target.symmetries is taken.

    Raises FrameError for an image of another type.
    """
    grey = np.ascontiguousarray(to_grey(image))
    corners = _charuco(grey, target) if target.kind == "charuco" else _chessboard(grey, target)
    if corners is None:
        return None
    side = _smallest_side(corners)
    if not side >= LEAST_SIDE_PX:
        return None
    number = np.flatnonzero(np.isfinite(corners[..., 0]))
    pixels, std = _refined(grey, target, corners.reshape(-1, 2)[number], side)
    kept = np.isfinite(pixels[:, 0])
    if np.count_nonzero(kept) < FEWEST_SEEN or _on_one_line(target, number[kept]):
        return None
    corners.reshape(-1, 2)[number] = pixels
    if target.kind == "chessboard" and _goes_on(grey, corners, side):
        return None
    blur = _blur(grey, corners)
    size = grey.shape[1], grey.shape[0]
    return BoardSighting(view, number[kept], pixels[kept], std[kept], blur, side, size)


def chessboard_size(image: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Inner corners (cols, rows) of a chessboard of any size in an image, None without one.

    The longer side counts as cols.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    grey = np.ascontiguousarray(to_grey(image))
    found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    if not found or meta is None:
        return None
    return max(meta.shape), min(meta.shape)


def _chessboard(grey: NDArray[np.uint8], target: BoardTarget) -> NDArray[np.float64] | None:
    """Corners (rows, cols, 2) px in the order of the target."""
    size = target.cols, target.rows
    found, corners = cv2.findChessboardCornersSB(grey, size)
    if not found:
        # On blurred images it finds more.
        reduction = max(1.0, max(grey.shape) / MOST_CLASSIC_SIDE_PX)
        small = cv2.resize(
            grey, None, fx=1 / reduction, fy=1 / reduction, interpolation=cv2.INTER_AREA
        )
        found, corners = cv2.findChessboardCorners(small, size, flags=CLASSIC)
        if found:
            corners = (corners + 0.5) * reduction - 0.5
    if not found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(target.rows, target.cols, 2)
    along, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    if np.linalg.det(np.stack([along.sum(axis=0), down.sum(axis=0)])) < 0:
        grid = grid[:, ::-1]
    # Turned so that the square after corner (0, 0) is dark, where a turn changes that.
    for turn in range(4):
        turned = np.rot90(grid, turn)
        if turned.shape == grid.shape and _dark_first(grey, turned):
            return np.array(turned)
    return np.array(grid)


def _dark_first(grey: NDArray[np.uint8], grid: NDArray[np.float64]) -> bool:
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    values = _sample(grey, centres)
    i, j = np.indices(values.shape)
    even = (i + j) % 2 == 0
    return bool(values[even].mean() < values[~even].mean())


def _charuco(grey: NDArray[np.uint8], target: BoardTarget) -> NDArray[np.float64] | None:
    """Corners (rows, cols, 2) px, NaN where they are not seen."""
    board = target.charuco_board()
    found, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    # OpenCV gives None instead of an empty array.
    if np.size(ids) < FEWEST_SEEN:
        # Up to OpenCV 4.5, boards with an even number of rows began with a light square.
        board.setLegacyPattern(True)
        found, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    if np.size(ids) < FEWEST_SEEN:
        return None
    corners = np.full((target.count, 2), np.nan)
    corners[np.ravel(ids)] = np.reshape(found, (-1, 2))
    return corners.reshape(target.rows, target.cols, 2)


def _smallest_side(corners: NDArray[np.float64]) -> float:
    sides = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    known = np.concatenate(sides)
    known = known[np.isfinite(known)]
    return float(np.quantile(known, 0.05)) if known.size else float("nan")


def _on_one_line(target: BoardTarget, number: NDArray[np.intp]) -> bool:
    """Whether corners of these numbers lie on one line of the board: they show no plane."""
    p = target.points[number, :2] / target.square
    return bool(np.linalg.matrix_rank(p - p.mean(axis=0), tol=1e-6) < 2)


def _refined(
    grey: NDArray[np.uint8], target: BoardTarget, start: NDArray[np.float64], side: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (n, 2) px and their standard deviation (n,); NaN where there is no saddle."""
    clear = side
    if target.kind == "charuco":
        # The window must not reach the marker in the square; its corner is nearest.
        margin = (1 - target.marker / target.square) / 2 * np.sqrt(2)
        clear = side * min(1.0, margin / MODEL_PER_SIDE)
    reach = max(REACH_PER_SIDE * side, LEAST_REACH_PX)
    prepared = Prefilter((grey.shape[0], grey.shape[1]), clear).prepare(grey)
    points = SaddlePointFit(clear).fit(prepared, start, reach)
    return points.position, points.std


def _goes_on(grey: NDArray[np.uint8], corners: NDArray[np.float64], side: float) -> bool:
    """Whether there is a further line of corners beside those of a chessboard.

    OpenCV finds a board in a part of a larger one too, and not in the same part in each image.
    """
    prepared = Prefilter((grey.shape[0], grey.shape[1]), side).prepare(grey)
    fit, reach = SaddlePointFit(side), max(REACH_PER_SIDE * side, LEAST_REACH_PX)
    inside = _strength(fit.fit(prepared, corners.reshape(-1, 2), reach).hessian)
    usual = float(np.nanmedian(inside))
    for grid in (np.rot90(corners, turn) for turn in range(4)):
        beyond = fit.fit(prepared, 2 * grid[0] - grid[1], reach)
        strong = _strength(beyond.hessian) > ALIKE * usual
        if np.mean(strong & np.isfinite(beyond.position[:, 0])) > MOST:
            return True
    return False


def _strength(hessian: NDArray[np.float64]) -> NDArray[np.float64]:
    """How sharp saddles are, from their second derivatives (n, 3): xx, xy, yy."""
    xx, xy, yy = hessian.T
    return np.asarray(np.sqrt(np.maximum(xy * xy - xx * yy, 0.0)))


def _blur(grey: NDArray[np.uint8], corners: NDArray[np.float64]) -> float:
    """Standard deviation of the blur across the squares' sides, px: of the blurrier direction."""
    low = np.nanmin(corners, axis=(0, 1)).astype(int).clip(0)
    high = np.nanmax(corners, axis=(0, 1)).astype(int) + 1
    contrast = contrast_of(np.ascontiguousarray(grey[low[1] : high[1], low[0] : high[0]]))
    if contrast < LEAST_CONTRAST:
        return float("nan")
    widths = []
    for axis in (0, 1):
        step = np.diff(corners, axis=axis)
        middle = (np.delete(corners, -1, axis) + step / 2).reshape(-1, 2)
        normal = np.stack([-step[..., 1], step[..., 0]], axis=-1).reshape(-1, 2)
        known = np.isfinite(middle[:, 0])
        if not known.any():
            continue
        middle, normal = middle[known], normal[known]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        slope = np.abs(_sample(grey, middle + normal) - _sample(grey, middle - normal)) / 2
        widths.append(contrast / (np.sqrt(2 * np.pi) * max(float(np.median(slope)), 1e-3)))
    return float(max(widths)) if widths else float("nan")


def _sample(grey: NDArray[np.uint8], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grey levels (...) at pixels (..., 2), bilinear."""
    x, y = np.moveaxis(q.astype(np.float32), -1, 0)
    flat = cv2.remap(
        grey.astype(np.float32),
        x.reshape(-1, 1),
        y.reshape(-1, 1),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(flat, dtype=np.float64).reshape(q.shape[:-1])
