"""Draws docs/images/markers.png: what the markers of a simulated grasp look like in RViz.

Run it in the environment of the repository: `setup/run python3 docs/drawings/markers.py`
Points, colours, words and the view are those of RViz with rviz/cmp_tactile.rviz, and so is the
place of each word: text is set by the rules of RViz's MovableText and TextViewFacingMarker.
Shading and font are not.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline
from cmp_tactile_processing.ros.rviz.drawing import DrawnMarker
from cmp_tactile_processing.ros.rviz.markers import MarkerParameters, force_markers, surface_markers
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.scenes.file import load_scene

ROOT = Path(__file__).parents[2]
OUTPUT = ROOT / "docs" / "images" / "markers.png"
SETTINGS = ROOT / "cmp_tactile_bringup" / "rviz" / "cmp_tactile.rviz"
SCENE, BEFORE_PHASE = "grasp", "knock"
# RViz's camera sees 45 degrees of height.
FIELD_OF_VIEW = np.radians(45)
SIZE_PX, FINER, DPI = (1000, 760), 2, 100
# The picture is the part of the view where something is drawn: its width, and its middle beside
# that of the view, in heights of the view.
WIDTH, MIDDLE = 0.72, (0.025, -0.05)
VIEW_PX = SIZE_PX[0] / WIDTH
# From a surface that is seen edge-on to one that faces the viewer.
DARKEST = 0.55
# Lines are cut into pieces, of which each is before or behind each triangle as a whole.
PIECE_M = 1e-4
# A letter of RViz is as high as its font's lines.
EM_PER_HEIGHT = 1 / 1.15
# RViz's text: a space is half of scale.x wide, and where that is 0, half of its letter A in a text
# of 1 m; lines are a letter and 5 mm apart, whatever the size.
WIDTH_OF_A, LINE_GAP_M = 0.67, 5e-3

Float = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """RViz's orbit around the origin of the gel frame; axes (3, 3): right, up, back."""

    camera: Float
    axes: Float

    @classmethod
    def of_settings(cls, path: Path) -> View:
        """The view that RViz opens with."""
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        view: dict[str, Any] = settings["Visualization Manager"]["Views"]["Current"]
        yaw, pitch = view["Yaw"], view["Pitch"]
        back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        return cls(view["Distance"] * back, np.stack([right, np.cross(back, right), back]))

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Points (..., 3) m: px from the middle (..., 2), y up; px per m there; depth, m."""
        across = (points - self.camera) @ self.axes.T
        depth = -across[..., 2]
        scale = FINER * VIEW_PX / 2 / np.tan(FIELD_OF_VIEW / 2) / depth
        return across[..., :2] * scale[..., None], scale, depth


def drawn_markers() -> list[DrawnMarker]:
    """What the node draws of the last frame before a phase of the scene."""
    scene = load_scene(SCENE)
    phases = takewhile(lambda phase: phase.name != BEFORE_PHASE, scene.motion)
    count = sum(phase.frames for phase in phases)
    images = [frame.image for frame in islice(BagReader(recording_of(SCENE)).frames(), count)]
    pipeline = Pipeline(scene.sensor)
    pipeline.set_reference(images[:1])
    result = [pipeline.process(image) for image in images][-1]
    look = MarkerParameters()
    return [*surface_markers(result.surface, look), *force_markers(result.force, look)]


def draw(axes: Axes, markers: list[DrawnMarker], view: View) -> None:
    """Add meshes and lines, the farthest first."""
    polygons: list[Float] = []
    colours: list[Float] = []
    depths: list[Float] = []
    for marker in markers:
        if marker.action == Marker.DELETE or marker.kind == Marker.TEXT_VIEW_FACING:
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


def placed_words(marker: DrawnMarker) -> list[tuple[str, float, float]]:
    """The words of a text, with left and top of each beside the marker's position, m."""
    size, space = marker.scale[2], marker.scale[0] / 2 or WIDTH_OF_A
    rows = [line.split(" ") for line in marker.text.split("\n")]
    widths = [[_width(word, size) for word in row] for row in rows]
    widest = max(sum(row) + space * (len(row) - 1) for row in widths)
    height = len(rows) * size + (len(rows) - 1) * LINE_GAP_M
    return [
        (
            word,
            -widest / 2 + sum(row[:before]) + before * space,
            height / 2 - k * (size + LINE_GAP_M),
        )
        for k, (words, row) in enumerate(zip(rows, widths, strict=True))
        for before, word in enumerate(words)
    ]


def _width(word: str, size: float) -> float:
    if not word:
        return 0.0
    return float(TextPath((0, 0), word, size=EM_PER_HEIGHT).get_extents().width) * size


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


def main(output: Path) -> None:
    """Draw the picture."""
    settings = yaml.safe_load(SETTINGS.read_text(encoding="utf-8"))
    grey = settings["Visualization Manager"]["Global Options"]["Background Color"]
    width, height = (FINER * size for size in SIZE_PX)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.set_facecolor([int(part) / 255 for part in grey.split(";")])
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    middle = np.array(MIDDLE) * FINER * VIEW_PX
    axes.set(
        xlim=(middle[0] - width / 2, middle[0] + width / 2),
        ylim=(middle[1] - height / 2, middle[1] + height / 2),
    )
    view, markers = View.of_settings(SETTINGS), drawn_markers()
    draw(axes, markers, view)
    for marker in markers:
        if marker.kind == Marker.TEXT_VIEW_FACING and marker.action == Marker.ADD:
            write(axes, marker, view)
    figure.savefig(output, dpi=DPI, facecolor=figure.get_facecolor())
    fine = cv2.imread(str(output))
    cv2.imwrite(str(output), cv2.resize(fine, SIZE_PX, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT)
