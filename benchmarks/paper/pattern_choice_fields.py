"""What the gel does while a pattern is judged: smooth, sheared, fine, and plane waves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import (
    Hold,
    IndenterDescription,
    MoveBy,
    Phase,
    Scene,
    Start,
    Touch,
)
from cmp_tactile_simulation.scenes.library import load_scene
from paper.experiment import Workplace
from paper.mechanics import mechanics_of

__all__ = ["FIELDS", "WAVELENGTHS", "deformations", "wave_directions", "waves"]

FIELDS = ("press", "shear", "beads")
# Of plane waves, m: from what any pattern resolves to what none does.
WAVELENGTHS = np.geomspace(4e-3, 3.5e-4, 10)
# Each wave's largest slope: all of them together stay small.
SLOPE = 0.06
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
WAVE_SURFACE = SurfaceGrid(441, 441, (0.022, 0.022))

CLEARANCE = 1e-4
PRESS, DRAG = 1.0e-3, (1.0e-3, 0.5e-3)
BEAD_RADIUS, BEAD_PRESS, BEADS = 6e-4, 3e-4, 11
BEADS_REACH = 4.4e-3
FINE_NODES, SMOOTH_NODES, FAST_NODES = 61, 40, 32


def deformations(place: Workplace, pattern: Pattern) -> dict[str, DeformedSurface]:
    """The marker surface, any pattern on it, in each of FIELDS and two sets of waves."""
    large, fine = _scenes(place)
    pressed, beads = mechanics_of(large, place), mechanics_of(fine, place)
    return {
        "press": pressed.surface(int(pressed.frames("press")[-1]), pattern),
        "shear": pressed.surface(int(pressed.frames("drag")[-1]), pattern),
        "beads": beads.surface(int(beads.frames("press")[-1]), pattern),
        "waves 0": waves(pattern, 0),
        "waves 1": waves(pattern, 1),
    }


def wave_directions(which: int) -> NDArray[np.float64]:
    """Unit directions (waves, 2) of a set of waves: spread, and turned in the second set."""
    angles = 0.35 + GOLDEN_ANGLE * np.arange(len(WAVELENGTHS)) + which * np.pi / 2
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def waves(pattern: Pattern, which: int) -> DeformedSurface:
    """Plane waves of all wavelengths at once, in depth, each of the same slope."""
    points = WAVE_SURFACE.points
    displacement = np.zeros((len(points), 3))
    for length, direction in zip(WAVELENGTHS, wave_directions(which), strict=True):
        wave = np.sin(2 * np.pi / length * points @ direction)
        displacement[:, 2] += SLOPE * length / (2 * np.pi) * wave
    shape = WAVE_SURFACE.rows, WAVE_SURFACE.cols, 3
    return DeformedSurface(pattern, WAVE_SURFACE, displacement.reshape(shape))


def _scenes(place: Workplace) -> tuple[Scene, Scene]:
    base = replace(load_scene("slip"), start=Start(Touch((0.0, 0.0), CLEARANCE)))
    down, across = (0.0, 0.0, -CLEARANCE - PRESS), (*DRAG, 0.0)
    rest = Phase("rest", 1, Hold())
    large = replace(
        base,
        name="pattern_choice_large",
        contact_nodes=FAST_NODES if place.fast else SMOOTH_NODES,
        indenter=IndenterDescription("sphere", 1.0, {"radius": 0.008}),
        motion=(rest, Phase("press", 5, MoveBy(down)), Phase("drag", 6, MoveBy(across))),
    )
    fine = replace(
        base,
        name="pattern_choice_fine",
        contact_nodes=FAST_NODES if place.fast else FINE_NODES,
        indenter=_beads(base.sensor.pattern.surface.radius),
        motion=(rest, Phase("press", 4, MoveBy((0.0, 0.0, -CLEARANCE - BEAD_PRESS)))),
    )
    return large, fine


def _beads(cap: float) -> IndenterDescription:
    """Beads on a cap around the gel's, so that all touch at once, regular with no pattern."""
    number = np.arange(BEADS)
    radius = BEADS_REACH * np.sqrt((number + 0.5) / BEADS)
    angle = GOLDEN_ANGLE * number + 0.2
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    around = cap + BEAD_RADIUS
    z = np.sqrt(around**2 - radius**2) - around
    values: Mapping[str, object] = {
        "radius": BEAD_RADIUS,
        "centres": np.stack([x, y, z], axis=-1).tolist(),
    }
    return IndenterDescription("sphere_group", 0.6, values)
