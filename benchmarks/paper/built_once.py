"""Keeps two processes from building the same thing of the disk cache at the same time."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

from cmp_tactile_processing.cache.file_lock import FileLock
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.simulation import Simulation
from paper.experiment import Busy, Workplace

__all__ = ["alone", "build_force_model", "simulation_of"]


def simulation_of(scene: Scene, place: Workplace) -> Simulation:
    """The simulation of a scene, its gel built by one process alone.

    Raises Busy where another process builds one of that mesh and the workplace is not patient.
    """
    pattern = scene.sensor.pattern
    mesh = scene.sensor.elastomer.size, pattern.surface, pattern.rows, pattern.cols, pattern.pitch
    with alone(place, _named("gel", (*mesh, scene.contact_nodes))):
        return Simulation(scene)


def build_force_model(sensor: SensorDescription, place: Workplace) -> None:
    """Have the sensor's force model in the cache; raises Busy as above."""
    with alone(place, _named("force", (sensor.elastomer, sensor.pattern))):
        ForceStage(sensor)


@contextmanager
def alone(place: Workplace, what: str) -> Iterator[None]:
    """No other process is at this meanwhile; what: becomes the name of a lock in the workplace.

    Raises Busy where one is and the workplace is not patient.
    """
    place.folder.mkdir(parents=True, exist_ok=True)
    with FileLock(place.folder / f"{what}.lock") as lock:
        if not lock.acquire(wait=place.patient):
            msg = f"{what} is being solved by another process"
            raise Busy(msg)
        yield


def _named(what: str, key: tuple[object, ...]) -> str:
    return f"{what}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"
