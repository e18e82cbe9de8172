"""Rigs and frames with known truth for the tests of the core."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.known_surface import surface_intersection
from cmp_tactile_processing.optics import ViewGeometry, build_views
from cmp_tactile_processing.pattern import Pattern, PatternSurface
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.split import split_frame

DATA = Path(__file__).parent.parent / "data"
CONFIG = Path(__file__).parent.parent.parent / "config"
STILLS = ("rest", "slide", "press", "twist", "bumps")


@dataclass(frozen=True)
class Still:
    """A sample frame and its truth: corners_left_px, corners_m, row_lines_left_px, ..."""

    frame: NDArray[np.uint8]
    truth: dict[str, NDArray[np.float64]]


@pytest.fixture(scope="session")
def sensor() -> SensorDescription:
    """The rig that rendered the sample frames."""
    return SensorDescription.load(CONFIG / "sample_rig.yaml")


@pytest.fixture(scope="session")
def _pipeline(sensor: SensorDescription) -> Pipeline:
    return Pipeline(sensor)


@pytest.fixture
def pipeline(_pipeline: Pipeline) -> Pipeline:
    """The rig's pipeline as after start-up; shared, so its reference must stay the nominal one."""
    _pipeline.reset()
    return _pipeline


@pytest.fixture(scope="session")
def stills() -> dict[str, Still]:
    """The sample frames by name."""
    found = {}
    for name in STILLS:
        frame = cv2.imread(str(DATA / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        with np.load(DATA / f"{name}.npz", allow_pickle=False) as truth:
            found[name] = Still(np.asarray(frame, dtype=np.uint8), dict(truth))
    return found


@pytest.fixture(scope="session")
def plane_rig(sensor: SensorDescription) -> Callable[..., SensorDescription]:
    """Makes a rig like the sample's with a flat pattern of rows x cols corners over 13 mm."""

    def make(rows: int, cols: int, corner_checker: str = "dark") -> SensorDescription:
        pitch = 0.013 / max(rows, cols)
        pattern = Pattern(rows, cols, pitch, corner_checker, 4, PatternSurface())
        return replace(sensor, pattern=pattern)

    return make


@pytest.fixture(scope="session")
def render_rest() -> Callable[..., NDArray[np.uint8]]:
    """Renders the view image of a pattern at rest: exact rays, 3 x 3 samples a pixel.

    The margin around the pattern has the colour opposite to `corner_checker`, as on a real gel.
    """
    return _render_rest


def _render_rest(sensor: SensorDescription, view: str) -> NDArray[np.uint8]:
    geometry = build_views(sensor)[view]
    place, samples = geometry.placement, 3
    total = np.zeros((place.height, place.width))
    for sub_y in range(samples):
        for sub_x in range(samples):
            shift = (np.array([sub_x, sub_y]) + 0.5) / samples - 0.5
            total += _colour(sensor, geometry, shift)
    blurred = cv2.GaussianBlur(40 + 160 * total / samples**2, (0, 0), 0.7)
    noise = np.random.default_rng(7).normal(0, 1, blurred.shape)
    return np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)


def _colour(
    sensor: SensorDescription, geometry: ViewGeometry, shift: NDArray[np.float64]
) -> NDArray[np.float64]:
    """1 where a light checker or margin is seen, 0 where a dark one is."""
    pattern, place = sensor.pattern, geometry.placement
    v, u = np.mgrid[: place.height, : place.width]
    origins, directions = geometry.rays(np.stack([u, v], axis=-1) + shift)
    xy = surface_intersection(origins, directions, pattern.surface)[..., :2]
    col = np.floor(xy[..., 0] / pattern.pitch + (pattern.cols - 1) / 2) + 1
    row = np.floor(xy[..., 1] / pattern.pitch + (pattern.rows - 1) / 2) + 1
    printed = (col >= 0) & (col <= pattern.cols) & (row >= 0) & (row <= pattern.rows)
    first_light = pattern.corner_checker == "light"
    light = ((row + col) % 2 == 0) == first_light
    # Where a ray misses the surface there is margin: a comparison with NaN is false.
    return np.where(printed, light, not first_light).astype(np.float64)


@pytest.fixture(scope="session")
def view_image(sensor: SensorDescription) -> Callable[[Still, str], NDArray[np.uint8]]:
    """Cuts one view out of a sample frame."""
    views = build_views(sensor)
    return lambda still, view: split_frame(still.frame, views[view].placement)
