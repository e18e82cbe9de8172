"""Compiles what the cases run, before several processes would do it at the same time.

A process that has just compiled functions may run other copies of them than those that it keeps,
with other last digits: so it is left to a process of its own, `python3 -m paper.compile_ahead`.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import cmp_tactile_simulation  # noqa: F401  chooses the folder of what is compiled
from cmp_tactile_bringup.machine import processor_name
from cmp_tactile_processing.dense_surface import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.contact_state import Load
from cmp_tactile_simulation.scene import Hold, Phase, Press, Scene
from cmp_tactile_simulation.scene_library import load_scene
from cmp_tactile_simulation.source_version import simulator_version
from paper.chain import Chain
from paper.crew import single_threaded
from paper.dot_methods import ALL_METHODS
from paper.experiment import Workplace
from paper.film import Film
from paper.mechanics import mechanics_of

__all__ = ["compile_ahead", "main"]

# Contact nodes, and what they are pressed by, N: every size runs the same code.
NODES = 9
LOAD = Load(1.0, (0.3, 0.0), 0.0)


def compile_ahead(place: Workplace) -> str:
    """Have it done by another process, if it is not yet; an error in words, or nothing."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    told = (simulator_version(), sys.version, processor_name(), version("numba"))
    done = folder / f"paper-{hashlib.sha256(repr(told).encode()).hexdigest()[:16]}"
    if done.exists():
        return ""
    command = [sys.executable, "-m", __name__, str(place.folder)]
    environment = {**os.environ, **single_threaded()}
    found = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if found.returncode:
        return found.stderr[-2000:]
    if folder.is_dir() and os.access(folder, os.W_OK):
        done.touch()
    return ""


def _short(scene: Scene) -> Scene:
    motion = (Phase("rest", 1, Hold()), Phase("press", 2, Press(LOAD)))
    return replace(scene, name="compile_ahead", contact_nodes=NODES, motion=motion)


def main() -> None:
    """Press a coarse gel and measure it with every method."""
    place = Workplace(Path(sys.argv[1]))
    scene = _short(load_scene("contact_sphere"))
    mechanics = mechanics_of(scene, place)
    for method in ALL_METHODS:
        film = Film(scene.sensor, method.pattern_type)
        images = [
            film.image(mechanics.surface(frame, scene.sensor.pattern), frame)
            for frame in range(len(mechanics))
        ]
        chain = Chain(scene.sensor, method)
        chain.set_reference(images[:1])
        pattern = scene.sensor.pattern
        dense = SurfaceInterpolator(
            pattern.shape, pattern.pitch, grid_over(pattern.shape, pattern.pitch, pattern.pitch)
        )
        for image in images:
            dense.interpolate(chain.measure(image).surface)


if __name__ == "__main__":
    main()
