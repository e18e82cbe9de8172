"""Draws docs/images/markers.png: the markers of a sliding press, about as RViz shows them.

Run it in the environment of the repository: `setup/run python3 docs/drawings/markers.py`
Shading, hidden lines and letters are not those of RViz; points, colours and words are, and where
each word stands: text is set by the rules of RViz's MovableText and TextViewFacingMarker.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import cast

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import (  # type: ignore[import-untyped]
    Line3DCollection,
    Poly3DCollection,
)
from mpl_toolkits.mplot3d.axes3d import Axes3D  # type: ignore[import-untyped]
from numpy.typing import NDArray
from visualization_msgs.msg import Marker  # noqa: TID251 - a drawing of messages

from cmp_tactile_processing import Pipeline
from cmp_tactile_processing.nodes.drawn_marker import DrawnMarker
from cmp_tactile_processing.nodes.marker_parameters import MarkerParameters
from cmp_tactile_processing.nodes.markers import force_markers, surface_markers
from cmp_tactile_processing.sensor_library import load_sensor

ROOT = Path(__file__).parents[2]
FRAMES = ROOT / "cmp_tactile_processing" / "test" / "data"
OUTPUT = ROOT / "docs" / "images" / "markers.png"
# RViz's background in rviz/cmp_tactile.rviz.
BACKGROUND = (48 / 255, 48 / 255, 48 / 255)
SIZE_IN, DPI = (10.0, 7.0), 80
HALF_WIDTH_M, ELEVATION, AZIMUTH = 10.5e-3, 38, -62
# In the middle of the picture; a letter of RViz is as high as its font's lines.
POINTS_PER_M = 30.6e3
EM_PER_HEIGHT = 1 / 1.15
# RViz's text: a space is half of scale.x wide, and where that is 0, half of its letter A in a text
# of 1 m; lines are a letter and 5 mm apart, whatever the size.
WIDTH_OF_A, LINE_GAP_M = 0.67, 5e-3


def drawn_markers() -> list[DrawnMarker]:
    """What the node draws of the last of the sample frames, a ball that was pressed and slid."""
    pipeline = Pipeline(load_sensor("sample_rig"))
    pipeline.set_reference([_frame("rest")])
    pipeline.process(_frame("press"))
    result = pipeline.process(_frame("slide"))
    look = MarkerParameters()
    return [*surface_markers(result.surface, look), *force_markers(result.force, look)]


def _frame(name: str) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(FRAMES / f"{name}.png"), cv2.IMREAD_GRAYSCALE), np.uint8)


def draw(axes: Axes3D, markers: list[DrawnMarker]) -> None:
    """Add meshes and lines that are not deleted to the axes, meshes beneath lines."""
    for marker in markers:
        if marker.action == Marker.DELETE:
            continue
        colours = marker.colours if len(marker.colours) else np.array([marker.colour])
        if marker.kind == Marker.TRIANGLE_LIST:
            faces = marker.points.reshape(-1, 3, 3)
            mean = colours.reshape(-1, 3, 4).mean(axis=1)
            axes.add_collection3d(Poly3DCollection(faces, facecolors=mean, zorder=1))
        elif marker.kind == Marker.LINE_LIST:
            sides = marker.points.reshape(-1, 2, 3)
            width = marker.scale[0] * POINTS_PER_M
            axes.add_collection3d(
                Line3DCollection(sides, colors=colours[::2], linewidths=width, zorder=3)
            )


def placed_words(marker: DrawnMarker) -> list[tuple[str, float, float]]:
    """The words of a text, with left and top of each beside the marker's position, m."""
    size, space = marker.scale[2], marker.scale[0] / 2 or WIDTH_OF_A
    lines = [line.split(" ") for line in marker.text.split("\n")]
    widths = [[_width(word, size) for word in line] for line in lines]
    widest = max(sum(row) + space * (len(row) - 1) for row in widths)
    height = len(lines) * size + (len(lines) - 1) * LINE_GAP_M
    return [
        (
            word,
            -widest / 2 + sum(row[:before]) + before * space,
            height / 2 - k * (size + LINE_GAP_M),
        )
        for k, (line, row) in enumerate(zip(lines, widths, strict=True))
        for before, word in enumerate(line)
    ]


def _width(word: str, size: float) -> float:
    if not word:
        return 0.0
    return float(TextPath((0, 0), word, size=EM_PER_HEIGHT).get_extents().width) * size


def write(axes: Axes3D, marker: DrawnMarker) -> None:
    """Add a text that faces the viewer; the axes must have their limits and view."""
    x, y, _ = proj3d.proj_transform(*marker.position, axes.get_proj())
    for word, left, top in placed_words(marker):
        axes.annotate(
            word,
            (x, y),
            xytext=(left * POINTS_PER_M, top * POINTS_PER_M),
            textcoords="offset points",
            va="top",
            color=marker.colour,
            fontsize=marker.scale[2] * EM_PER_HEIGHT * POINTS_PER_M,
            annotation_clip=False,
            zorder=5,
        )


def main(output: Path) -> None:
    """Draw the picture."""
    mpl.use("Agg")
    figure = Figure(figsize=SIZE_IN, facecolor=BACKGROUND)
    place = (-0.3, -0.4, 1.5, 1.6)
    axes = cast("Axes3D", figure.add_axes(place, projection="3d", computed_zorder=False))
    axes.set_axis_off()
    axes.set_facecolor(BACKGROUND)
    markers = drawn_markers()
    draw(axes, markers)
    limits = (-HALF_WIDTH_M, HALF_WIDTH_M)
    axes.set(xlim=limits, ylim=limits, zlim=limits)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(ELEVATION, AZIMUTH)
    for marker in markers:
        if marker.kind == Marker.TEXT_VIEW_FACING and marker.action == Marker.ADD:
            write(axes, marker)
    figure.savefig(output, dpi=DPI)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT)
