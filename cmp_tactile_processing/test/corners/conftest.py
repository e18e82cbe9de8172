"""Images of checkers in closed form: products of blurred square waves under an affine map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

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
    """An image of whose pixels that share is 0 or 255, and which."""
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
    """Spoils a share of an image's pixels and tells which."""
    return _with_salt_and_pepper
