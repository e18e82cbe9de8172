"""What is made worse, step by step, until methods fail (section IV.F): light, noise, blur."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

__all__ = ["SWEEPS", "Disturbance", "Sweep", "lit"]

# Across the frame in which the light fades, one for each repetition: along y each view has all of
# it, along x one view is the dark one.
DIRECTIONS = (math.pi / 2, 0.0, math.pi / 4)
GOOD = CameraSettings()


@dataclass(frozen=True)
class Disturbance:
    """The camera, and a light that fades linearly across the pattern.

    light_ratio: darkest over brightest illumination of the pattern, both views together; the
    camera's own setting tells that of the whole frame, of which the pattern fills a part.
    direction: from the frame's x axis (right) towards y (down), rad.
    """

    camera: CameraSettings
    light_ratio: float = 1.0
    direction: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """Levels of one disturbance, from good to bad.

    level: what it is called, with its unit.  disturbance: of a level.
    repetitions: of a full run, each with noise of its own.
    fast_levels: of the quick run.  paper_limit: level up to which the paper's algorithm worked.
    logarithmic: how the level's axis is drawn.  percent: levels are shares.
    """

    key: str
    title: str
    level: str
    levels: tuple[float, ...]
    fast_levels: tuple[float, ...]
    disturbance: Callable[[float], Disturbance]
    repetitions: int
    paper_limit: float | None = None
    logarithmic: bool = False
    percent: bool = False

    def at(self, level: float, repetition: int) -> Disturbance:
        """A level; repetitions differ in where the light comes from."""
        direction = DIRECTIONS[repetition % len(DIRECTIONS)]
        return replace(self.disturbance(level), direction=direction)


def lit(frame: RenderedFrame, disturbance: Disturbance, grids: Mapping[str, Grid]) -> RenderedFrame:
    """The frame in the disturbance's light; grids: where the pattern is in the views at rest."""
    if disturbance.light_ratio == 1:
        return frame
    along = math.cos(disturbance.direction), math.sin(disturbance.direction)
    corners = [grid.corners_frame.reshape(-1, 2) @ along for grid in grids.values()]
    first, last = np.nanmin(corners), np.nanmax(corners)
    rows, cols = (np.arange(side) / frame.fineness for side in frame.grey.shape)
    way = (cols * along[0] + (rows * along[1])[:, None] - first) / (last - first)
    light = 1 - (1 - disturbance.light_ratio) * way.clip(0, 1)
    return replace(frame, grey=(frame.grey * light).astype(np.float32))


def _light(ratio: float) -> Disturbance:
    return Disturbance(GOOD, ratio)


def _visibility(visibility: float) -> Disturbance:
    dark = GOOD.light_level * (1 - visibility) / (1 + visibility)
    return Disturbance(replace(GOOD, dark_level=dark))


def _impulses(share: float) -> Disturbance:
    return Disturbance(replace(GOOD, salt_and_pepper=share))


def _gaussian(deviation: float) -> Disturbance:
    return Disturbance(replace(GOOD, read_noise=deviation))


def _blur(deviation: float) -> Disturbance:
    return Disturbance(replace(GOOD, blur=deviation))


# Michelson's (light - dark) / (light + dark) of the simulated print: 205 and 45 of 255.
VISIBILITY = (GOOD.light_level - GOOD.dark_level) / (GOOD.light_level + GOOD.dark_level)

SWEEPS: Mapping[str, Sweep] = MappingProxyType(
    {
        sweep.key: sweep
        for sweep in (
            Sweep(
                "light",
                "Uneven light",
                "darkest over brightest illumination",
                (1.0, 0.7, 0.4, 0.3, 0.2, 0.1, 0.07, 0.05, 0.03, 0.01),
                (1.0, 0.4, 0.03),
                _light,
                3,
                paper_limit=0.4,
                logarithmic=True,
            ),
            Sweep(
                "contrast",
                "Weak contrast",
                "visibility of the print",
                (VISIBILITY, 0.3, 0.1, 0.05, 0.03, 0.02, 0.01),
                (VISIBILITY, 0.02),
                _visibility,
                2,
                logarithmic=True,
            ),
            Sweep(
                "salt_and_pepper",
                "Salt and pepper",
                "pixels spoilt",
                (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7),
                (0.0, 0.05, 0.2, 0.4),
                _impulses,
                3,
                paper_limit=0.05,
                percent=True,
            ),
            Sweep(
                "gaussian",
                "Gaussian noise",
                "standard deviation, grey levels",
                (1.0, 4.0, 16.0, 32.0, 48.0, 64.0, 96.0),
                (1.0, 64.0),
                _gaussian,
                2,
                logarithmic=True,
            ),
            Sweep(
                "blur",
                "Blur",
                "standard deviation, px",
                (0.7, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0),
                (0.7, 4.0),
                _blur,
                2,
            ),
        )
    }
)
