"""Contacts that the dot methods are tuned on: no experiment is judged by them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from cmp_tactile_simulation.scenes.description import (
    Hold,
    IndenterDescription,
    MoveBy,
    Phase,
    Scene,
    Start,
    Touch,
    Vector,
)
from cmp_tactile_simulation.scenes.library import load_scene

__all__ = ["TUNING_SEQUENCES", "tuning_scenes"]

NODES = 32
CLEARANCE = 0.0002
# Frames of the scenes that are looked at one after another, by how far the gel moves at once.
TUNING_SEQUENCES: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "slow": ("foot", tuple(range(10))),
    "twice": ("foot", (0, 1, 3, 5, 7, 9)),
    "fast": ("foot", (0, 1, 5, 7, 9)),
    "leap": ("foot", (0, 1, 5, 9)),
    "small jump": ("sphere", tuple(range(13))),
    "turn": ("cylinder", (0, 1, 3, 5, 8)),
}


def tuning_scenes() -> dict[str, Scene]:
    """Scenes by name, all of the same gel, with 18 x 18 markers as in section IV."""
    rest = Phase("rest", 2, Hold())
    return {
        "sphere": _scene(
            "dot_tuning_sphere",
            IndenterDescription("sphere", 0.8, {"radius": 0.004}),
            Start(Touch((0.0021, -0.0016), CLEARANCE)),
            (
                rest,
                _moved("press", 4, (0.0, 0.0, -0.0011)),
                _moved("drag", 5, (-0.0009, 0.0005, 0.0)),
                _moved("jump", 1, (0.0011, -0.0006, 0.0)),
                Phase("hold", 1, Hold()),
            ),
        ),
        "corner": _scene(
            "dot_tuning_corner",
            IndenterDescription(
                "cuboid", 0.6, {"size": (0.007, 0.007, 0.007), "edge_radius": 0.0004}
            ),
            Start(Touch((-0.0013, 0.0017), CLEARANCE), (45.0, 30.0, 20.0)),
            (rest, _moved("press", 4, (0.0, 0.0, -0.0010))),
        ),
        "cylinder": _scene(
            "dot_tuning_cylinder",
            IndenterDescription(
                "cylinder", 0.6, {"radius": 0.002, "length": 0.010, "edge_radius": 0.0004}
            ),
            Start(Touch((0.0005, 0.0009), CLEARANCE), (0.0, 12.0, 35.0)),
            (
                rest,
                _moved("press", 4, (0.0, 0.0, -0.0009)),
                _moved("turn", 3, (0.0, 0.0, 0.0), (0.0, 0.0, 12.0)),
            ),
        ),
        "foot": _scene(
            "dot_tuning_foot",
            IndenterDescription("sphere", 0.9, {"radius": 0.012}),
            Start(Touch((-0.0008, -0.0004), CLEARANCE)),
            (
                rest,
                _moved("press", 4, (0.0, 0.0, -0.0014)),
                _moved("drag", 4, (0.0010, 0.0012, 0.0)),
            ),
        ),
    }


def _scene(
    name: str, indenter: IndenterDescription, start: Start, motion: tuple[Phase, ...]
) -> Scene:
    return replace(
        load_scene("contact_sphere"),
        name=name,
        title=name,
        indenter=indenter,
        start=start,
        motion=motion,
        contact_nodes=NODES,
    )


def _moved(name: str, frames: int, offset: Vector, turn: Vector = (0.0, 0.0, 0.0)) -> Phase:
    return Phase(name, frames, MoveBy(offset, turn), "linear")
