"""Sets of corners that gridlines connect, without those of which the colours are in doubt."""

from __future__ import annotations

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.corners.evidence import blur_evidence
from cmp_tactile_processing.tracking.detector import (
    Component,
    CornerGraph,
    NominalAxes,
)
from cmp_tactile_processing.tracking.numbering.component_placement import FEWEST_CORNERS
from cmp_tactile_processing.tracking.numbering.components import GridlinePointers

# Components of fewer corners are clutter as often as they are part of the pattern.
SMALLEST_JOINED = 2
# Checkers without sharp edges, and with less contrast than this, may be light where they should be
# dark: beyond the first zero of its transfer function, blur exchanges them.  A lens out of focus
# leaves 13 % of the first harmonic there, and a straight smear 22 %, with a sharpness below 0.6;
# where neither has exchanged the colours, blur of a third of a side leaves more contrast.
LEAST_SHARPNESS, LEAST_CONTRAST = 0.7, 0.3


class ConnectedCorners:
    """Finds them in the graphs of one view; keeps its buffers.

    axes: steps of the pattern at rest near a point of the prepared image.
    """

    def __init__(self, axes: NominalAxes) -> None:
        self.axes = axes
        self._pointers = GridlinePointers()

    def components(self, graph: CornerGraph, image: PreparedImage) -> tuple[list[Component], str]:
        """Sets of connected corners, the largest first, and why some are not to be believed."""
        components = self.all_components(graph)
        return without_blurred(components, image) if components else ([], "")

    def all_components(self, graph: CornerGraph) -> list[Component]:
        """Sets of connected corners, the largest first, however blurred they are."""
        steps = self.axes.near(graph.position)
        return self._pointers.components(graph, *steps, fewest=SMALLEST_JOINED)


def without_blurred(
    components: list[Component], image: PreparedImage
) -> tuple[list[Component], str]:
    """The components in which light and dark can be trusted, and what speaks against the largest.

    Components that are too small to be judged go with the largest.
    """
    kept: list[Component] = []
    reason = ""
    for index, component in enumerate(components):
        if len(component.position) < FEWEST_CORNERS:
            return kept if reason else kept + components[index:], reason
        sharpness, contrast = blur_evidence(image.grey, *component.lattice())
        if not (sharpness < LEAST_SHARPNESS and contrast < LEAST_CONTRAST):
            kept.append(component)
        elif index == 0:
            reason = (
                "out of focus or motion blur: checkers without sharp edges, contrast "
                f"{contrast:.0%}"
            )
    return kept, reason
