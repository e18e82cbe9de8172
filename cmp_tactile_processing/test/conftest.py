"""Sample frames with their truth, rigs and drawn checkers, for all rooms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.rectification import surface_intersection
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import USUAL_STD, Pattern, PatternSurface, Uncertainty

DATA = Path(__file__).parent / "data"


@pytest.fixture
def count_calls(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str], list[None]]:
    """Wraps a function of a module; the list it returns grows with every call."""

    def wrap(module: Any, name: str) -> list[None]:
        calls: list[None] = []
        function = getattr(module, name)

        def counting(*args: Any, **kwargs: Any) -> Any:
            calls.append(None)
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, counting)
        return calls

    return wrap


CONFIG = Path(__file__).parents[1] / "config"

STILLS = ("rest", "slide", "press", "twist", "bumps")


@dataclass(frozen=True)
class Still:
    """A sample frame (768, 1024) and its truth: corners_left_px, corners_m, row_lines_left_px..."""

    frame: NDArray[np.uint8]
    truth: dict[str, NDArray[np.float64]]

    @classmethod
    def load(cls, name: str) -> Still:
        frame = cv2.imread(str(DATA / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        with np.load(DATA / f"{name}.npz", allow_pickle=False) as truth:
            return cls(np.asarray(frame, dtype=np.uint8), dict(truth))


@pytest.fixture(scope="session")
def sample() -> Callable[[str], Still]:
    """Reads a sample frame by its name."""
    return Still.load


@pytest.fixture(scope="session")
def sensor() -> SensorDescription:
    """The rig that rendered the sample frames; its gel is known exactly, as that of the truth."""
    sensor = SensorDescription.load(CONFIG / "sample_rig.yaml")
    exact = {name: 0.0 for name in USUAL_STD if name.startswith("elastomer")}
    return replace(sensor, uncertainty=Uncertainty(exact))


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
    return {name: Still.load(name) for name in STILLS}


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


SAMPLES = 4


@dataclass(frozen=True)
class CheckerImage:
    """n x n corners about the centre of an image, and how it is seen.

    side_px, angle (rad), phase (x, y) of the middle corner against a pixel's centre; shear and
    squeeze of the second axis; bend: turn of a gridline per checker, rad; light: relative change
    of the light per checker; blur_px: standard deviation in checker axes, before the pixels.
    """

    side_px: float = 17.0
    n: int = 5
    angle: float = 0.3
    phase: tuple[float, float] = (0.2, -0.35)
    shear: float = 0.0
    squeeze: float = 1.0
    bend: float = 0.0
    light: float = 0.0
    blur_px: float = 0.8
    mean: float = 110.0
    half: float = 50.0

    @property
    def size(self) -> int:
        return int((self.n + 3) * self.side_px) + 8

    def _centre(self) -> NDArray[np.float64]:
        return (self.size - 1) / 2 + np.array(self.phase)

    def _map(self) -> NDArray[np.float64]:
        c, s = np.cos(self.angle), np.sin(self.angle)
        affine = np.array([[1.0, self.shear], [0.0, self.squeeze]])
        return self.side_px * np.array([[c, -s], [s, c]]) @ affine

    def corners(self) -> NDArray[np.float64]:
        """True corners (n^2, 2), px: those on the middle gridlines alone where these bend."""
        reach = np.arange(-(self.n // 2), self.n // 2 + 1.0)
        target = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
        place = target.copy()
        for _ in range(50):
            place = target + self.bend / 2 * place[:, ::-1] ** 2
        return self._centre() + place @ self._map().T

    def render(self, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
        """The image, SAMPLES x SAMPLES samples a pixel, with Gaussian noise."""
        inverse = np.linalg.inv(self._map())
        y, x = np.mgrid[: self.size, : self.size].astype(np.float64)
        blur = self.blur_px / self.side_px
        total = np.zeros_like(x)
        offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        for down in offsets:
            for right in offsets:
                pixel = np.stack([x + right, y + down], axis=-1) - self._centre()
                s, t = np.moveaxis(pixel @ inverse.T, -1, 0)
                bent = s - self.bend / 2 * t * t, t - self.bend / 2 * s * s
                total += _wave(bent[0], blur) * _wave(bent[1], blur / self.squeeze)
        light = 1 + self.light * (x - self._centre()[0]) / self.side_px
        grey = light * (self.mean + self.half * total / SAMPLES**2)
        grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _wave(s: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """A square wave that changes sign at each integer, blurred by a Gaussian."""
    nearest = np.rint(s)
    rest = s - nearest
    edges = sum((-1) ** k * erf((rest - k) / (np.sqrt(2) * blur)) for k in range(-2, 3))
    return np.where(nearest % 2 == 0, edges, -edges)


def _with_salt_and_pepper(
    grey: NDArray[np.uint8], share: float, seed: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The image with that share of its pixels 0 or 255, and which."""
    draw = np.random.default_rng(seed).random(grey.shape)
    result = grey.copy()
    result[draw < share / 2] = 0
    result[draw > 1 - share / 2] = 255
    return result, (draw < share / 2) | (draw > 1 - share / 2)


@pytest.fixture(scope="session")
def checkers() -> type[CheckerImage]:
    """Makes images of checkers with known corners."""
    return CheckerImage


@pytest.fixture(scope="session")
def with_salt_and_pepper() -> Callable[..., tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """Spoils a share of an image's pixels; returns the image and which."""
    return _with_salt_and_pepper
