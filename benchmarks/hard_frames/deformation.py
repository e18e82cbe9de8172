"""Shapes of a gel that is deformed by hand: zones that move, and kinds of deformations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.rendering.surface import DeformedSurface

POINTS_PER_RADIUS = 4.0
POINT_COUNTS = 24, 320
# Extent of the sample rig's pattern, m: the library's lengths hold for it and scale with others.
EXTENT = 0.0145


@dataclass(frozen=True)
class Zone:
    """A round part of the gel that moves: by exp(-(distance / radius)^power) of what is given.

    x, y: its centre, gel frame.  shift: along x and y.  turn: about the centre.
    spread: share by which lengths grow there.  All lengths in m, angles in rad.
    """

    x: float = 0.0
    y: float = 0.0
    radius: float = 3e-3
    depth: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    spread: float = 0.0
    power: float = 2.0

    def displacement(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (..., 3) m of the points that lay at (x, y) m at rest."""
        dx, dy = x - self.x, y - self.y
        share = np.exp(-((np.hypot(dx, dy) / self.radius) ** self.power))
        cosine, sine = np.cos(self.turn * share), np.sin(self.turn * share)
        grown = 1 + self.spread * share
        along_x = grown * (cosine * dx - sine * dy) - dx + share * self.shift[0]
        along_y = grown * (sine * dx + cosine * dy) - dy + share * self.shift[1]
        return np.stack([along_x, along_y, -self.depth * share], axis=-1)


Deformation = tuple[Zone, ...]


def deform(sensor: SensorDescription, zones: Deformation) -> DeformedSurface:
    """The sensor's marker surface with these zones moved, each as if it were alone."""
    if not zones:
        return DeformedSurface.rest(sensor.pattern)
    extent = sensor.elastomer.size[:2]
    step = min(zone.radius for zone in zones) / POINTS_PER_RADIUS
    cols, rows = (int(np.clip(np.ceil(side / step), *POINT_COUNTS)) + 1 for side in extent)
    grid = SurfaceGrid(rows, cols, extent)
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    moved = np.zeros((rows, cols, 3))
    for zone in zones:
        moved += zone.displacement(x, y)
    return DeformedSurface(sensor.pattern, grid, moved)


def _rest(pattern: Pattern, rng: np.random.Generator) -> Deformation:  # noqa: ARG001
    return ()


def _press(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    x, y = rng.uniform(-0.1, 0.1, 2) * EXTENT
    return _scaled(pattern, Zone(x, y, 3.6e-3, depth=9e-4, spread=0.09))


def _slide(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(6e-4, 9e-4)
    x, y = rng.uniform(-0.1, 0.1, 2) * EXTENT
    shift = length * np.cos(angle), length * np.sin(angle)
    press, drag = Zone(x, y, 4e-3, depth=1.1e-3), Zone(x, y, 6.5e-3, shift=shift)
    return _scaled(pattern, press, drag)


def _twist(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    x, y = rng.uniform(-0.1, 0.1, 2) * EXTENT
    turn = rng.choice([-1, 1]) * rng.uniform(0.14, 0.2)
    press, turned = Zone(x, y, 3.5e-3, depth=7e-4), Zone(x, y, 5e-3, turn=turn)
    return _scaled(pattern, press, turned)


def _bumps(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    places = rng.uniform(-0.3, 0.3, (5, 2)) * EXTENT
    zones = [
        Zone(x, y, rng.uniform(9e-4, 1.6e-3), depth=rng.uniform(1.5e-4, 3.5e-4), spread=0.06)
        for x, y in places
    ]
    return _scaled(pattern, *zones)


def _spheres(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    """Small spheres, each touching in the middle of a checker's side or of a checker."""
    rows = rng.permutation(pattern.rows - 1)[: max(1, min(12, pattern.rows // 2))]
    zones = []
    for row in rows:
        col = rng.integers(pattern.cols - 1)
        at_row, at_col = [(0.0, 0.5), (0.5, 0.0), (0.5, 0.5)][rng.integers(3)]
        x = (col + at_col - (pattern.cols - 1) / 2) * pattern.pitch
        y = (row + at_row - (pattern.rows - 1) / 2) * pattern.pitch
        radius = rng.uniform(0.5, 0.8) * pattern.pitch
        zones.append(Zone(x, y, radius, depth=rng.uniform(0.16, 0.28) * radius, spread=0.05))
    return tuple(zones)


def _drag(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    angle = rng.uniform(0, 2 * np.pi)
    shift = 6e-4 * np.cos(angle), 6e-4 * np.sin(angle)
    press, drag = Zone(0, 0, 4.5e-3, depth=1e-3, spread=0.08), Zone(0, 0, 8e-3, shift=shift)
    return _scaled(pattern, press, drag)


def _knock(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    """Moved by more than two checkers, unless they are large, and nearly as a whole."""
    # Not further than a gel can be dragged.
    angle, length = rng.uniform(0, 2 * np.pi), float(np.clip(2.2 * pattern.pitch, 1.5e-3, 2.4e-3))
    shift = length * np.cos(angle), length * np.sin(angle)
    (press,) = _scaled(pattern, Zone(0, 0, 4.5e-3, depth=1e-3, spread=0.05))
    (drag,) = _scaled(pattern, Zone(0, 0, 9e-3, power=4))
    return press, Zone(0, 0, drag.radius, shift=shift, power=4)


def _scaled(pattern: Pattern, *zones: Zone) -> Deformation:
    scale = max(pattern.rows + 1, pattern.cols + 1) * pattern.pitch / EXTENT
    return tuple(
        replace(
            zone,
            x=zone.x * scale,
            y=zone.y * scale,
            radius=zone.radius * scale,
            depth=zone.depth * scale,
            shift=(zone.shift[0] * scale, zone.shift[1] * scale),
        )
        for zone in zones
    )


DEFORMATIONS: dict[str, Callable[[Pattern, np.random.Generator], Deformation]] = {
    "rest": _rest,
    "press": _press,
    "slide": _slide,
    "twist": _twist,
    "bumps": _bumps,
    "spheres": _spheres,
    "drag": _drag,
    "knock": _knock,
}


def deformation_of(kind: str, pattern: Pattern, seed: int = 0) -> Deformation:
    """Zones of that kind, of a size that suits the pattern, at places set by the seed.

    Raises InputError for a kind that is not in DEFORMATIONS.
    """
    if kind not in DEFORMATIONS:
        msg = f"deformation: found {kind!r}, expected one of {', '.join(DEFORMATIONS)}"
        raise InputError(msg)
    return DEFORMATIONS[kind](pattern, np.random.default_rng([len(kind), seed]))


# Zones of a gel with a pattern of 14.5 mm, m: pressed, dragged, and dragged nearly as a whole.
PRESSED, DRAGGED, SHIFTED = 4.5e-3, 8e-3, 9e-3
DEPTH = 1e-3


def jump(
    sensor: SensorDescription, shift: tuple[float, float], depth: float = DEPTH
) -> Deformation:
    """A pressed gel that is shifted nearly as a whole.  shift: along x and y, in checkers."""
    pitch = sensor.pattern.pitch
    moved = Zone(radius=SHIFTED, shift=(shift[0] * pitch, shift[1] * pitch), power=4)
    return Zone(radius=PRESSED, depth=depth, spread=0.05), moved
