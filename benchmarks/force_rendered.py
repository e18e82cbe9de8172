"""Force end to end: from frames of the simulated camera, through the whole pipeline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.scenes.description import (
    Hold,
    IndenterDescription,
    Phase,
    Press,
    Scene,
    Start,
    Touch,
)
from cmp_tactile_simulation.scenes.library import load_scene
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame, Simulation

REST_FRAMES, HELD_FRAMES = 8, 2
RENDERED_LOADS = (0.5, 1.0, 2.0, 5.0)
SHARE, NEWTON = 0.03, 0.02


@dataclass(frozen=True)
class RenderedContact:
    """An indenter, where it is let down, m, and its tangential force as a share of the normal."""

    name: str
    type: str
    values: Mapping[str, Any]
    at: tuple[float, float] = (0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)


RENDERED = (
    RenderedContact("sphere", "sphere", {"radius": 8e-3}, (0.4e-3, -0.3e-3)),
    RenderedContact(
        "edge", "cylinder", {"radius": 2e-3, "length": 8e-3, "edge_radius": 1e-3},
        rotation_deg=(0.0, 0.0, 20.0),
    ),
    RenderedContact("ring", "ring", {"radius": 3.2e-3, "tube_radius": 1e-3}),
    RenderedContact(
        "off centre", "sphere", {"radius": 6e-3}, (2e-3, -1.4e-3), tangential=(0.1, -0.1)
    ),
    RenderedContact("shear", "sphere", {"radius": 8e-3}, tangential=(0.3, 0.1)),
)  # fmt: skip


@dataclass(frozen=True)
class RenderedError:
    """Of one contact at one load, largest over its frames: errors, N and N m; std of Fz, N."""

    name: str
    newton: float
    fz: float
    ft: float
    torque: float
    fz_std: float

    @property
    def limit(self) -> float:
        """What the error of Fz must not exceed, N."""
        return SHARE * self.newton + NEWTON


def rendered_errors(sensor: SensorDescription, quick: bool = False) -> Iterator[RenderedError]:
    """Errors of every contact and load."""
    for contact in RENDERED[: 1 if quick else None]:
        pipeline = Pipeline(sensor)
        simulation = Simulation(_scene(sensor, contact))
        rest, held = [], []
        for frame in simulation.frames():
            if frame.phase == "rest":
                rest.append(frame.image)
                if len(rest) == REST_FRAMES:
                    pipeline.set_reference(rest)
                continue
            held.append(_error(pipeline, frame))
            if len(held) == HELD_FRAMES:
                yield _largest(contact.name, held)
                held = []


def _scene(sensor: SensorDescription, contact: RenderedContact) -> Scene:
    x, y = contact.tangential
    steps = tuple(
        Phase(f"{load:g} N", HELD_FRAMES, Press(Load(load, (x * load, y * load))))
        for load in RENDERED_LOADS
    )
    phases = []
    for step in steps:
        # The load is reached in the first frame and held in those that follow.
        phases += [replace(step, frames=1), Phase(step.name, HELD_FRAMES - 1, Hold())]
    return replace(
        load_scene("contact_sphere"),
        name=f"force_{contact.name}",
        sensor=sensor,
        indenter=IndenterDescription(contact.type, 0.6, contact.values),
        start=Start(Touch(contact.at, 0.3e-3), contact.rotation_deg),
        motion=(Phase("rest", REST_FRAMES, Hold()), *phases),
    )


def _error(pipeline: Pipeline, frame: SimulatedFrame) -> tuple[float, ...]:
    found = pipeline.process(frame.image).force
    off = found.wrench - frame.force.wrench
    return (
        float(-frame.force.wrench[2]),
        float(abs(off[2])),
        float(np.linalg.norm(off[:2])),
        float(np.linalg.norm(off[3:])),
        float(found.wrench_std[2]),
    )


def _largest(name: str, held: list[tuple[float, ...]]) -> RenderedError:
    return RenderedError(name, *(float(value) for value in np.max(held, axis=0)))
