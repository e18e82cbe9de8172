"""Compiles what renders the frames of any scene: `python3 -m cmp_tactile_simulation.prepare`."""

from __future__ import annotations

from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera


def main() -> None:
    """Have numba's cache hold all that renders frames."""
    scene = load_scene("grasp")
    camera, at_rest = (
        SensorCamera(scene.sensor, scene.look),
        DeformedSurface.rest(scene.sensor.pattern),
    )
    camera.picture(0, at_rest)
    camera.truth.grids(at_rest)
    camera.truth.surface(at_rest)


if __name__ == "__main__":
    main()
