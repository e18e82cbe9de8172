"""How fast frames of a pressed gel are rendered, 1024 x 768 px, and what the camera adds.

Peers: "cv2.remap" looks a printed texture of 4096 x 4096 px up at 4 x 4 samples a pixel and
averages them, with the material point behind each sample given to it for nothing; "numpy" finds
the material points itself, at one sample a pixel, by Newton's method on scipy's bicubic splines.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.interpolate import RectBivariateSpline

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard, PrintDefects
from cmp_tactile_simulation.rendering.renderer import Renderer, true_grids
from cmp_tactile_simulation.rendering.surface import DeformedSurface

TEXTURE_SIDE = 4096
PEER_SAMPLES = 4
NEWTON_STEPS = 3
ALL_EFFECTS = CameraSettings(
    light_ratio=2.0, defocus=2.0, glare_spots=2, clutter=10, full_well=8000.0, salt_and_pepper=1e-3
)


def pressed(sensor: SensorDescription) -> DeformedSurface:
    """A gel pressed in by 1 mm and dragged, known every 0.4 mm."""
    size = sensor.elastomer.size[:2]
    grid = SurfaceGrid(round(size[1] / 4e-4) + 1, round(size[0] / 4e-4) + 1, size)
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    bump = np.exp(-((x - 1e-3) ** 2 + y**2) / (2 * 2.5e-3**2))
    displacement = np.stack([2e-4 * bump, -1e-4 * bump, -1e-3 * bump], axis=-1)
    return DeformedSurface(sensor.pattern, grid, displacement)


class RemapPeer:
    """cv2.remap of a printed texture, one sample of each pixel after the other, averaged."""

    def __init__(self, sensor: SensorDescription) -> None:
        size, pattern = sensor.elastomer.size, sensor.pattern
        line = (np.arange(TEXTURE_SIDE) + 0.5) / TEXTURE_SIDE - 0.5
        x, y = np.meshgrid(line * size[0], line * size[1])
        grey = Checkerboard(pattern).grey(np.stack([x, y], axis=-1))
        self._texture = grey.astype(np.float32)
        # The map of the gel at rest, seen straight from below: any map takes as long.
        shape = sensor.image.height * PEER_SAMPLES, sensor.image.width * PEER_SAMPLES
        v, u = np.indices(shape, dtype=np.float32)
        self._map = u * (TEXTURE_SIDE / shape[1]), v * (TEXTURE_SIDE / shape[0])
        self._size = sensor.image.width, sensor.image.height

    def render(self) -> NDArray[np.float32]:
        """One frame."""
        samples = cv2.remap(self._texture, *self._map, cv2.INTER_LINEAR)
        small = cv2.resize(samples, self._size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.float32)


class NumpyPeer:
    """Inverse mapping of all pixels at once, one sample each."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._ink = Checkerboard(sensor.pattern)
        self._rays = [_rays(view) for view in build_views(sensor).values()]

    def render(self, surface: DeformedSurface) -> list[NDArray[np.float64]]:
        """Greys of the pixels of each view."""
        grid, rest = surface.grid, surface.pattern.surface
        height = rest.height(grid.points).reshape(grid.rows, grid.cols)
        y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
        position = np.stack([x, y, height], axis=-1) + surface.displacement
        splines = [RectBivariateSpline(grid.y, grid.x, position[..., c]) for c in range(3)]
        return [self._ink.grey(_meet(splines, *rays)) for rays in self._rays]


def _rays(view: ViewGeometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    v, u = np.indices((view.placement.height, view.placement.width))
    origins, directions = view.rays(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    return origins, directions


def _meet(
    splines: list[RectBivariateSpline], origins: NDArray[np.float64], way: NDArray[np.float64]
) -> NDArray[np.float64]:
    xy = (origins - origins[:, 2:] / way[:, 2:] * way)[:, :2]
    for _ in range(NEWTON_STEPS):
        y, x = xy[:, 1], xy[:, 0]
        at, along, across = (
            np.stack([spline.ev(y, x, dx=dy, dy=dx) for spline in splines], axis=-1)
            for dx, dy in ((0, 0), (1, 0), (0, 1))
        )
        normal = np.cross(along, across)
        t = ((at - origins) * normal).sum(axis=1) / (way * normal).sum(axis=1)
        off = origins + t[:, None] * way - at
        area2 = (normal**2).sum(axis=1)
        xy[:, 0] += (np.cross(off, across) * normal).sum(axis=1) / area2
        xy[:, 1] += (np.cross(along, off) * normal).sum(axis=1) / area2
    return xy


def best_ms(work: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Shortest of several times and of their processor times, ms: the least disturbed ones."""
    times, busy = [], []
    # The first one compiles.
    work()
    for _ in range(repeat):
        began, used = time.perf_counter(), time.process_time()
        work()
        times.append(time.perf_counter() - began)
        busy.append(time.process_time() - used)
    return 1e3 * min(times), 1e3 * min(busy)


def main() -> None:
    """Measure and print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="sample_rig", help="sensor to render (%(default)s)")
    parser.add_argument("--repeat", type=int, default=10, help="frames of each case (%(default)s)")
    arguments = parser.parse_args()
    sensor = load_sensor(arguments.sensor)
    surface = pressed(sensor)
    clean = Checkerboard(sensor.pattern)
    flawed = Checkerboard(sensor.pattern, PrintDefects(50, 20, ragged_edge=8e-6))
    remap, inverse = RemapPeer(sensor), NumpyPeer(sensor)
    peer = best_ms(remap.render, arguments.repeat)
    slow = best_ms(lambda: inverse.render(surface), 1)
    rng = np.random.default_rng(0)
    rows = [("cv2.remap, 4 x 4, map given (peer)", peer), ("numpy, 1 x 1 (peer)", slow)]
    for name, ink, samples, settings in (
        ("1 x 1", clean, 1, None),
        ("2 x 2", clean, 2, None),
        ("2 x 2 and camera (live)", clean, 2, CameraSettings()),
        ("4 x 4", clean, 4, None),
        ("4 x 4 and camera", clean, 4, CameraSettings()),
        ("4 x 4, print defects, all camera effects", flawed, 4, ALL_EFFECTS),
        ("16 x 16", clean, 16, None),
    ):
        renderer = Renderer(sensor, ink, samples)

        def work(renderer: Renderer = renderer, settings: CameraSettings | None = settings) -> None:
            frame = renderer.render(surface)
            if settings is not None:
                expose([frame], settings, rng)

        rows.append((name, best_ms(work, arguments.repeat)))
    rows.append(("true grids of all views", best_ms(lambda: true_grids(sensor, surface), 5)))
    size = f"{sensor.image.width} x {sensor.image.height} px, {get_num_threads()} threads"
    columns = "", "ms", "processor ms", "of cv2.remap", "of numpy"
    table = Table(*columns, title=f"Rendering {size}; ratios of the processor's time")
    for name, (took, used) in rows:
        ratios = f"{used / peer[1]:.2f}", f"{used / slow[1]:.4f}"
        table.add_row(name, f"{took:.1f}", f"{used:.1f}", *ratios)
    Console().print(table)


if __name__ == "__main__":
    main()
