"""A scene that is simulated in a blink."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import read_scene

# A quarter of the sample rig's resolution, and a pattern that is not square.
SMALL_SENSOR = {
    "base": "sample_rig",
    "name": "small",
    "image": {"width": 256, "height": 192},
    "camera": {"fx": 183.35, "fy": 183.35, "cx": 127.5, "cy": 95.5},
    "views": {"left": {"roi": [0, 0, 128, 192]}, "right": {"roi": [128, 0, 128, 192]}},
    "pattern": {"rows": 5, "cols": 6, "pitch": 0.0024, "points_per_segment": 2},
}
SMALL_SCENE: dict[str, Any] = {
    "version": 1,
    "name": "small",
    "title": "A small scene",
    "source": "test",
    "sensor": SMALL_SENSOR,
    "contact_nodes": 14,
    "indenter": {"type": "sphere", "radius": 0.008, "friction": 0.5},
    "start": {"touch": {"at": [0.0005, 0], "clearance": 0.0002}},
    "motion": [
        {"name": "rest", "frames": 1, "hold": True},
        {"name": "press", "frames": 3, "by": {"position": [0, 0, -0.0006]}},
        {"name": "drag", "frames": 3, "load": {"normal": 0.6, "tangential": [0.1, 0]}},
        {"name": "stay", "frames": 2, "hold": True},
    ],
    "samples": 1,
    "seed": 3,
}


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory):
    """Makes the small scene with some keys changed."""

    def make(**changes: Any) -> Scene:
        path = tmp_path_factory.mktemp("scene") / "small.yaml"
        path.write_text(yaml.safe_dump(SMALL_SCENE | changes, sort_keys=False))
        return read_scene(path)

    return make
