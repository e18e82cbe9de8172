"""Contour stitching: from an image to the graph of checker corners (paper, III.A).

Each checker's outline gives a quadrangle; corners of diagonal neighbours that lie together are
merged (Algorithm 1), which connects the outlines to gridlines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cmp_tactile_processing.corner_graph import STEPS, CornerGraph
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.prepared_image import PreparedImage

__all__ = [
    "CORNER_SIGNS",
    "Checkers",
    "ContourStitching",
    "Pretreatment",
    "build_graph",
    "find_checkers",
    "merge_corners",
]

# The four corners of a checker by the direction from its centre: sign along i, sign along j.
# In cyclic order, so that corner k and corner (k + 2) % 4 lie opposite each other.
CORNER_SIGNS = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])

# A deformed checker may shrink or grow by this much in side before it is taken for something else.
SMALLEST_SIDE, LARGEST_SIDE = 0.35, 2.2
# A side of a checker differs from the nominal one by less than this share of its length, however
# the gel stretches, shears and turns; beyond it another pattern or a false outline is seen.
LARGEST_STRAIN = 0.6
# Outlines this far (in sides) from every nominal corner belong to the housing.
FARTHEST_CENTRE = 4.0
# Share of the image's grey range by which a checker differs from the mean around it.
LEAST_CONTRAST = 0.05
# Algorithm 1's thresholds, in sides: diagonal neighbours' centres are sqrt(2) sides apart.
L_CHECKER, L_CORNER = 2.2, 0.45


@dataclass(frozen=True)
class Pretreatment:
    """How an image is made binary: `block` in sides of a checker, `erosion` in px.

    dark: whether the dark checkers are the separate ones (else the light ones).
    """

    block: float
    erosion: int
    dark: bool = True


@dataclass(frozen=True)
class Checkers:
    """Quadrangles of the checkers of one colour: corners (n, 4, 2) px ordered as CORNER_SIGNS."""

    corners: NDArray[np.float64]

    @property
    def centres(self) -> NDArray[np.float64]:
        """Centres, (n, 2) px."""
        return np.asarray(self.corners.mean(axis=1))


# Tried in turn until one shows the whole grid; the paper repeats its pretreatment likewise.
PRETREATMENTS = (Pretreatment(1.5, 2), Pretreatment(1.5, 1), Pretreatment(2.0, 3))
# The other colour is tried only where the first showed less than this share of the corners: a
# margin of a colour joins the outermost checkers of that colour to one blob.
ENOUGH_FROM_ONE_COLOUR = 0.5
# What a further pretreatment must add to go on.
LITTLE_GAIN = 0.02
# Outlines are taken at this side of a checker at least; smaller checkers are magnified for it.
MAGNIFY_BELOW_PX = 10.0


class ContourStitching:
    """The paper's detector: the outlines of the checkers, joined where corners lie together.

    nominal: the grid at rest, in pixels of the prepared image; dark_first: whether the pattern's
    corner checker is dark, so that its margin is light and the dark checkers are the separate ones.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._magnification = int(np.ceil(MAGNIFY_BELOW_PX / nominal.smallest_side_px))
        self._nominal = nominal.magnified(self._magnification)
        colours = (dark_first, not dark_first)
        self._pretreatments = [replace(item, dark=k) for k in colours for item in PRETREATMENTS]

    def corner_graph(self, image: PreparedImage) -> CornerGraph:
        """Corners and pointers of the pretreatment that connects most corners; may be empty."""
        factor = self._magnification
        grey = np.asarray(cv2.medianBlur(image.grey, 3), dtype=np.uint8)
        if factor > 1:
            grey = np.asarray(cv2.resize(grey, None, fx=factor, fy=factor), dtype=np.uint8)
        rows, cols = self._nominal.corners.shape[:2]
        total = rows * cols
        most = -1
        first = self._pretreatments[0]
        for pretreatment in self._pretreatments:
            enough = most > ENOUGH_FROM_ONE_COLOUR * total
            if enough and pretreatment.dark != first.dark:
                break
            graph = self._stitched(grey, pretreatment)
            gain = _largest_set(graph) - most
            if gain > 0:
                best, most = graph, most + gain
            if most >= total or (enough and gain < LITTLE_GAIN * total):
                break
        return replace(best, position=(best.position + 0.5) / factor - 0.5)

    def _stitched(self, grey: NDArray[np.uint8], pretreatment: Pretreatment) -> CornerGraph:
        checkers = find_checkers(grey, self._nominal, pretreatment)
        graph = build_graph(checkers, merge_corners(checkers, self._nominal.side_px))
        if not pretreatment.dark:
            graph = replace(graph, even=~graph.even)
        return graph


def _largest_set(graph: CornerGraph) -> int:
    """Number of inner corners in the largest set that pointers connect."""
    if not graph.merged.any():
        return 0
    index = np.where(graph.merged, np.arange(len(graph.merged)), -1)
    other = np.where(graph.neighbour >= 0, index[graph.neighbour], -1)
    here, towards = np.nonzero((other >= 0) & graph.merged[:, None])
    links = coo_array(
        (np.ones(len(here)), (here, other[here, towards])), shape=(len(index), len(index))
    )
    return int(np.bincount(connected_components(links, directed=False)[1][graph.merged]).max())


def find_checkers(
    median: NDArray[np.uint8], nominal: NominalGrid, pretreatment: Pretreatment
) -> Checkers:
    """Quadrangles of all checkers of one colour: pretreatment, contours, polygon fitting.

    median: the median-filtered view image, (H, W) grey.
    """
    mask = _separate(median, nominal.side_px, pretreatment)
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    shrink = pretreatment.erosion
    low = (max(SMALLEST_SIDE * nominal.smallest_side_px - 2 * shrink, 2.0)) ** 2
    high = (LARGEST_SIDE * nominal.largest_side_px) ** 2
    quads = []
    for contour in contours:
        if len(contour) >= 4 and low <= (area := cv2.contourArea(contour)) <= high:
            quad = _quadrangle(contour, area)
            if quad is not None:
                quads.append(quad)
    if not quads:
        return Checkers(np.empty((0, 4, 2)))
    # A contour runs through pixel centres: its outline lies half a pixel inside the edge.
    corners = _expanded(np.array(quads), shrink + 0.5)
    near = nominal.tree.query(corners.mean(axis=1))[0] < FARTHEST_CENTRE * nominal.side_px
    checkers = _ordered(corners[near], nominal)
    return Checkers(checkers.corners[_right_sides(checkers, nominal)])


def merge_corners(checkers: Checkers, side_px: float) -> NDArray[np.intp]:
    """Pairs of corners that are the same corner of the pattern (paper, Algorithm 1).

    Returns (m, 4): checker a, its corner, checker b, its corner.  Neighbours come from a k-d tree;
    a corner merges with the opposite-numbered corner of a neighbour when both are each other's
    nearest.
    """
    if len(checkers.corners) < 2:
        return np.empty((0, 4), dtype=np.intp)
    near = cKDTree(checkers.centres).query_pairs(L_CHECKER * side_px, output_type="ndarray")
    near = np.concatenate([near, near[:, ::-1]])
    limit = L_CORNER * _sides(checkers)[near].min(axis=1)
    rows = []
    for k in (0, 1):
        apart = checkers.corners[near[:, 0], k + 2] - checkers.corners[near[:, 1], k]
        gap = np.linalg.norm(apart, axis=1)
        close = gap < limit
        a, b = _mutually_nearest(near[close], gap[close]).T
        rows.append(np.column_stack([a, np.full(len(a), k + 2), b, np.full(len(b), k)]))
    return np.concatenate(rows)


def build_graph(checkers: Checkers, pairs: NDArray[np.intp]) -> CornerGraph:
    """Pointer establishment: merged corners, and pointers along the edges of the checkers."""
    count = len(checkers.corners)
    a, b = 4 * pairs[:, 0] + pairs[:, 1], 4 * pairs[:, 2] + pairs[:, 3]
    links = coo_array((np.ones(len(a)), (a, b)), shape=(4 * count, 4 * count))
    nodes, label = connected_components(links, directed=False)
    size = np.bincount(label, minlength=nodes)
    flat = checkers.corners.reshape(-1, 2)
    position = np.stack([np.bincount(label, flat[:, d], nodes) for d in (0, 1)], axis=1)
    even = np.zeros(nodes, dtype=bool)
    even[label[a]] = pairs[:, 1] == 2
    neighbour = np.full((nodes, 4), -1, dtype=np.intp)
    label = label.reshape(count, 4)
    for k in range(4):
        following = (k + 1) % 4
        step = (CORNER_SIGNS[following] - CORNER_SIGNS[k]) // 2
        towards = int(np.flatnonzero((step == STEPS).all(axis=1))[0])
        neighbour[label[:, k], towards] = label[:, following]
        neighbour[label[:, following], (towards + 2) % 4] = label[:, k]
    return CornerGraph(position / size[:, None], size == 2, even, neighbour)


def _separate(
    median: NDArray[np.uint8], side_px: float, pretreatment: Pretreatment
) -> NDArray[np.uint8]:
    """Binary image with each checker of the chosen colour a blob of its own."""
    block = max(round(pretreatment.block * side_px) | 1, 3)
    kind = cv2.THRESH_BINARY_INV if pretreatment.dark else cv2.THRESH_BINARY
    # A checker stands out from the mean around it by half the contrast, noise by much less.
    low, high = np.percentile(median[::4, ::4], (5, 95))
    offset = LEAST_CONTRAST * (high - low) * (1 if pretreatment.dark else -1)
    mask = cv2.adaptiveThreshold(median, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, block, offset)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, cross)
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), iterations=pretreatment.erosion)
    return np.asarray(mask, dtype=np.uint8)


def _quadrangle(contour: cv2.typing.MatLike, area: float) -> NDArray[np.float64] | None:
    """Four corners (4, 2) of an outline, clockwise in the image, or None if it is none."""
    side = np.sqrt(area)
    for tolerance in (0.2, 0.3, 0.4):
        polygon = cv2.approxPolyDP(contour, tolerance * side, True)
        if len(polygon) == 4:
            turned_area = cv2.contourArea(polygon, True)
            # What is much dented is no checker.
            if abs(turned_area) < 0.75 * area or area < 0.75 * abs(turned_area):
                return None
            corners = polygon[:, 0].astype(np.float64)
            return corners if turned_area > 0 else corners[::-1]
        if len(polygon) < 4:
            return None
    return None


def _expanded(quads: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Quadrangles (n, 4, 2) with every edge moved outwards by a distance in px."""
    edge = np.roll(quads, -1, axis=1) - quads
    edge /= np.linalg.norm(edge, axis=2, keepdims=True)
    before = np.roll(edge, 1, axis=1)
    # Moving both edges at a corner by d moves the corner by d (before - edge) / sin(angle).
    sine = before[..., 0] * edge[..., 1] - before[..., 1] * edge[..., 0]
    return np.asarray(quads + distance * (before - edge) / np.maximum(sine, 0.3)[..., None])


def _ordered(corners: NDArray[np.float64], nominal: NominalGrid) -> Checkers:
    """Corners of each quadrangle in the order of CORNER_SIGNS, by the nominal axes nearby."""
    if not len(corners):
        return Checkers(corners)
    centres = corners.mean(axis=1)
    steps = np.stack(nominal.axes_near(centres), axis=2)
    offsets = np.einsum("nab,nkb->nka", np.linalg.inv(steps), corners - centres[:, None])
    if np.linalg.det(steps[0]) > 0:
        # Clockwise in the image runs against CORNER_SIGNS' order.
        corners, offsets = corners[:, ::-1], offsets[:, ::-1]
    score = np.stack(
        [(np.roll(offsets, -k, axis=1) * CORNER_SIGNS).sum(axis=(1, 2)) for k in range(4)], axis=1
    )
    turn = (np.arange(4) + score.argmax(axis=1)[:, None]) % 4
    return Checkers(np.take_along_axis(corners, turn[:, :, None], axis=1))


def _right_sides(checkers: Checkers, nominal: NominalGrid) -> NDArray[np.bool_]:
    """Whether each side is about the pattern's there; two joined checkers' sides are not."""
    along_i, along_j = nominal.axes_near(checkers.centres)
    side = np.roll(checkers.corners, -1, axis=1) - checkers.corners
    # Sides 0 and 2 lead towards +j and -j, sides 1 and 3 towards +i and -i.
    strained = np.concatenate(
        [
            np.linalg.norm(side[:, k] - sign * step, axis=1, keepdims=True)
            > LARGEST_STRAIN * np.linalg.norm(step, axis=1, keepdims=True)
            for k, sign, step in (
                (0, 1, along_j),
                (1, 1, along_i),
                (2, -1, along_j),
                (3, -1, along_i),
            )
        ],
        axis=1,
    )
    return np.asarray(~strained.any(axis=1))


def _sides(checkers: Checkers) -> NDArray[np.float64]:
    edges = np.roll(checkers.corners, -1, axis=1) - checkers.corners
    return np.asarray(np.linalg.norm(edges, axis=2).mean(axis=1))


def _mutually_nearest(pairs: NDArray[np.intp], gap: NDArray[np.float64]) -> NDArray[np.intp]:
    """The pairs (a, b) of which a is b's nearest and b is a's nearest."""
    order = np.argsort(gap, kind="stable")
    pairs = pairs[order]
    first_a = np.zeros(len(pairs), dtype=bool)
    first_b = np.zeros(len(pairs), dtype=bool)
    first_a[np.unique(pairs[:, 0], return_index=True)[1]] = True
    first_b[np.unique(pairs[:, 1], return_index=True)[1]] = True
    return np.asarray(pairs[first_a & first_b])
