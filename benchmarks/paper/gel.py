"""The contact of a scene, solved once and rendered with any print and camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.cache.files import atomic_path, locked
from cmp_tactile_processing.measured import ForceField, SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.recording.run import simulator_version
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Motion, Scene
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation, force_field
from paper.lab import Workplace

# What is kept of the true ForceField of each frame.
OF_FIELDS = ("contact", "wrench")
# Contact nodes of the quick run.
FAST_NODES = 24


@dataclass(frozen=True)
class Mechanics:
    """The gel in each of F frames; gel frame, m and N.

    observers: grid over the top of the gel on which `displacement` (F, rows, cols, 3) of the
    marker surface is known.  phase (F,): names of the motion's phases.  rate: frames/s.
    node_position (N, 3): contact nodes at rest; contact (F, N).  wrench (F, 6): as in ForceField.
    """

    observers: SurfaceGrid
    rate: float
    phase: NDArray[np.str_]
    displacement: NDArray[np.float64]
    node_position: NDArray[np.float64]
    contact: NDArray[np.bool_]
    wrench: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.displacement)

    def surface(self, frame: int, pattern: Pattern) -> DeformedSurface:
        """The marker surface in a frame, with any pattern on it."""
        return DeformedSurface(pattern, self.observers, self.displacement[frame])

    def frames(self, *phases: str) -> NDArray[np.intp]:
        """Indices of the frames of these phases."""
        return np.flatnonzero(np.isin(self.phase, phases))


def shortened(name: str, frames: Mapping[str, int | None], *, fast: bool) -> Scene:
    """A packaged scene with these phases alone, of so many frames; None: as many as it has.

    fast: on fewer contact nodes.
    """
    scene = load_scene(name)
    motion = tuple(
        replace(phase, frames=frames[phase.name] or phase.frames)
        for phase in scene.motion
        if phase.name in frames
    )
    return replace(scene, motion=motion, contact_nodes=FAST_NODES if fast else scene.contact_nodes)


def mechanics_of(scene: Scene, place: Workplace) -> Mechanics:
    """All frames of a scene's contact, from the workplace where they were solved before.

    What the scene says of print, camera and noise does not matter, nor the colours of the pattern.
    """
    path = place.folder / f"mechanics-{scene.name}-{_key(scene)}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.with_suffix(".lock")):
        if not path.exists():
            with threadpool_limits(1, "blas"):
                solved = _solved(scene)
            with atomic_path(path) as beside, beside.open("wb") as file:
                np.savez(file, allow_pickle=False, **solved)
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
    rows, cols = arrays["displacement"].shape[1:3]
    extent = arrays.pop("extent")
    observers = SurfaceGrid(rows, cols, (float(extent[0]), float(extent[1])))
    return Mechanics(observers, scene.rate, **arrays)


def _key(scene: Scene) -> str:
    """Of all that the contact depends on."""
    sensor = scene.sensor
    facts = (
        OF_FIELDS,
        simulator_version(),
        sensor.elastomer,
        sensor.pattern.surface,
        (sensor.pattern.rows, sensor.pattern.cols, sensor.pattern.pitch),
        scene.contact_nodes,
        scene.indenter,
        scene.start,
        scene.motion,
        scene.rate,
    )
    return str(joblib.hash(repr(facts)))


def _solved(scene: Scene) -> dict[str, Any]:
    simulation = Simulation(scene)
    motion = Motion(scene.motion)
    fields: list[ForceField] = []
    displacement, phases = [], []
    for state in simulation.states():
        displacement.append(simulation.elastomer.marker_displacement(state.contact.force))
        fields.append(force_field(simulation.contact, state.contact, scene.sensor))
        phases.append(motion.phase(state.frame).name)
    observers = simulation.elastomer.observers
    return {
        "extent": np.array(observers.extent),
        "phase": np.array(phases),
        "displacement": np.array(displacement),
        "node_position": simulation.elastomer.node_position,
        **{name: np.array([getattr(item, name) for item in fields]) for name in OF_FIELDS},
    }
