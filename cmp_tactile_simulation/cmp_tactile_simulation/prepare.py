"""Compiles what renders the frames of any scene: `python3 -m cmp_tactile_simulation.prepare`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmp_tactile_simulation.gel import observers
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera

SPIKE_M = 3e-3


def main() -> None:
    """Have numba's cache hold all that renders frames."""
    scene = load_scene("grasp")
    grid = observers(scene.sensor)
    # A spike hides what lies behind it.
    moved = np.zeros((grid.rows, grid.cols, 3))
    moved[grid.rows // 2, grid.cols // 2, 2] = -SPIKE_M
    surface = DeformedSurface(scene.sensor.pattern, grid, moved)
    camera = SensorCamera(scene.sensor, scene.look)
    for defects in PrintDefects(), PrintDefects(missing_ink=1):
        camera.use(replace(scene.look, defects=defects))
        camera.picture(0, surface)
    camera.truth.grids(surface)
    camera.truth.surface(surface)


if __name__ == "__main__":
    main()
