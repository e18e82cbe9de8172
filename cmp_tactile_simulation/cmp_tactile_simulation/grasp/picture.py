"""Pictures of a grasp: gripper and object, what both cameras see, and the forces over time.

MuJoCo's own renderer needs OpenGL, which many machines of a laboratory's network lack.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from cmp_tactile_processing.errors import OutputError
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.grasp.body import OBJECT_COLOUR, object_mesh
from cmp_tactile_simulation.grasp.play import GraspFrame
from cmp_tactile_simulation.grasp.scene import SIDES, GraspScene
from cmp_tactile_simulation.rendering.sight import rasterize_triangles

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

WIDTH_PX, HEIGHT_PX, SCENE_PX = 1280, 720, 720
CAMERA_PX = (280, 210)
# The first one plays in browsers; not every build of OpenCV writes it.
CODECS = ("vp09", "mp4v")
BACKGROUND, INK, FAINT = (250, 248, 246), (40, 40, 40), (200, 196, 192)
HOUSING: Colour = (110, 105, 100)
GELS: Mapping[str, Colour] = {"left": (200, 120, 40), "right": (60, 110, 220)}
# Behind the gel, m.
HOUSING_M = 0.03
# The eye relative to what it looks at, m, and the focal length in px.
EYE, FOCAL_PX = np.array([0.26, -0.16, 0.13]), 1500.0
LIGHT = np.array([0.5, -0.4, 0.8]) / np.linalg.norm([0.5, -0.4, 0.8])
# Nearer to the eye, the table is not drawn, m.
NEAREST_M = 0.05
# Bodies are drawn this many times finer, and averaged.
FINER = 2
# Of the force arrows and of the plot's least range.
M_PER_N, LEAST_N = 0.012, 1.0


@dataclass
class GraspPainter:
    """Draws one frame after the other; keeps the forces for the plot."""

    scene: GraspScene
    _seconds: list[float] = field(default_factory=list)
    _forces: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._object = np.asarray(object_mesh(self.scene).triangles, np.float64)
        self._parts = [
            (side, part, colour)
            for side, sensor in self.scene.described.items()
            for part, colour in zip(
                _fingertip(sensor.elastomer.size), (GELS[side], HOUSING), strict=True
            )
        ]

    def draw(self, frame: GraspFrame, measured: Mapping[str, Array]) -> Image:
        """The picture (720, 1280, 3) BGR.  measured (6,): wrenches by side, NaN where unknown."""
        now = frame.index / self.scene.rate
        self._seconds.append(now)
        for side in SIDES:
            along = float(np.hypot(*frame.wrenches[side][:2]))
            values = {"grip": -frame.wrenches[side][2], "load": along}
            values |= {"grip measured": -measured[side][2]}
            values |= {"load measured": float(np.hypot(*measured[side][:2]))}
            for name, value in values.items():
                self._forces.setdefault(f"{side} {name}", []).append(value)
        picture = np.full((HEIGHT_PX, WIDTH_PX, 3), BACKGROUND, np.uint8)
        self._paint_world(picture[:, :SCENE_PX], frame)
        _text(picture, self.scene.title or self.scene.name, (16, 30), 0.6)
        _text(picture, f"{frame.phase}, {now:.1f} s", (16, 56), 0.6)
        for number, side in enumerate(SIDES):
            left = SCENE_PX + number * CAMERA_PX[0]
            seen = cv2.resize(frame.fingers[side].image, CAMERA_PX, interpolation=cv2.INTER_AREA)
            shown = cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR) if seen.ndim == 2 else seen
            picture[48 : 48 + CAMERA_PX[1], left : left + CAMERA_PX[0]] = shown
            slip = frame.fingers[side].force.slip_state.name.lower().replace("_", " ")
            _text(picture, f"{side}: {slip}", (left + 4, 38), 0.5, GELS[side])
        self._plot(picture[48 + CAMERA_PX[1] + 20 :, SCENE_PX:])
        return picture

    def _paint_world(self, picture: Image, frame: GraspFrame) -> None:
        middle = sum(frame.fingertips[side].position for side in SIDES) / len(SIDES)
        view = _View(np.asarray(middle), picture.shape[1], picture.shape[0])
        for place in np.linspace(-0.2, 0.2, 11):
            for ends in ([[place, -0.2, 0], [place, 0.2, 0]], [[-0.2, place, 0], [0.2, place, 0]]):
                pixels, depths = view.pixels(np.array(ends))
                if depths.min() > NEAREST_M:
                    a, b = pixels.round().astype(int).tolist()
                    cv2.line(picture, a, b, FAINT, 1, cv2.LINE_AA)
        parts: list[tuple[Array, Colour]] = [
            (frame.held.to_gel(self._object), OBJECT_COLOUR[::-1]),
            *((frame.fingertips[side].to_gel(part), colour) for side, part, colour in self._parts),
        ]
        _paint(picture, view, parts)
        for side in SIDES:
            self._paint_force(picture, view, frame.fingertips[side], frame.wrenches[side])

    def _paint_force(self, picture: Image, view: _View, gel: Pose, wrench: Array) -> None:
        """The force on the object, at the gel."""
        tail = gel.position
        ends = np.stack([tail, tail - M_PER_N * (gel.rotation @ wrench[:3])])
        a, b = view.pixels(ends)[0].round().astype(int)
        if np.linalg.norm(b - a) > 3:
            cv2.arrowedLine(picture, a.tolist(), b.tolist(), INK, 2, cv2.LINE_AA, tipLength=0.1)

    def _plot(self, area: Image) -> None:
        """Forces over time: truth as lines, what was measured as dots."""
        height, width = area.shape[:2]
        box = (56, 24, width - 20, height - 40)
        most = 1.05 * max(LEAST_N, *(np.nanmax(item) for item in self._forces.values()))
        end = self.scene.duration

        def place(seconds: Array, newtons: Array) -> NDArray[np.intp]:
            x = box[0] + (box[2] - box[0]) * seconds / end
            y = box[3] - (box[3] - box[1]) * newtons / most
            return np.asarray(np.stack([x, y], axis=-1).round(), np.intp)

        cv2.rectangle(area, (box[0], box[1]), (box[2], box[3]), FAINT, 1)
        newtons, seconds = (
            np.arange(0, most + 1e-9, _tick(most)),
            np.arange(0, end + 1e-9, _tick(end)),
        )
        for value, (x, y) in zip(newtons, place(0 * newtons, newtons).tolist(), strict=True):
            cv2.line(area, (x, y), (box[2], y), FAINT, 1)
            _text(area, f"{value:g}", (8, y + 5), 0.45)
        for value, (x, _) in zip(seconds, place(seconds, 0 * seconds).tolist(), strict=True):
            _text(area, f"{value:g} s", (x - 8, height - 20), 0.45)
        _text(area, "N: grip (thick) and load of each finger; dots: as measured", (56, 16), 0.45)
        now = np.array(self._seconds)
        for side in SIDES:
            for name, width_px in (("grip", 2), ("load", 1)):
                true, found = (
                    np.array(self._forces[f"{side} {name}{more}"]) for more in ("", " measured")
                )
                line = place(now, true).astype(np.int32)
                cv2.polylines(area, [line], False, GELS[side], width_px, cv2.LINE_AA)
                known = np.isfinite(found)
                dots = place(now[known], found[known])
                # One of each column is enough.
                for dot in dots[np.unique(dots[:, 0], return_index=True)[1]].tolist():
                    cv2.circle(area, dot, 2, GELS[side], -1, cv2.LINE_AA)


def _fingertip(size: tuple[float, float, float]) -> tuple[Array, Array]:
    """Triangles of a gel of this size, m, and of the housing behind it."""
    gel = trimesh.creation.box(size)
    gel.apply_translation([0, 0, -size[2] / 2])
    housing = trimesh.creation.box([size[0] * 1.1, size[1] * 1.1, HOUSING_M])
    housing.apply_translation([0, 0, -size[2] - HOUSING_M / 2])
    return np.asarray(gel.triangles), np.asarray(housing.triangles)


class VideoWriter:
    """Writes pictures as an MP4; a context manager.  OutputError where OpenCV cannot."""

    def __init__(self, path: Path, rate: float) -> None:
        for codec in CODECS:
            code = cv2.VideoWriter.fourcc(*codec)
            self._writer = cv2.VideoWriter(str(path), code, rate, (WIDTH_PX, HEIGHT_PX))
            if self._writer.isOpened():
                break
        else:
            msg = f"{path}: OpenCV cannot write a video to this path"
            raise OutputError(msg)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.release()

    def add(self, picture: Image) -> None:
        """Write the next picture."""
        self._writer.write(picture)


class _View:
    """A camera that looks at a place."""

    def __init__(self, at: Array, width: int, height: int) -> None:
        ahead = -EYE / np.linalg.norm(EYE)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        self._eye, self._turn = at + EYE, np.stack([right, -np.cross(right, ahead), ahead])
        self._middle = np.array([width / 2, height / 2])

    def pixels(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths (...,) m of points (..., 3)."""
        seen = (points - self._eye) @ self._turn.T
        return FOCAL_PX * seen[..., :2] / seen[..., 2:] + self._middle, seen[..., 2]


def _paint(picture: Image, view: _View, parts: list[tuple[Array, Colour]]) -> None:
    """Draw triangles (n, 3, 3) of several parts."""
    corners = np.concatenate([part for part, _ in parts])
    colours = np.concatenate([np.tile(colour, (len(part), 1)) for part, colour in parts])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    shades = 0.55 + 0.45 * np.clip(normals @ LIGHT, 0, 1)
    pixels, depths = view.pixels(corners)
    drawn = cv2.resize(picture, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_NEAREST)
    found = np.empty(drawn.shape)
    rasterize_triangles(np.concatenate([FINER * pixels, 1 / depths[..., None]], axis=2), found)
    covered = np.isfinite(found[..., 0])
    numbers = found[covered, 0].round().astype(int)
    drawn[covered] = (shades[:, None] * colours)[numbers]
    picture[:] = cv2.resize(drawn, picture.shape[1::-1], interpolation=cv2.INTER_AREA)


def _tick(most: float) -> float:
    """A round distance of some five ticks."""
    power = 10.0 ** np.floor(np.log10(most / 5))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= most / 5))


def _text(
    picture: Image, text: str, place: tuple[int, int], scale: float, colour: Colour = INK
) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
