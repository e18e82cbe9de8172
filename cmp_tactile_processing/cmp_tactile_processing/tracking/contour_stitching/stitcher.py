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

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.contour_stitching.checker_corners import (
    Checkers,
    best_checkers,
    largest_set,
    merge_corners,
)
from cmp_tactile_processing.tracking.contour_stitching.checker_outlines import (
    CheckerOutlines,
    least_deviation,
)
from cmp_tactile_processing.tracking.contour_stitching.checker_quadrangles import (
    NominalSteps,
    fit_quadrangles,
)
from cmp_tactile_processing.tracking.detector import CornerGraph
from cmp_tactile_processing.tracking.nominal_grid import NominalGrid

__all__ = ["ContourStitching"]

# Outlines are taken at this side of a checker at least; smaller checkers are magnified for it.
MAGNIFY_BELOW_PX = 10.0
# The first erosion in sides, and at most in px: what parts checkers grows with the lens's blur
# more than with their size.
EROSION, DEEPEST_EROSION = 0.12, 3


@dataclass(frozen=True)
class Pretreatment:
    """One way to make an image binary and to part its checkers.

    smoothing: width of a Gaussian in sides, at least the prepared image's own; offset: see
    `CheckerOutlines`; deeper: px of erosion beyond the least, each giving outlines of its own.
    """

    smoothing: float
    offset: float
    deeper: tuple[int, ...]


# A further pretreatment must add this share of the corners to what hangs together to go on.
LITTLE_GAIN = 0.005
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
