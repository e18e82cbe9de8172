"""Score of a tracked grid against the exact one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.measured import Grid, GridShape, Status

Flags = NDArray[np.bool_]

# A number is wrong where the corner lies this share of a checker's side from its true place.
WRONG_SHARE = 0.5
# Parts in which a true gridline is cut between two of its known points.
LINE_PARTS = 8

Array = NDArray[np.float64]


def _none() -> Array:
    return np.empty(0)


@dataclass(frozen=True)
class GridScore:
    """Counts of corners, and distances from the truth in px, of one or many grids.

    visible, far: corners that are; found_*: those of them that are measured, with right numbers.
    filled: visible corners that are predicted, with right numbers.
    wrong: corners, measured or predicted, nearer to another true corner or half a checker off.
    complete: grids with every visible corner found and none wrong; complete_far: every far one.
    corner: distances of found visible corners.  measured, predicted: distances of virtual
    markers from their true gridline, between visible corners.
    """

    grids: int = 0
    complete: int = 0
    complete_far: int = 0
    visible: int = 0
    far: int = 0
    found_visible: int = 0
    found_far: int = 0
    filled: int = 0
    wrong: int = 0
    corner: Array = field(default_factory=_none)
    measured: Array = field(default_factory=_none)
    predicted: Array = field(default_factory=_none)

    @property
    def corner_rmse(self) -> float:
        """Root mean square distance of the corners, px; NaN without any."""
        return _rms(self.corner)

    @property
    def corner_max(self) -> float:
        """Largest distance of a corner, px; NaN without any."""
        return float(self.corner.max()) if len(self.corner) else float("nan")

    @property
    def virtual(self) -> Array:
        """Distances of all virtual markers."""
        return np.concatenate([self.measured, self.predicted])

    @property
    def virtual_rms(self) -> float:
        """Root mean square distance of the virtual markers across their lines, px."""
        return _rms(self.virtual)

    @property
    def virtual_p99(self) -> float:
        """The distance that one of a hundred virtual markers exceeds, px."""
        return float(np.percentile(self.virtual, 99)) if len(self.virtual) else float("nan")


def _rms(distances: Array) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else float("nan")


def score_grid(grid: Grid, truth: Grid, visible: Flags, far: Flags) -> GridScore:
    """Compare a grid with the exact one; both in px of the view.

    visible, far (rows, cols): what can be seen, and what must be found.  Virtual markers are left
    out where the grid has another number of them to a segment than it has positions.
    """
    given = (grid.corner_status != Status.MISSING) & np.isfinite(grid.corners[..., 0])
    measured = given & (grid.corner_status == Status.MEASURED)
    error = np.linalg.norm(grid.corners - truth.corners, axis=-1)
    wrong = given & _wrong(grid.corners, truth.corners, error)
    right = measured & ~wrong
    found_visible, found_far = int((right & visible).sum()), int((right & far).sum())
    faultless = not wrong.any()
    virtual = _virtual_errors(grid, truth, visible)
    return GridScore(
        grids=1,
        complete=int(faultless and found_visible == int(visible.sum())),
        complete_far=int(faultless and found_far == int(far.sum())),
        visible=int(visible.sum()),
        far=int(far.sum()),
        found_visible=found_visible,
        found_far=found_far,
        filled=int((given & ~measured & ~wrong & visible).sum()),
        wrong=int(wrong.sum()),
        corner=error[right & visible],
        measured=virtual[0],
        predicted=virtual[1],
    )


def join_scores(scores: Iterable[GridScore]) -> GridScore:
    """The score of all grids together."""
    parts = [vars(GridScore()), *(vars(score) for score in scores)]
    joined: dict[str, Any] = {
        name: sum(part[name] for part in parts)
        if isinstance(start, int)
        else np.concatenate([part[name] for part in parts])
        for name, start in parts[0].items()
    }
    return GridScore(**joined)


def displacement_errors(
    first: tuple[Grid, Grid], second: tuple[Grid, Grid], visible: Flags
) -> Array:
    """How far displacements from the first to the second frame are off, px.

    first, second: grid and truth.  Of corners that are visible and measured in both; of a print
    with flaws this shows more than places, since its corners are not where they should be.
    """
    (grid_a, truth_a), (grid_b, truth_b) = first, second
    both = visible & (grid_a.corner_status == Status.MEASURED)
    both &= grid_b.corner_status == Status.MEASURED
    off = (grid_b.corners - grid_a.corners) - (truth_b.corners - truth_a.corners)
    return np.asarray(np.linalg.norm(off, axis=-1)[both])


def grid_of_corners(shape: GridShape, corners: Array | None, truth: Grid) -> Grid:
    """The grid of a detector that gives corners (n, 2) px of the view, or None, and no numbers.

    Numbered in favour of the detector: a whole grid takes that of its eight or four orders which
    fits the truth best, and loose points the numbers of the true corners next to them.
    """
    grid = Grid.missing(shape, "not found", truth.placement)
    if corners is None or not len(corners):
        return grid
    if len(corners) == shape.rows * shape.cols:
        orders = _orders(corners, shape)
        placed = min(orders, key=lambda order: float(np.nansum((order - truth.corners) ** 2)))
    else:
        placed = _next_to(corners, truth.corners)
    status = np.where(np.isfinite(placed[..., 0]), Status.MEASURED, Status.MISSING)
    return replace(grid, corners=placed, corner_status=status.astype(np.uint8))


def _orders(corners: Array, shape: GridShape) -> list[Array]:
    lying = corners.reshape(shape.rows, shape.cols, 2)
    standing = corners.reshape(shape.cols, shape.rows, 2).swapaxes(0, 1)
    return [grid[::up, ::left] for grid in (lying, standing) for up in (1, -1) for left in (1, -1)]


def _next_to(corners: Array, truth: Array) -> Array:
    flat = truth.reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(flat[:, 0]))
    placed = np.full_like(flat, np.nan)
    distance, nearest = cKDTree(flat[known]).query(corners)
    for k in np.argsort(-distance):
        placed[known[nearest[k]]] = corners[k]
    return placed.reshape(truth.shape)


def _wrong(corners: Array, truth: Array, error: Array) -> Flags:
    """Corners that lie nearer to another true corner, or half a checker from their own."""
    flat, known = truth.reshape(-1, 2), np.isfinite(truth[..., 0]).ravel()
    if not known.any():
        return np.zeros(error.shape, np.bool_)
    steps = [np.linalg.norm(np.gradient(truth, axis=axis), axis=-1) for axis in (0, 1)]
    wrong = error > WRONG_SHARE * np.fmin(*steps)
    numbers = np.flatnonzero(known)
    given = np.flatnonzero(np.isfinite(corners[..., 0]).ravel())
    if len(given):
        _, nearest = cKDTree(flat[numbers]).query(corners.reshape(-1, 2)[given])
        other = numbers[nearest] != given
        wrong.ravel()[given] |= other & known[given]
    return np.asarray(wrong)


def _virtual_errors(grid: Grid, truth: Grid, visible: Flags) -> tuple[Array, Array]:
    """Distances of measured and of predicted virtual markers from their gridlines."""
    kinds: dict[Status, list[Array]] = {Status.MEASURED: [_none()], Status.PREDICTED: [_none()]}
    for points, status, line, seen in (
        (grid.row_lines, grid.row_line_status, _line(truth.corners, truth.row_lines), visible),
        (
            grid.col_lines.swapaxes(0, 1),
            grid.col_line_status.swapaxes(0, 1),
            _line(truth.corners.swapaxes(0, 1), truth.col_lines.swapaxes(0, 1)),
            visible.T,
        ),
    ):
        between = seen[:, :-1] & seen[:, 1:]
        segments = between.shape[1]
        parts = (line.shape[1] - 1) // segments
        for segment in range(segments):
            window = line[:, max(segment - 1, 0) * parts : (segment + 2) * parts + 1]
            distance = _distance(points[:, segment], window)
            use = between[:, segment, None] & np.isfinite(distance)
            for kind, found in kinds.items():
                found.append(distance[use & (status[:, segment] == kind)])
    return np.concatenate(kinds[Status.MEASURED]), np.concatenate(kinds[Status.PREDICTED])


def _line(corners: Array, between: Array) -> Array:
    """True gridlines (n, points, 2) through corners (n, m, 2) and points (n, m - 1, k, 2).

    Cubics through four neighbours: chords would cut the bends by more than what is judged.
    """
    rows = np.concatenate([corners[:, :-1, None], between], axis=2).reshape(len(corners), -1, 2)
    known = np.concatenate([rows, corners[:, -1:]], axis=1)
    if known.shape[1] < 3:
        return known
    padded = np.pad(known, ((0, 0), (1, 1), (0, 0)), constant_values=np.nan)
    before, start, end, after = (padded[:, k : padded.shape[1] - 3 + k] for k in range(4))
    before = np.where(np.isnan(before), 3 * start - 3 * end + after, before)
    after = np.where(np.isnan(after), 3 * end - 3 * start + before, after)
    t = (np.arange(LINE_PARTS) / LINE_PARTS)[:, None]
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    points = (before, start, end, after)
    fine = sum(w * p[:, :, None] for w, p in zip(weights, points, strict=True))
    dense = np.asarray(fine).reshape(len(corners), -1, 2)
    return np.concatenate([dense, known[:, -1:]], axis=1)


def _distance(points: Array, line: Array) -> Array:
    """Distances (n, k) of points (n, k, 2) from polylines (n, m, 2); NaN where unknown."""
    # x and y apart: sums over an axis of two take most of the time.
    (start_x, start_y) = (line[:, None, :-1, axis] for axis in (0, 1))
    (along_x, along_y) = (np.diff(line[..., axis], axis=1)[:, None] for axis in (0, 1))
    off_x, off_y = points[:, :, None, 0] - start_x, points[:, :, None, 1] - start_y
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (off_x * along_x + off_y * along_y) / (along_x**2 + along_y**2)
    t = t.clip(0, 1)
    squared = (off_x - t * along_x) ** 2 + (off_y - t * along_y) ** 2
    return np.asarray(np.sqrt(np.fmin.reduce(squared, axis=-1)))
