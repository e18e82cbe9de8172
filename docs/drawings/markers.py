"""Draws docs/images/markers.png and gripper_markers.png: a simulated grasp as RViz shows it.

Run it in the environment of the repository: `setup/run python3 docs/drawings/markers.py`
Points, colours, words and the view are those of RViz with rviz/cmp_tactile.rviz and gripper.rviz,
and so is the place of each word (rviz_view.py).  Shading and font are not.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rviz_view import EM_PER_HEIGHT, View, picture_px, placed_words, read_settings
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker

from cmp_tactile_bringup.graphs.description import Component, Graph
from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline
from cmp_tactile_processing.pipeline import PipelineResult
from cmp_tactile_processing.ros.rviz import DrawnMarker
from cmp_tactile_processing.ros.rviz_markers import MarkerParameters, force_markers, surface_markers
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.scenes.file import load_scene

IMAGES = Path(__file__).parents[1] / "images"
PICTURES = {
    "cmp_tactile.rviz": IMAGES / "markers.png",
    "gripper.rviz": IMAGES / "gripper_markers.png",
}
LOOK = ("up", "text_size")
SCENE, BEFORE_PHASE = "grasp", "knock"
FINER, DPI = 2, 100
# From a surface that is seen edge-on to one that faces the viewer.
DARKEST = 0.55
# Lines are cut into pieces, of which each is before or behind each triangle as a whole.
PIECE_M = 1e-4

Float = NDArray[np.float64]


@cache
def grasp() -> PipelineResult:
    """The last frame before a phase of the scene."""
    scene = load_scene(SCENE)
    phases = takewhile(lambda phase: phase.name != BEFORE_PHASE, scene.motion)
    count = sum(phase.frames for phase in phases)
    images = [frame.image for frame in islice(BagReader(recording_of(SCENE)).frames(), count)]
    pipeline = Pipeline(scene.sensor)
    pipeline.set_reference(images[:1])
    return [pipeline.process(image) for image in images][-1]


def mounts(graph: Graph) -> list[tuple[Rotation, Float]]:
    """How the gel of each sensor of a graph is turned, and where it is."""
    splitters = [item for item in graph.components if item.name == "view_splitter"]
    return [
        (
            Rotation.from_euler("xyz", item.parameters["mount_orientation"]),
            np.array(item.parameters["mount_position"], np.float64),
        )
        for item in splitters
    ]


def look_of(visualizer: Component) -> MarkerParameters:
    """How a graph has its markers drawn."""
    given: dict[str, Any] = {key: visualizer.parameters.get(key) for key in LOOK}
    up, size = given["up"], given["text_size"]
    default = MarkerParameters()
    return replace(default, up=tuple(up or default.up), text_size=size or default.text_size)


def drawn_markers(name: str, result: PipelineResult) -> list[list[DrawnMarker]]:
    """What the nodes of each sensor draw of a frame, in the frame that RViz shows."""
    graph = load_graph("gripper" if name == "gripper.rviz" else "replay")
    visualizers = [item for item in graph.components if item.name == "surface_visualizer"]
    drawn = []
    for item, (turn, origin) in zip(visualizers, mounts(graph), strict=True):
        look = look_of(item)
        markers = [*surface_markers(result.surface, look), *force_markers(result.force, look)]
        drawn.append([moved(marker, turn, origin) for marker in markers])
    return drawn


def moved(marker: DrawnMarker, turn: Rotation, origin: Float) -> DrawnMarker:
    """A marker in the frame that its own is mounted on."""
    points = turn.apply(marker.points) + origin if len(marker.points) else marker.points
    x, y, z = (turn.apply(marker.position) + origin).tolist()
    return replace(marker, points=points, position=(x, y, z))


def draw(axes: Axes, markers: list[DrawnMarker], view: View) -> None:
    """Add meshes and lines, the farthest first."""
    polygons: list[Float] = []
    colours: list[Float] = []
    depths: list[Float] = []
    for marker in markers:
        if not marker.shows or marker.kind == Marker.TEXT_VIEW_FACING:
            continue
        own = marker.colours if len(marker.colours) else np.array([marker.colour])
        own = np.broadcast_to(own, (len(marker.points), 4)).astype(np.float64)
        is_mesh = marker.kind == Marker.TRIANGLE_LIST
        parts = triangles(marker, own, view) if is_mesh else lines(marker, own, view)
        for known, new in zip((polygons, colours, depths), parts, strict=True):
            known.append(new)
    order = np.argsort(np.concatenate(depths))[::-1]
    corners = [polygon for group in polygons for polygon in group]
    axes.add_collection(
        PolyCollection(
            [corners[k] for k in order],
            facecolors=np.concatenate(colours)[order],
            linewidths=0,
            antialiased=False,
        )
    )


def triangles(marker: DrawnMarker, colours: Float, view: View) -> tuple[Float, Float, Float]:
    """Triangles (n, 3, 2) px, their colours and depths; darker where seen from the side."""
    faces = marker.points.reshape(-1, 3, 3)
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    facing = np.abs(normal @ view.axes[2])
    mean = colours.reshape(-1, 3, 4).mean(axis=1)
    mean[:, :3] *= DARKEST + (1 - DARKEST) * facing[:, None]
    flat, _, depth = view.project(faces)
    return flat, mean, depth.mean(axis=1)


def lines(marker: DrawnMarker, colours: Float, view: View) -> tuple[Float, Float, Float]:
    """Lines as bands (n, 4, 2) px that face the viewer, their colours and depths."""
    ends = marker.points.reshape(-1, 2, 3)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    counts = np.maximum(np.ceil(length / PIECE_M).astype(int), 1)
    line = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = np.stack([number, number + 1], axis=1) / counts[line, None]
    pieces = ends[line, :1] + share[..., None] * (ends[line, 1:] - ends[line, :1])
    flat, scale, depth = view.project(pieces)
    along = flat[:, 1] - flat[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = marker.scale[0] / 2 * scale.mean(axis=1)[:, None]
    aside = half * np.stack([-along[:, 1], along[:, 0]], axis=1)
    # Pieces of one line overlap: no gap is seen between them.
    begin, end = flat[:, 0] - 0.5 * along, flat[:, 1] + 0.5 * along
    bands = np.stack([begin + aside, end + aside, end - aside, begin - aside], axis=1)
    return bands, colours[::2][line], depth.mean(axis=1)


def write(axes: Axes, marker: DrawnMarker, view: View) -> None:
    """Add a text that faces the viewer."""
    place, scale, _ = view.project(np.array(marker.position))
    for word, left, top in placed_words(marker):
        axes.text(
            place[0] + left * scale,
            place[1] + top * scale,
            word,
            va="top",
            color=marker.colour,
            fontsize=marker.scale[2] * scale * EM_PER_HEIGHT * 72 / DPI,
        )


def draw_picture(name: str, fingers: Sequence[list[DrawnMarker]], output: Path) -> None:
    """Draw what RViz shows between its docks as it opens with these settings."""
    settings = read_settings(name)
    manager = settings["Visualization Manager"]
    grey = manager["Global Options"]["Background Color"]
    size = picture_px(settings)
    width, height = (FINER * side for side in size)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.set_facecolor([int(part) / 255 for part in grey.split(";")])
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(-width / 2, width / 2), ylim=(-height / 2, height / 2))
    view = View.of(manager["Views"]["Current"], height)
    markers = [marker for finger in fingers for marker in finger]
    draw(axes, markers, view)
    for marker in markers:
        if marker.kind == Marker.TEXT_VIEW_FACING and marker.shows:
            write(axes, marker, view)
    figure.savefig(output, dpi=DPI, facecolor=figure.get_facecolor())
    fine = cv2.imread(str(output))
    cv2.imwrite(str(output), cv2.resize(fine, size, interpolation=cv2.INTER_AREA))


def main(folder: Path = IMAGES) -> None:
    """Draw both pictures."""
    for name, picture in PICTURES.items():
        draw_picture(name, drawn_markers(name, grasp()), folder / picture.name)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
