"""The grasp of a hexagonal wrench (V.D) and the slow stroke that knocks are cut from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Scene
from cmp_tactile_simulation.scenes.library import load_scene
from paper.experiment import Workplace

__all__ = ["DIRECTIONS", "Direction", "grasp_scene", "sensor", "stroke_scene"]

# The quick run's phases last so many frames where the scene's last longer.
FAST_FRAMES = {"rest": 2, "close": 6, "hold": 3, "open": 6, "rest again": 2}
FAST_NODES = 28
# Of the bar from the middle to either end of the stroke, m: the gel under it moves 1.5 pitches.
HALF_STROKE = 0.00115
PRESS = 0.0011
STROKE_FRAMES = 60


@dataclass(frozen=True)
class Direction:
    """In which the bar moves, (x, y) of length 1 in the gel frame."""

    name: str
    x: float
    y: float


DIRECTIONS = (
    Direction("along", 1.0, 0.0),
    Direction("across", 0.0, 1.0),
    Direction("diagonal", 0.5**0.5, 0.5**0.5),
)


def sensor() -> SensorDescription:
    """That of the paper's section V.  Its gel is that of the scene's sensor."""
    return load_sensor("prototype")


def grasp_scene(place: Workplace) -> Scene:
    """The packaged scene on the prototype; the quick run has fewer frames of what is slow."""
    scene = replace(load_scene("grasp"), sensor=sensor())
    if not place.fast:
        return scene
    motion = tuple(
        replace(phase, frames=min(phase.frames, FAST_FRAMES.get(phase.name, phase.frames)))
        for phase in scene.motion
    )
    return replace(scene, motion=motion, contact_nodes=FAST_NODES)


def stroke_scene(place: Workplace, direction: Direction) -> Scene:
    """The same bar, pressed in and pushed slowly from one side to the other."""
    out = -HALF_STROKE * direction.x, -HALF_STROKE * direction.y, 0.0
    back = -2 * out[0], -2 * out[1], 0.0
    scene = grasp_scene(place)
    motion = (
        Phase("rest", 1, Hold()),
        Phase("close", 7, MoveBy((0.0, 0.0, -PRESS))),
        Phase("drag", 5, MoveBy(out)),
        Phase("stroke", STROKE_FRAMES, MoveBy(back), "linear"),
    )
    return replace(scene, name=f"stroke_{direction.name}", motion=motion)
