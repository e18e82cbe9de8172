"""What a scene's contact does to the gel, solved once and filmed with any print and camera."""

from __future__ import annotations

import hashlib
import logging
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.measured.force_field import ForceField
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.recording.output_folder import simulator_version
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.motion import Motion
from cmp_tactile_simulation.scenes.simulation import force_field
from paper.built_once import alone, simulation_of
from paper.experiment import Workplace

__all__ = ["Mechanics", "mechanics_of"]

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Mechanics:
    """The gel in each of F frames; gel frame, m and N.

    observers: grid over the top of the gel on which `displacement` (F, rows, cols, 3) of the
    marker surface is known.  phase (F,): names of the motion's phases.  rate: frames/s.
    node_position (N, 3): contact nodes at rest; force (F, N, 3) on the gel and contact (F, N).
    wrench (F, 6), contact_area (F,), centre_of_pressure (F, 3): as in ForceField.
    pose_position (F, 3), pose_rotation (F, 3, 3): T_gel_indenter.
    """

    observers: SurfaceGrid
    rate: float
    phase: NDArray[np.str_]
    displacement: NDArray[np.float64]
    node_position: NDArray[np.float64]
    force: NDArray[np.float64]
    contact: NDArray[np.bool_]
    wrench: NDArray[np.float64]
    contact_area: NDArray[np.float64]
    centre_of_pressure: NDArray[np.float64]
    pose_position: NDArray[np.float64]
    pose_rotation: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.displacement)

    def surface(self, frame: int, pattern: Pattern) -> DeformedSurface:
        """The marker surface in a frame, with any pattern on it."""
        return DeformedSurface(pattern, self.observers, self.displacement[frame])

    def frames(self, *phases: str) -> NDArray[np.intp]:
        """Indices of the frames of these phases."""
        return np.flatnonzero(np.isin(self.phase, phases))


def mechanics_of(scene: Scene, place: Workplace) -> Mechanics:
    """All frames of a scene's contact, from the workplace where they were solved before.

    What the scene says of print, camera and noise does not matter, nor the colours of the pattern.
    Raises Busy where another process is solving it, or building its gel, and the workplace is not
    patient.
    """
    path = place.folder / f"mechanics-{scene.name}-{_key(scene)}.npz"
    with alone(place, path.stem):
        arrays = _kept(path)
        if arrays is None:
            with threadpool_limits(1, "blas"):
                arrays = _solved(scene, place)
            partial = path.with_suffix(".partial.npz")
            np.savez(partial, **arrays)
            partial.replace(path)
    rows, cols = arrays["displacement"].shape[1:3]
    extent = arrays.pop("extent")
    observers = SurfaceGrid(rows, cols, (float(extent[0]), float(extent[1])))
    return Mechanics(observers, scene.rate, **arrays)


def _kept(path: Path) -> dict[str, Any] | None:
    """What was solved before; None where there is nothing, or nothing that can be read."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used, is solved anew: %s", path, error)
        return None


def _key(scene: Scene) -> str:
    """Of all that the contact depends on."""
    sensor = scene.sensor
    told = (
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
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def _solved(scene: Scene, place: Workplace) -> dict[str, Any]:
    simulation = simulation_of(scene, place)
    motion = Motion(scene.motion)
    fields_of: list[ForceField] = []
    displacement, poses, phases = [], [], []
    for state in simulation.states():
        displacement.append(simulation.elastomer.marker_displacement(state.contact.force))
        fields_of.append(force_field(simulation.contact, state.contact, scene.sensor))
        poses.append(state.contact.pose)
        phases.append(motion.phase(state.frame).name)
    observers = simulation.elastomer.observers
    return {
        "extent": np.array(observers.extent),
        "phase": np.array(phases),
        "displacement": np.array(displacement),
        "node_position": simulation.elastomer.node_position,
        **_stacked(fields_of, ("force", "contact", "wrench", "contact_area", "centre_of_pressure")),
        "pose_position": np.array([pose.position for pose in poses]),
        "pose_rotation": np.array([pose.rotation for pose in poses]),
    }


def _stacked(items: Sequence[ForceField], names: Sequence[str]) -> dict[str, NDArray[np.generic]]:
    assert set(names) <= {field.name for field in fields(ForceField)}  # noqa: S101
    return {name: np.array([getattr(item, name) for item in items]) for name in names}
