"""Draws docs/images/markers.png: the markers of a sliding press, about as RViz shows them.

Run it in the environment of the repository: `setup/run python3 docs/drawings/markers.py`
Shading, hidden lines and letters are not those of RViz; points, colours and words are.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, cast

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
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
HALF_WIDTH_M, ELEVATION, AZIMUTH = 9.2e-3, 38, -62
POINTS_PER_M = 13e3


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
    """Add all that is not deleted to the axes, meshes beneath lines beneath texts."""
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
        else:
            size = marker.scale[2] * POINTS_PER_M
            x, y, z = marker.position
            where: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 5}
            axes.text(x, y, z, marker.text, color=marker.colour, fontsize=size, **where)


def main(output: Path) -> None:
    """Draw the picture."""
    mpl.use("Agg")
    figure = Figure(figsize=SIZE_IN, facecolor=BACKGROUND)
    place = (-0.3, -0.4, 1.5, 1.6)
    axes = cast("Axes3D", figure.add_axes(place, projection="3d", computed_zorder=False))
    axes.set_axis_off()
    axes.set_facecolor(BACKGROUND)
    draw(axes, drawn_markers())
    limits = (-HALF_WIDTH_M, HALF_WIDTH_M)
    axes.set(xlim=limits, ylim=limits, zlim=limits)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(ELEVATION, AZIMUTH)
    figure.savefig(output, dpi=DPI)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT)
