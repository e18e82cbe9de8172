"""Compiles what renders the frames of any scene: `python3 -m cmp_tactile_simulation.prepare`."""

from __future__ import annotations

import numpy as np

from cmp_tactile_simulation.gel import observers
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera


def main() -> None:
    """Have numba's cache hold all that renders frames."""
    scene = load_scene("grasp")
    grid = observers(scene.sensor)
    at_rest = np.zeros((grid.rows, grid.cols, 3))
    SensorCamera(scene.sensor, grid, scene.look).observe(0, at_rest)


if __name__ == "__main__":
    main()
