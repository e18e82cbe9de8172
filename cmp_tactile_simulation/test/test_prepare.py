"""What renders frames is compiled before the first of them, by another process."""

import os
import subprocess
import sys

# A second process that renders what the first one did not: a gel that is pressed.
RENDER = """
import numpy as np
from cmp_tactile_processing.cache.compiled import when_compiling
from cmp_tactile_simulation.gel import observers
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera

scene = load_scene("grasp")
grid = observers(scene.sensor)
rest = np.zeros((grid.rows, grid.cols, 3))
pressed = rest + 1e-4 * np.exp(-(grid.points**2).sum(axis=1) / 1e-5).reshape(grid.rows, -1, 1)
with when_compiling(lambda _, share: share or print("compiled")):
    camera = SensorCamera(scene.sensor, scene.look)
    surface = DeformedSurface(scene.sensor.pattern, grid, -pressed)
    camera.truth.grids(surface)
    print(camera.picture(3, surface).std() > 10)
"""


def test_a_prepared_scene_is_rendered_without_compiling(tmp_path):
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    prepare = [sys.executable, "-m", "cmp_tactile_simulation.prepare"]
    subprocess.run(prepare, env=env, check=True)
    found = subprocess.run(
        [sys.executable, "-c", RENDER], env=env, check=True, capture_output=True, text=True
    )
    assert found.stdout.split() == ["True"]
