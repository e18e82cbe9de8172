"""Contour stitching: from an image to the graph of checker corners (paper, III.A).

Each checker's outline gives a quadrangle; corners of diagonal neighbours that lie together are
merged (Algorithm 1), which connects the outlines to gridlines.  Outlines come from several
pretreatments and from the checkers of both colours; the best one of each checker is stitched.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.contour_stitching.quadrangles import (
    CORNER_SIGNS,
    CheckerOutlines,
    NominalSteps,
    fit_quadrangles,
    least_deviation,
)
from cmp_tactile_processing.tracking.detector import STEPS, CornerGraph, NominalGrid

# Outlines are taken at this side of a checker at least; smaller checkers are magnified for it.
MAGNIFY_BELOW_PX = 10.0
# The first erosion in sides, and at most in px: what parts checkers grows with the lens's blur
# more than with their size.
EROSION, DEEPEST_EROSION = 0.12, 3

# A further pretreatment must add this share of the corners to what hangs together to go on.
LITTLE_GAIN = 0.005

Floats = NDArray[np.float64]
Wholes = NDArray[np.intp]
Flags = NDArray[np.bool_]
# Algorithm 1's thresholds, in sides: diagonal neighbours' centres are sqrt(2) sides apart, more
# where the gel is sheared.
L_CHECKER, L_CORNER = 1.9, 0.55
# Two outlines whose centres are nearer than this, in sides, are of one checker.
ONE_CHECKER = 0.5


@dataclass(frozen=True)
class Pretreatment:
    """One way to make an image binary and to part its checkers.

    smoothing: width of a Gaussian in sides, at least the prepared image's own; offset: see
    `CheckerOutlines`; deeper: px of erosion beyond the least, each giving outlines of its own.
    """

    smoothing: float
    offset: float
    deeper: tuple[int, ...]


# Taken in turn, the checkers of both colours each time, until the corners of the whole grid hang
# together; the paper repeats its pretreatment likewise.  Smoothing straightens ragged edges.
PRETREATMENTS = (
    Pretreatment(smoothing=0.0, offset=0.2, deeper=(0, 1)),
    Pretreatment(smoothing=0.2, offset=0.2, deeper=(1,)),
    Pretreatment(smoothing=0.2, offset=0.4, deeper=(0,)),
)


class ContourStitching:
    """The paper's detector: the outlines of the checkers, joined where corners lie together.

    nominal: the grid at rest, in pixels of the prepared image; dark_first: whether the pattern's
    corner checker is dark, so that its margin is light and the dark checkers are the separate ones.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._magnification = math.ceil(MAGNIFY_BELOW_PX / nominal.smallest_side_px)
        self._nominal = nominal.magnified(self._magnification)
        self._side = self._nominal.side_px
        self._axes = NominalSteps(self._nominal)
        self._erosion = min(max(round(EROSION * self._side), 1), DEEPEST_EROSION)
        self._colours = (dark_first, not dark_first)

    def corner_graph(self, image: PreparedImage) -> CornerGraph:
        """Corners and pointers by the outlines of all pretreatments taken; may be empty."""
        total = self._nominal.corners[..., 0].size
        graph = merge_corners(Checkers.none())
        checkers, most = Checkers.none(), 0
        for found in self._takes(image):
            checkers = best_checkers(checkers.joined(found))
            graph = merge_corners(checkers)
            before, most = most, largest_set(graph)
            if most >= total or 0 <= most - before < LITTLE_GAIN * min(before, total):
                break
        return replace(graph, position=(graph.position + 0.5) / self._magnification - 0.5)

    def _takes(self, image: PreparedImage) -> Iterator[Checkers]:
        """Checkers of one colour, of the other, and then of both in each further pretreatment."""
        least = least_deviation(image)
        one, other = self._colours
        for pretreatment in PRETREATMENTS:
            smooth = self._smoothed(image, pretreatment.smoothing)
            outlines = CheckerOutlines(smooth, self._side, pretreatment.offset, least)
            for deeper in pretreatment.deeper:
                erosion = self._erosion + deeper
                found = self._checkers(outlines, one, erosion)
                if pretreatment is PRETREATMENTS[0] and deeper == pretreatment.deeper[0]:
                    yield found
                    found = Checkers.none()
                yield found.joined(self._checkers(outlines, other, erosion))

    def _smoothed(self, image: PreparedImage, sides: float) -> NDArray[np.float32]:
        """The image magnified, and smoothed by a share of a side in all."""
        smooth, factor = image.smooth, self._magnification
        if factor > 1:
            smooth = np.asarray(cv2.resize(smooth, None, fx=factor, fy=factor), dtype=np.float32)
        missing = (sides * self._side) ** 2 - (image.smoothing_px * factor) ** 2
        if missing > 0:
            smooth = np.asarray(cv2.GaussianBlur(smooth, (0, 0), math.sqrt(missing)), np.float32)
        return smooth

    def _checkers(self, outlines: CheckerOutlines, dark: bool, erosion: int) -> Checkers:
        contours = outlines.contours(dark, erosion)
        # A contour runs through pixel centres, half a pixel inside the edge; the expansion makes
        # that and the erosion good.
        corners, quality = fit_quadrangles(contours, self._axes, erosion + 0.5)
        return Checkers(corners, np.full(len(corners), dark), quality)


# Corner merging: from checkers' quadrangles to corners and their pointers (paper, Algorithm 1). A
# corner merges with the opposite-numbered corner of the diagonal neighbour of its colour.  Where
# the checkers of both colours are outlined, either pair gives the corner, and the pairs join.

# From corner k of a checker to k + 1, which way along the gridline: index into STEPS.
TOWARDS = np.array(
    [
        np.flatnonzero(((CORNER_SIGNS[(k + 1) % 4] - CORNER_SIGNS[k]) // 2 == STEPS).all(axis=1))[0]
        for k in range(4)
    ]
)


@dataclass(frozen=True)
class Checkers:
    """Quadrangles of checkers.

    corners (n, 4, 2) px, ordered as CORNER_SIGNS; dark (n,) bool; quality (n,) of the outlines.
    """

    corners: NDArray[np.float64]
    dark: NDArray[np.bool_]
    quality: NDArray[np.float64]

    @classmethod
    def none(cls) -> Checkers:
        """No checkers at all."""
        return cls(np.empty((0, 4, 2)), np.empty(0, dtype=np.bool_), np.empty(0))

    def joined(self, other: Checkers) -> Checkers:
        """These checkers and others."""
        return Checkers(
            np.concatenate([self.corners, other.corners]),
            np.concatenate([self.dark, other.dark]),
            np.concatenate([self.quality, other.quality]),
        )

    @property
    def centres(self) -> NDArray[np.float64]:
        """Centres, (n, 2) px."""
        return np.asarray(self.corners.mean(axis=1))

    @property
    def sides(self) -> NDArray[np.float64]:
        """Mean sides, (n,) px."""
        edges = np.roll(self.corners, -1, axis=1) - self.corners
        return np.asarray(np.sqrt((edges**2).sum(axis=2)).mean(axis=1))


def best_checkers(checkers: Checkers) -> Checkers:
    """One outline for each checker: of those that share their centres the one of most quality."""
    centres, reach = checkers.centres, ONE_CHECKER * checkers.sides
    order = np.argsort(-checkers.quality, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    pairs = _pairs(centres, float(reach.max(initial=0)))
    # In the order of the better one, so that what is dropped drops nothing itself.
    pairs = np.where((rank[pairs[:, 0]] < rank[pairs[:, 1]])[:, None], pairs, pairs[:, ::-1])
    keep = np.ones(len(order), dtype=bool)
    _drop_worse(pairs[np.argsort(rank[pairs[:, 0]])], centres, reach, keep)
    return Checkers(checkers.corners[keep], checkers.dark[keep], checkers.quality[keep])


def merge_corners(checkers: Checkers) -> CornerGraph:
    """Corners of the checkers, merged where they are the same, and pointers along their edges.

    Corners merge that are each other's nearest.  An inner corner (`merged`) has the opposite
    corners of two checkers of one colour; what does not fit together has no pointers.
    """
    corners = np.ascontiguousarray(checkers.corners)
    sides = checkers.sides
    pairs = _pairs(checkers.centres, L_CHECKER * float(sides.max(initial=0)))
    label, count = _merge(corners, checkers.dark, pairs, L_CORNER * sides)
    position = np.zeros((count, 2))
    merged, even, sound = (np.zeros(count, dtype=bool) for _ in range(3))
    _locate(corners, checkers.dark, label, position, merged, even, sound)
    neighbour = np.full((count, 4), -1, dtype=np.intp)
    _point(label, TOWARDS, merged, sound, neighbour)
    return CornerGraph(position, merged & sound, even, neighbour)


def largest_set(graph: CornerGraph) -> int:
    """Number of inner corners in the largest set that pointers connect."""
    return int(_largest_set(graph.merged, graph.neighbour))


def _pairs(centres: NDArray[np.float64], reach: float) -> NDArray[np.intp]:
    """Pairs (m, 2) of places nearer to each other than `reach`."""
    if len(centres) < 2:
        return np.empty((0, 2), dtype=np.intp)
    # A balanced tree costs more to build than these few queries gain.
    tree = cKDTree(centres, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query_pairs(reach, output_type="ndarray"), dtype=np.intp)


@kernel
def _drop_worse(pairs: Wholes, centres: Floats, reach: Floats, keep: Flags) -> None:
    for p in range(len(pairs)):
        better, worse = pairs[p]
        gap = np.hypot(
            centres[better, 0] - centres[worse, 0], centres[better, 1] - centres[worse, 1]
        )
        if keep[better] and gap < max(reach[better], reach[worse]):
            keep[worse] = False


@kernel_part
def _root(parent: Wholes, item: int) -> int:
    while parent[item] != item:
        parent[item] = parent[parent[item]]
        item = parent[item]
    return item


@kernel
def _merge(corners: Floats, dark: Flags, pairs: Wholes, limit: Floats) -> tuple[Wholes, int]:
    """Number (n, 4) of the node of each corner, and how many nodes there are."""
    count = 4 * len(corners)
    # A corner's partners: the next of the other colour, the opposite one of its own, the last.
    partner = np.full((count, 3), -1, np.intp)
    gap = np.full((count, 3), np.inf)
    for p in range(len(pairs)):
        a, b = pairs[p]
        first = 2 if dark[a] == dark[b] else 1
        for k in range(4):
            for turn in range(first, 4, 2):
                other = (k + turn) % 4
                apart = np.hypot(
                    corners[a, k, 0] - corners[b, other, 0], corners[a, k, 1] - corners[b, other, 1]
                )
                if apart < min(limit[a], limit[b]):
                    here, there = 4 * a + k, 4 * b + other
                    if apart < gap[here, turn - 1]:
                        gap[here, turn - 1], partner[here, turn - 1] = apart, there
                    if apart < gap[there, 3 - turn]:
                        gap[there, 3 - turn], partner[there, 3 - turn] = apart, here
    return _numbered(partner)


@kernel_part
def _numbered(partner: Wholes) -> tuple[Wholes, int]:
    """Number (n, 4) of what mutual partners join, and how many numbers there are."""
    count = len(partner)
    parent = np.arange(count)
    for here in range(count):
        for turn in range(3):
            there = partner[here, turn]
            if there >= 0 and partner[there, 2 - turn] == here:
                parent[_root(parent, here)] = _root(parent, there)
    number = np.full(count, -1, np.intp)
    label = np.empty((count // 4, 4), np.intp)
    nodes = 0
    for here in range(count):
        root = _root(parent, here)
        if number[root] < 0:
            number[root] = nodes
            nodes += 1
        label[here // 4, here % 4] = number[root]
    return label, nodes


@kernel
def _locate(  # noqa: PLR0913, PLR0917 - a kernel fills buffers
    corners: Floats,
    dark: Flags,
    label: Wholes,
    position: Floats,
    merged: Flags,
    even: Flags,
    sound: Flags,
) -> None:
    """Nodes' places: the mean over the pairs of opposite corners, in which shrinkage cancels."""
    count = len(position)
    member = np.full((count, 4), -1, np.int64)
    sound[:] = True
    for a in range(len(label)):
        for k in range(4):
            node = label[a, k]
            parity = dark[a] == (k % 2 == 0)
            # One checker to each quarter, colours alternating.
            for other in range(4):
                if member[node, other] >= 0 and even[node] != parity:
                    sound[node] = False
            if member[node, k] >= 0:
                sound[node] = False
            member[node, k] = a
            even[node] = parity
    for node in range(count):
        pairs = 0
        for k in range(2):
            pairs += member[node, k] >= 0 and member[node, k + 2] >= 0
        merged[node] = pairs > 0
        share = 0
        for k in range(4):
            a = member[node, k]
            if a >= 0 and (pairs == 0 or member[node, (k + 2) % 4] >= 0):
                position[node] += corners[a, k]
                share += 1
        position[node] /= share


@kernel
def _point(label: Wholes, towards: Wholes, merged: Flags, sound: Flags, neighbour: Wholes) -> None:
    """Pointers along the edges of the checkers; none where two checkers give different ones."""
    disputed = np.zeros(neighbour.shape, np.bool_)
    for a in range(len(label)):
        for k in range(4):
            one, other = label[a, k], label[a, (k + 1) % 4]
            if sound[one] and sound[other] and one != other:
                step = towards[k]
                _tell(one, other, step, merged, neighbour, disputed)
                _tell(other, one, (step + 2) % 4, merged, neighbour, disputed)
    count = len(neighbour)
    for index in range(4 * count):
        node, step = index // 4, index % 4
        if disputed[node, step]:
            neighbour[node, step] = -1
    for index in range(4 * count):
        node, step = index // 4, index % 4
        other = neighbour[node, step]
        if other >= 0 and neighbour[other, (step + 2) % 4] != node:
            neighbour[node, step] = -1


@kernel_part
def _tell(  # noqa: PLR0913, PLR0917 - a kernel fills buffers
    here: int, there: int, step: int, merged: Flags, neighbour: Wholes, disputed: Flags
) -> None:
    """One checker's pointer; an inner corner at its end is believed before an outer one."""
    known = neighbour[here, step]
    if known < 0 or (merged[there] and not merged[known]):
        neighbour[here, step] = there
    elif known != there and merged[there] == merged[known]:
        disputed[here, step] = True


@kernel
def _largest_set(merged: Flags, neighbour: Wholes) -> int:
    count = len(merged)
    parent = np.arange(count)
    for node in range(count):
        for step in range(4):
            other = neighbour[node, step]
            if other >= 0 and merged[node] and merged[other]:
                parent[_root(parent, node)] = _root(parent, other)
    size = np.zeros(count, np.int64)
    for node in range(count):
        if merged[node]:
            size[_root(parent, node)] += 1
    return size.max() if count else 0
