"""Draws docs/images/mirror_views.png: what the two mirrors of a sensor do to its views.

Run it in the environment of the repository: `setup/run python3 docs/drawings/mirror_views.py`
The geometry is that of the packaged `sample_rig` with a plate and gel that refract.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import PathPatch, Polygon, Rectangle
from matplotlib.path import Path as MplPath
from matplotlib.textpath import TextPath
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import RefractingLayer

Array: TypeAlias = NDArray[np.float64]

OUTPUT = Path(__file__).parent.parent / "images" / "mirror_views.png"
PLATE, PLATE_INDEX, GEL_INDEX = 3e-3, 1.49, 1.41
COLOURS = {"left": "#0072B2", "right": "#D55E00"}
GEL, GLASS, MIRROR, INK = "#F6D9B8", "#BFD9E6", "#8A8F98", "#222222"
# The corner whose light is followed.
CORNER = (3, 4)


@dataclass(frozen=True)
class LightPath:
    """Points (3,) on the light's way to one corner, gel frame, mm."""

    virtual: Array
    mirror: Array
    plate: Array
    gel: Array
    corner: Array


class Rig:
    """A mirror rig in the gel frame, mm."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.sensor = sensor
        self.views = build_views(sensor)
        T = sensor.optics.T_camera_gel
        self.mirrors = {name: view.mirror for name, view in sensor.views.items() if view.mirror}
        if T is None or len(self.mirrors) < 2:
            msg = f"{sensor.name}: found {sensor.optics.type}, expected a rig with two mirrors"
            raise ValueError(msg)
        self.R_camera_gel = T[:3, :3]
        self.camera = -T[:3, :3].T @ T[:3, 3] * 1e3

    def path(self, name: str, point: Array) -> LightPath:
        """Light's way from the virtual camera of a view to a point, m."""
        view = self.views[name]
        q = view.project(point)
        bends = [
            replace(view, layers=view.layers[: n + 1]).rays(q)[0] for n in range(len(view.layers))
        ]
        mirror = self.mirrors[name]
        normal = self.R_camera_gel.T @ mirror.normal
        distance = mirror.distance + normal @ (self.camera * 1e-3)
        along = (distance - normal @ view.centre) / (normal @ (bends[0] - view.centre))
        hit = view.centre + along * (bends[0] - view.centre)
        return LightPath(*(1e3 * item for item in (view.centre, hit, *bends, point)))

    def mirror_piece(self, name: str) -> Array:
        """The part of a mirror that shows the pattern, and a margin, (N, 3) mm."""
        corners = self.sensor.pattern.corners()
        rim = np.concatenate([corners[0], corners[-1], corners[:, 0], corners[:, -1]])
        hits = np.array([self.path(name, point).mirror for point in rim])
        middle = hits.mean(axis=0)
        return np.asarray(middle + 1.25 * (hits - middle))


def main(output: Path = OUTPUT) -> None:
    """Draw and write the picture."""
    sensor = load_sensor("sample_rig")
    thickness = sensor.elastomer.size[2] - sensor.elastomer.shading_layer.thickness
    layers = (
        RefractingLayer(-thickness - PLATE, PLATE_INDEX),
        RefractingLayer(-thickness, GEL_INDEX),
    )
    rig = Rig(replace(sensor, optics=replace(sensor.optics, layers=layers)))
    with mpl.rc_context({"font.size": 9, "axes.linewidth": 0.6}):
        figure = Figure(figsize=(11.0, 5.3), layout=ConstrainedLayoutEngine(h_pad=0.07))
        panels = figure.subplot_mosaic(
            [["front", "side", "frame", "frame"], ["front", "side", "left", "right"]],
            width_ratios=[3.0, 2.75, 1.15, 1.15],
        )
        _draw_section(panels["front"], rig, 0)
        _draw_section(panels["side"], rig, 1)
        _label_front(panels["front"], rig)
        _label_side(panels["side"], rig)
        _draw_frame(panels["frame"], rig)
        for name in ("left", "right"):
            _draw_view(panels[name], rig, rig.views[name])
        output.parent.mkdir(exist_ok=True)
        figure.savefig(output, dpi=200)


def _draw_section(axes: Axes, rig: Rig, across: int) -> None:
    """The rig along one horizontal axis of the gel frame (0: x, 1: y) and z."""
    pick = [across, 2]
    _draw_solids(axes, rig, across)
    for name, colour in COLOURS.items():
        piece = rig.mirror_piece(name)[:, pick]
        hull = ConvexHull(piece, qhull_options="QJ").vertices
        axes.add_patch(Polygon(piece[hull], fc=MIRROR, ec=INK, lw=0.6, alpha=0.75, zorder=3))
        path = rig.path(name, rig.sensor.pattern.corners()[CORNER])
        real = np.array([rig.camera, path.mirror, path.plate, path.gel, path.corner])[:, pick]
        straight = np.array([path.virtual, path.mirror])[:, pick]
        axes.plot(*straight.T, "--", color=colour, lw=1.1, zorder=4)
        axes.plot(*real.T, "-", color=colour, lw=1.4, zorder=5)
        axes.plot(*path.virtual[pick], "o", mfc="white", mec=colour, mew=1.5, ms=8, zorder=6)
    axes.plot(*path.corner[pick], "o", color=INK, ms=4, zorder=7)
    axes.plot(*rig.camera[pick], "s", color=INK, ms=8, zorder=7)
    axes.set_aspect("equal")
    axes.set_xlim(*((-13.0, 13.0), (-12.0, 12.0))[across])
    axes.set_ylim(-37.0, 2.5)
    axes.set_xlabel(f"{'xy'[across]} of the gel frame / mm")
    axes.set_ylabel("z of the gel frame / mm")
    axes.spines[["top", "right"]].set_visible(False)


def _label_front(axes: Axes, rig: Rig) -> None:
    axes.set_title("a   Seen along y", loc="left", fontweight="bold")
    low, base = (layer.z * 1e3 for layer in rig.sensor.optics.layers)
    axes.text(10.6, base / 2 - 1.3, f"gel, n = {GEL_INDEX}", ha="right", va="center")
    axes.text(10.6, (low + base) / 2, f"plate, n = {PLATE_INDEX}", ha="right", va="center")
    axes.text(10.6, low - 1.5, "air", ha="right", va="center")
    x, _, z = rig.camera
    axes.text(x + 0.9, z, "camera", va="center")
    axes.text(6.7, rig.mirror_piece("right")[:, 2].mean(), "right\nmirror", va="center")
    axes.text(-6.7, rig.mirror_piece("left")[:, 2].mean(), "left\nmirror", va="center", ha="right")
    for name, colour in COLOURS.items():
        x, _, z = rig.path(name, rig.sensor.pattern.corners()[CORNER]).virtual
        label = f"virtual camera\nof the {name} view"
        axes.text(x, z - 0.9, label, ha="center", va="top", color=colour)
    x, _, z = rig.sensor.pattern.corners()[CORNER] * 1e3
    axes.text(x - 0.3, z + 1.0, f"corner {CORNER}", ha="right", va="bottom")


def _label_side(axes: Axes, rig: Rig) -> None:
    axes.set_title("b   Seen along x", loc="left", fontweight="bold")
    path = rig.path("left", rig.sensor.pattern.corners()[CORNER])
    _, y, z = rig.camera
    axes.text(y - 0.9, z, "camera", va="center", ha="right")
    axes.text(5.6, rig.mirror_piece("left")[:, 2].mean() + 0.8, "mirrors", va="center")
    axes.text(path.virtual[1] - 0.9, path.virtual[2], "virtual cameras", va="center", ha="right")
    _, y, z = (path.mirror + path.plate) / 2
    axes.text(y + 0.7, z, "light", va="center")
    _, y, z = (path.mirror + path.virtual) / 2
    axes.text(y + 0.7, z, "its straight\ncontinuation", va="center")


def _draw_solids(axes: Axes, rig: Rig, across: int) -> None:
    half = rig.sensor.elastomer.size[across] / 2
    s = np.linspace(-half, half, 201)
    xy = np.zeros((201, 2))
    xy[:, across] = s
    top = rig.sensor.pattern.surface.height(xy) * 1e3
    low, base = (layer.z * 1e3 for layer in rig.sensor.optics.layers)
    s = s * 1e3
    axes.fill_between(s, base, top, color=GEL, lw=0, zorder=1)
    axes.fill_between(s, low, base, color=GLASS, lw=0, zorder=1)
    axes.plot(s, top, color=INK, lw=1.4, zorder=2)


def _draw_frame(axes: Axes, rig: Rig) -> None:
    size = rig.sensor.image
    axes.set_xlim(-0.5, size.width - 0.5)
    axes.set_ylim(size.height - 0.5, -0.5)
    for view in rig.views.values():
        place = view.placement
        corner = (place.x - 0.5, place.y - 0.5)
        axes.add_patch(
            Rectangle(corner, place.width, place.height, fc="none", ec=COLOURS[view.name], lw=2)
        )
        _draw_pattern(axes, rig, view, frame=True)
    axes.set_title("c   Frame: mirror-inverted", loc="left", fontweight="bold")
    _tidy(axes)
    axes.spines[:].set_visible(False)


def _draw_view(axes: Axes, rig: Rig, view: ViewGeometry) -> None:
    axes.set_xlim(-0.5, view.placement.width - 0.5)
    axes.set_ylim(view.placement.height - 0.5, -0.5)
    _draw_pattern(axes, rig, view, frame=False)
    if view.name == "left":
        axes.set_title("d   Views: cut out, flipped", loc="left", fontweight="bold")
    axes.set_xlabel(f"{view.name} view", color=COLOURS[view.name])
    _tidy(axes)
    for spine in axes.spines.values():
        spine.set(color=COLOURS[view.name], linewidth=2)


def _draw_pattern(axes: Axes, rig: Rig, view: ViewGeometry, *, frame: bool) -> None:
    """Corners, the gel's axes, and a letter that reads right from the camera's side."""

    def seen(xy: Array) -> Array:
        height = rig.sensor.pattern.surface.height(xy)
        q = view.project(np.concatenate([xy, height[:, None]], axis=1))
        return view.placement.to_frame(q) if frame else q

    colour = COLOURS[view.name]
    corners = rig.sensor.pattern.corners()[..., :2]
    axes.plot(*seen(corners.reshape(-1, 2)).T, ".", color=colour, ms=1.2, alpha=0.7)
    axes.plot(*seen(corners[CORNER][None]).T, "o", color=INK, ms=4, zorder=5)
    letter = TextPath((0, 0), "R", size=1)
    # Turned by 180 degrees, as this rig's cameras are.
    flat = (letter.vertices - letter.get_extents().get_points().mean(axis=0)) * [-8e-3, 8e-3]
    path = MplPath(seen(flat), letter.codes)
    axes.add_patch(PathPatch(path, fc=colour, ec="none", alpha=0.45, zorder=1))
    _draw_axes(axes, seen, corners[0, 0])


def _draw_axes(axes: Axes, seen: Callable[[Array], Array], start: Array) -> None:
    """The gel's axes at its corner (0, 0)."""
    for axis, label in enumerate("xy"):
        along = np.eye(2)[axis]
        aside = np.eye(2)[1 - axis] * 1.3e-3
        ends = seen(start - aside / 2 + along * [[0.0], [5e-3], [6.2e-3]])
        axes.annotate(
            "", ends[1], ends[0], arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2}
        )
        axes.text(ends[2, 0], ends[2, 1], label, ha="center", va="center")


def _tidy(axes: Axes) -> None:
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
