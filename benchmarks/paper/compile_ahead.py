"""Compiles what the cases run, before several processes would do it at the same time.

A process that has just compiled functions may run other copies of them than those that it keeps,
with other last digits: so it is left to processes of its own, `python3 -m paper.compile_ahead`.
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
from cmp_tactile_bringup.offline.single_threaded_process import single_threaded
from cmp_tactile_bringup.terminal.machine import processor_name
from cmp_tactile_processing.python_command import python_command
from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.recording.output_folder import simulator_version
from cmp_tactile_simulation.scenes.description import Hold, Phase, Press, Scene
from cmp_tactile_simulation.scenes.library import load_scene
from paper.chain import Chain
from paper.dot_methods import FOLLOWING_METHODS
from paper.experiment import Workplace
from paper.film import Film
from paper.mechanics import mechanics_of
from paper.method import CMP, CMP_PAPER

__all__ = ["compile_ahead", "main"]

# Compiled side by side: checkers, and dots with all that simulates.
PARTS = ("checkers", "rest")
# Contact nodes, and what they are pressed by, N: every size runs the same code.
NODES = 9
LOAD = Load(1.0, (0.3, 0.0), 0.0)


def compile_ahead(place: Workplace) -> str:
    """Have it done by other processes, if it is not yet; an error in words, or nothing."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    told = (simulator_version(), sys.version, processor_name(), version("numba"))
    done = folder / f"paper-{hashlib.sha256(repr(told).encode()).hexdigest()[:16]}"
    if done.exists():
        return ""
    command = python_command(__name__, str(place.folder))
    environment = {**os.environ, **single_threaded()}
    processes = [
        subprocess.Popen([*command, part], stderr=subprocess.PIPE, text=True, env=environment)
        for part in PARTS
    ]
    errors = [process.communicate()[1] for process in processes]
    if any(process.returncode for process in processes):
        return "\n".join(errors)[-2000:]
    if folder.is_dir() and os.access(folder, os.W_OK):
        done.touch()
    return ""


def _short(scene: Scene) -> Scene:
    motion = (Phase("rest", 1, Hold()), Phase("press", 2, Press(LOAD)))
    return replace(scene, name="compile_ahead", contact_nodes=NODES, motion=motion)


def _compile_checkers(scene: Scene) -> None:
    """What corners and virtual markers need: trackers compile it when they are made."""
    for method in (CMP, CMP_PAPER):
        Chain(scene.sensor, method)
    pattern = scene.sensor.pattern
    grid = grid_over(pattern.shape, pattern.pitch, pattern.pitch)
    SurfaceInterpolator(pattern.shape, pattern.pitch, grid)


def _compile_the_rest(scene: Scene, place: Workplace) -> None:
    """Press a coarse gel, film it, and measure it with the methods for dots."""
    mechanics = mechanics_of(scene, place)
    Film(scene.sensor, "cmp").image(mechanics.surface(0, scene.sensor.pattern), 0)
    film = Film(scene.sensor, "dmp")
    surfaces = [mechanics.surface(frame, scene.sensor.pattern) for frame in range(len(mechanics))]
    images = [film.image(surface, frame) for frame, surface in enumerate(surfaces)]
    film.truth(surfaces[-1])
    for method in FOLLOWING_METHODS:
        if method.pattern_type == "dmp":
            chain = Chain(scene.sensor, method)
            chain.set_reference(images[:1])
            for image in images:
                chain.measure(image)


def main() -> None:
    """Compile one of PARTS."""
    place, part = Workplace(Path(sys.argv[1])), sys.argv[2]
    scene = _short(load_scene("contact_sphere"))
    if part == "checkers":
        _compile_checkers(scene)
    else:
        _compile_the_rest(scene, place)


if __name__ == "__main__":
    main()
