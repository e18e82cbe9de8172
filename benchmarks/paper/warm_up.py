"""Runs once what is to be compiled for the cases, on a coarse gel."""

from __future__ import annotations

from dataclasses import replace

from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.contact.laws import Load
from cmp_tactile_simulation.scenes.description import Hold, Phase, Press, Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import CMP, CMP_PAPER, Chain
from paper.dot_tracking import FOLLOWING_METHODS
from paper.experiment import Workplace
from paper.gel import mechanics_of
from paper.sequence import PrintedGel

# Contact nodes, and what they are pressed by, N: every size runs the same code.
NODES = 9
LOAD = Load(1.0, (0.3, 0.0), 0.0)


def _scene() -> Scene:
    motion = (Phase("rest", 1, Hold()), Phase("press", 2, Press(LOAD)))
    scene = load_scene("contact_sphere")
    return replace(scene, name="compile_ahead", contact_nodes=NODES, motion=motion)


def compile_checkers(_place: Workplace) -> None:
    """What corners and virtual markers need: trackers compile it when they are made."""
    scene = _scene()
    for method in (CMP, CMP_PAPER):
        Chain(scene.sensor, method)
    pattern = scene.sensor.pattern
    grid = grid_over(pattern.shape, pattern.pitch, pattern.pitch)
    SurfaceInterpolator(pattern.shape, pattern.pitch, grid)


def compile_dots(place: Workplace) -> None:
    """Press the gel, render it, and measure it with the methods for dots."""
    scene = _scene()
    mechanics = mechanics_of(scene, place)
    PrintedGel(scene.sensor, "cmp").image(mechanics.surface(0, scene.sensor.pattern), 0)
    gel = PrintedGel(scene.sensor, "dmp")
    surfaces = [mechanics.surface(frame, scene.sensor.pattern) for frame in range(len(mechanics))]
    images = [gel.image(surface, frame) for frame, surface in enumerate(surfaces)]
    gel.truth(surfaces[-1])
    for method in FOLLOWING_METHODS:
        if method.pattern_type == "dmp":
            chain = Chain(scene.sensor, method)
            chain.set_reference(images[:1])
            for image in images:
                chain.measure(image)
