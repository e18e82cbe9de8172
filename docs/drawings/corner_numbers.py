"""Draws docs/images/corner_numbers.png: how the corners of a half-hidden view get their numbers.

`setup/run python3 docs/drawings/corner_numbers.py`
"""

from __future__ import annotations

import io
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.image.prepared import Prefilter, PreparedImage
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import (
    Component,
    CornerGraph,
    NominalAxes,
    NominalGrid,
)
from cmp_tactile_processing.tracking.numbering.component_placement import (
    ConnectedCorners,
    _without_stragglers,
)
from cmp_tactile_processing.tracking.numbering.pattern_border import border_sides
from cmp_tactile_processing.tracking.numbering.whole_view import GridNumbering
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.scenes.file import load_scene

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

PICTURE = Path(__file__).parents[1] / "images" / "corner_numbers.png"
SCENE, VIEW, FRAME = "grasp", "left", 30
# What hides a part of the pattern, in checkers: radii of a washer, and corners (i, j) of a bar.
WASHER, BAR, GREY_LEVEL = (6.0, 2.6), ((-3, -2), (-3, 22), (2.5, 22), (2.5, -2)), 140
MARGIN_PX = 22
BLUE, ORANGE, MAGENTA = "#0072b2", "#d55e00", "#cc3399"
COLOURS = 48

Float = NDArray[np.float64]


def hidden_view(sensor: SensorDescription, nominal: NominalGrid) -> NDArray[np.uint8]:
    """A view of a frame of the scene, with a washer and a bar over the pattern."""
    frame = next(islice(BagReader(recording_of(SCENE)).frames(), FRAME, None)).image
    view = np.array(split_frame(frame, build_views(sensor)[VIEW].placement))
    rows, cols = nominal.corners.shape[:2]
    x, y = np.rint(nominal.corners[rows // 2, cols // 2]).astype(int).tolist()
    outer, inner = (nominal.side_px * radius for radius in WASHER)
    origin, along_i, along_j = nominal.corners[0, 0], nominal.row_step[0, 0], nominal.col_step[0, 0]
    bar = np.array([origin + i * along_i + j * along_j for i, j in BAR])
    cv2.fillConvexPoly(view, np.rint(bar).astype(np.int32), GREY_LEVEL, cv2.LINE_AA)
    breadth = round(outer - inner)
    cv2.circle(view, (x, y), round((outer + inner) / 2), GREY_LEVEL, breadth, cv2.LINE_AA)
    return view


def draw_pointers(axes: Any, graph: CornerGraph) -> None:
    """The detector's corners, and lines to their neighbours."""
    ends = [
        (graph.position[node], graph.position[other])
        for node, pointers in enumerate(graph.neighbour)
        for other in pointers
        if other > node
    ]
    axes.add_collection(LineCollection(ends, colors=MAGENTA, linewidths=0.9))
    axes.plot(*graph.position.T, ".", ms=2.5, color=MAGENTA)


def draw_component(axes: Any, component: Component, colour: str, step: int) -> None:
    """The corners of a component with their numbers from its own origin."""
    axes.plot(*component.position.T, ".", ms=3, color=colour)
    first = component.number.min(axis=0)
    label_some(axes, component.position, component.number - first, colour, step)


def label_some(
    axes: Any, position: Float, number: NDArray[np.intp], colour: str, step: int
) -> None:
    """Numbers (n, 2) beside every so many corners (n, 2)."""
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.4, "alpha": 0.85}
    for place, (i, j) in zip(position, number, strict=True):
        if i % step == 0 and j % step == 0:
            axes.annotate(f"{i},{j}", place, color=colour, fontsize=8, ha="center", bbox=box)


def draw_borders(axes: Any, component: Component, image: PreparedImage) -> None:
    """The sides at which a component was seen to end."""
    lattice, even = component.lattice()
    lines = lattice[0], lattice[-1], lattice[:, 0], lattice[:, -1]
    for line, side in zip(
        lines, border_sides(image, lattice, even, lattice.shape[:2]), strict=True
    ):
        if side.ends:
            axes.plot(*line.T, color=BLUE, lw=2.5, alpha=0.8)


def main() -> None:
    """Three panels: pointers, components, numbers."""
    sensor = load_scene(SCENE).sensor
    nominal = NominalGrid.of_view(sensor.pattern, build_views(sensor)[VIEW])
    view = hidden_view(sensor, nominal)
    window = nominal.window(view.shape[1], view.shape[0])
    grey, nominal = np.ascontiguousarray(window.cut(view)), nominal.seen_through(window)
    image = Prefilter(grey.shape, nominal.side_px).prepare(grey)
    graph = SaddleLattice(nominal, grey.shape).corner_graph(image)
    components, _ = ConnectedCorners(NominalAxes(nominal)).components(graph, image)
    components[0] = _without_stragglers(components[0], nominal.corners.shape[:2])
    dark_first = sensor.pattern.corner_checker == "dark"
    numbering = GridNumbering(nominal, dark_first).number(graph, image)

    low, high = (edge(nominal.corners, axis=(0, 1)) for edge in (np.min, np.max))
    sides = np.stack([low - MARGIN_PX, high + MARGIN_PX], axis=1)

    figure, panels = plt.subplots(1, 3, figsize=(12, 4.3), layout="constrained")
    titles = (
        "1. Corners and gridline pointers,\nwith false ones at the bar",
        "2. Components without stray lines, each from its\nown origin; blue: here the pattern ends",
        "3. Numbers: the outer component by its borders,\nthe inner one as it continues the outer",
    )
    for axes, title in zip(panels, titles, strict=True):
        axes.imshow(image.grey, cmap="gray", vmin=0, vmax=330)
        axes.set_title(title, loc="left", fontsize=10)
        axes.axis("off")
        axes.set_xlim(*sides[0])
        axes.set_ylim(*sides[1][::-1])
    draw_pointers(panels[0], graph)
    draw_borders(panels[1], components[0], image)
    for component, colour, step in zip(components, (BLUE, ORANGE), (4, 2), strict=False):
        draw_component(panels[1], component, colour, step)
    known = np.isfinite(numbering.corners[..., 0])
    position, number = numbering.corners[known], np.argwhere(known)
    panels[2].plot(*position.T, ".", ms=3, color=BLUE)
    label_some(panels[2], position, number, BLUE, 3)
    kept = io.BytesIO()
    figure.savefig(kept, dpi=100)
    Image.open(kept).convert("RGB").quantize(COLOURS).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
