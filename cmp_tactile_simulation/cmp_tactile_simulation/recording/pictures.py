"""A recording as pictures: numbered images with the arrays of their truth, and a video of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.measured import Grid, Surface, gridline_points
from cmp_tactile_simulation.recording.truth import RecordedFrame
from cmp_tactile_simulation.scenes.description import Motion, Scene

Colour = tuple[int, int, int]

HEIGHT_PX = 768
MAP_PX = 480
MARGIN_PX = 24
PANEL_PX = MAP_PX + 2 * MARGIN_PX
INK: Colour = (235, 235, 235)
FAINT: Colour = (150, 150, 150)
ARROW: Colour = (255, 255, 255)
BACKGROUND: Colour = (32, 28, 26)
# The colours span this depth at least, so that a gel at rest looks flat.
LEAST_DEPTH_M = 1e-4
# Force nodes are finer than arrows can be drawn.
ARROWS_ACROSS = 16
LONGEST_ARROW_PX = 45.0
# The arrows are scaled to the largest force a node had so far, and to this at least.
LEAST_FORCE_N = 0.02
CODEC = "mp4v"
SUBPIXEL_BITS = 4

LEAST_DIGITS = 3


def write_video(
    path: Path,
    frames: Iterable[RecordedFrame],
    scene: Scene,
    on_frame: Callable[[int], None] = lambda _done: None,
) -> None:
    """Write frames with their truth beside them as an MP4 file at the scene's rate.

    on_frame: called with the number of frames done.  Raises OutputError where OpenCV cannot write
    videos there.
    """
    partial = path.with_name(f".partial.{path.name}")
    motion = Motion(scene.motion)
    writer = None
    scale = _Scale()
    number = -1
    for number, frame in enumerate(frames):
        title = f"{scene.title}: {motion.phase(number).name}, {number / scene.rate:.2f} s"
        picture = draw_frame(frame, title, scale)
        if writer is None:
            writer = _open(partial, picture, scene.rate)
        writer.write(picture)
        on_frame(number + 1)
    if writer is None:
        msg = f"{path}: found no frame, expected at least one"
        raise OutputError(msg)
    writer.release()
    partial.replace(path)


class _Scale:
    """What full colour and the longest arrow stand for: the largest value so far."""

    def __init__(self) -> None:
        self.depth_m = LEAST_DEPTH_M
        self.force_n = LEAST_FORCE_N

    def include(self, depth_m: float, force_n: float) -> None:
        self.depth_m = max(self.depth_m, depth_m)
        self.force_n = max(self.force_n, force_n)


def draw_frame(frame: RecordedFrame, title: str, scale: _Scale | None = None) -> NDArray[np.uint8]:
    """The picture (768, w, 3) uint8 BGR: camera frame, depth map with force arrows, wrench."""
    scale = scale or _Scale()
    image = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)
    ratio = HEIGHT_PX / image.shape[0]
    # Video codecs want even sides.
    size = (2 * round(image.shape[1] * ratio / 2), HEIGHT_PX)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    panel = np.full((HEIGHT_PX, PANEL_PX, 3), BACKGROUND, np.uint8)
    at = slice(MARGIN_PX, MARGIN_PX + MAP_PX)
    panel[at, at] = _map(frame, scale)
    _write_lines(panel, _lines(frame, title, scale))
    return np.asarray(np.hstack([image, panel]), np.uint8)


def _map(frame: RecordedFrame, scale: _Scale) -> NDArray[np.uint8]:
    """Depth by colour with force arrows; x to the right, y upwards, as seen from the object."""
    depth = np.nan_to_num(-frame.surface.displacement[..., 2])
    sums, places = _arrows(frame)
    in_plane = np.linalg.norm(sums[:, :2], axis=1)
    scale.include(float(depth.max()), float(in_plane.max(initial=0.0)))
    grey = (np.clip(depth / scale.depth_m, 0, 1) * 255).astype(np.uint8)
    large = cv2.resize(grey[::-1], (MAP_PX, MAP_PX), interpolation=cv2.INTER_CUBIC)
    picture = cv2.applyColorMap(large, cv2.COLORMAP_VIRIDIS)
    to_px = _pixel_map(frame)
    for force, place in zip(sums, places, strict=True):
        length = float(np.linalg.norm(force[:2])) / scale.force_n * LONGEST_ARROW_PX
        if length >= 1.0:
            start = to_px(place)
            step = force[:2] / scale.force_n * LONGEST_ARROW_PX * (1, -1)
            tail, tip = _fixed_point(start), _fixed_point(start + step)
            cv2.arrowedLine(
                picture, tail, tip, ARROW, 1, cv2.LINE_AA, shift=SUBPIXEL_BITS, tipLength=0.3
            )
    return np.asarray(picture, np.uint8)


def _fixed_point(pixel: NDArray[np.float64]) -> tuple[int, int]:
    """As OpenCV takes parts of pixels."""
    x, y = np.round(pixel * 2**SUBPIXEL_BITS).astype(int).tolist()
    return x, y


def _pixel_map(frame: RecordedFrame) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Pixels of the map for points at rest."""
    rest = (frame.surface.position - frame.surface.displacement)[..., :2].reshape(-1, 2)
    low, high = np.nanmin(rest, axis=0), np.nanmax(rest, axis=0)

    def to_px(point: NDArray[np.float64]) -> NDArray[np.float64]:
        share = (point[:2] - low) / (high - low)
        return np.asarray(MAP_PX * np.array([share[0], 1.0 - share[1]]))

    return to_px


def _arrows(frame: RecordedFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Forces (n, 3) N summed over blocks of nodes, and the blocks' places (n, 3) m."""
    low, high = frame.force.position.min(axis=0)[:2], frame.force.position.max(axis=0)[:2]
    cell = ((frame.force.position[:, :2] - low) / (high - low) * ARROWS_ACROSS).astype(np.intp)
    cell = np.minimum(cell, ARROWS_ACROSS - 1)
    number = cell[:, 1] * ARROWS_ACROSS + cell[:, 0]
    count = np.maximum(np.bincount(number, minlength=ARROWS_ACROSS**2), 1)[:, None]

    def sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = [np.bincount(number, values[:, k], ARROWS_ACROSS**2) for k in range(3)]
        return np.stack(columns, axis=1)

    return sums(frame.force.force), sums(frame.force.position) / count


def _lines(frame: RecordedFrame, title: str, scale: _Scale) -> list[tuple[str, Colour]]:
    fx, fy, fz, mx, my, mz = frame.force.wrench.tolist()
    depth = 1e3 * float(np.nanmax(-frame.surface.displacement[..., 2]))
    key = f"colour: depth to {1e3 * scale.depth_m:.2f} mm   arrow: shear to {scale.force_n:.3f} N"
    return [
        (title, INK),
        (f"F  {fx:+8.3f} {fy:+8.3f} {fz:+8.3f} N", INK),
        (f"M  {1e3 * mx:+8.2f} {1e3 * my:+8.2f} {1e3 * mz:+8.2f} N mm", INK),
        (f"depth {depth:.3f} mm   contact {1e6 * frame.force.contact_area:.1f} mm2", INK),
        (key, FAINT),
    ]


def _write_lines(panel: NDArray[np.uint8], lines: list[tuple[str, Colour]]) -> None:
    y = MARGIN_PX + MAP_PX + 36
    for text, colour in lines:
        size, _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        scale = 0.55 * min(1.0, MAP_PX / size[0])
        cv2.putText(
            panel, text, (MARGIN_PX, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA
        )
        y += 36


def _open(path: Path, picture: NDArray[np.uint8], rate: float) -> cv2.VideoWriter:
    height, width = picture.shape[:2]
    codec = cv2.VideoWriter.fourcc(*CODEC)
    writer = cv2.VideoWriter(str(path), codec, rate, (width, height))
    if not writer.isOpened():
        msg = f"{path}: OpenCV cannot write a video to this path"
        raise OutputError(msg)
    return writer


def write_images(
    folder: Path, frames: Iterable[RecordedFrame], count: int, on_frame: Callable[[int], None]
) -> int:
    """Write NNN.png and NNN.npz of each frame into a folder; docs/scenes.md lists the arrays.

    count: of the whole scene's frames.  on_frame: called with the number of frames done.
    Returns how many were written.
    """
    written = 0
    digits = max(LEAST_DIGITS, len(str(count - 1)))
    for number, frame in enumerate(frames):
        path = folder / f"{number:0{digits}d}.png"
        path.write_bytes(frame.png)
        np.savez_compressed(path.with_suffix(".npz"), allow_pickle=False, **_true_arrays(frame))
        written = number + 1
        on_frame(written)
    return written


def _true_arrays(frame: RecordedFrame) -> dict[str, NDArray[Any]]:
    force = frame.force
    return {
        **_pixels(frame.grids),
        **_points(frame.surface),
        "stamp_ns": np.array(frame.stamp_ns, np.int64),
        "force_position": force.position,
        "force": force.force,
        "contact": force.contact,
        "wrench": force.wrench,
        "contact_area": np.array(force.contact_area),
        "centre_of_pressure": force.centre_of_pressure,
        "slip_state": np.array(int(force.slip_state), np.uint8),
        "indenter_position": frame.pose.position,
        "indenter_rotation": frame.pose.rotation,
    }


def _pixels(grids: Mapping[str, Grid]) -> dict[str, NDArray[np.float64]]:
    arrays = {}
    for view, grid in grids.items():
        corners = grid.corners_frame
        arrays[f"corners_{view}_px"] = corners
        arrays[f"row_lines_{view}_px"] = gridline_points(corners, grid.row_lines_frame)
        arrays[f"col_lines_{view}_px"] = gridline_points(
            corners.swapaxes(0, 1), grid.col_lines_frame.swapaxes(0, 1)
        )
    return arrays


def _points(surface: Surface) -> dict[str, NDArray[np.float64]]:
    corners = surface.position
    return {
        "corners_m": corners,
        "displacement_m": surface.displacement,
        "row_lines_m": gridline_points(corners, surface.row_position),
        "col_lines_m": gridline_points(corners.swapaxes(0, 1), surface.col_position.swapaxes(0, 1)),
    }
