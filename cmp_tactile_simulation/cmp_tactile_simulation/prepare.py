"""Compiles what renders frames: `python3 -m cmp_tactile_simulation.prepare SCENE`.

It needs no elastomer, and so may be done while that of the scene is built in another process.
"""

from __future__ import annotations

import sys

import numpy as np

from cmp_tactile_simulation.gel import observers
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera


def prepare_rendering(scene: Scene) -> None:
    """Have numba's cache hold all that renders frames of a scene."""
    grid = observers(scene.sensor)
    at_rest = np.zeros((grid.rows, grid.cols, 3))
    SensorCamera(scene.sensor, grid, scene.look).observe(0, at_rest)


if __name__ == "__main__":
    prepare_rendering(load_scene(sys.argv[1]))
