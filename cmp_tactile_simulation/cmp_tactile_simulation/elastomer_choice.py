"""The elastomer that a sensor description asks for."""

from __future__ import annotations

from pathlib import Path

from cmp_tactile_processing.elastic_problem import Progress
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_simulation.elastomer import Elastomer
from cmp_tactile_simulation.linear_elastomer import LinearElastomer

__all__ = ["elastomer_of"]


def elastomer_of(
    sensor: SensorDescription,
    nodes: int = 40,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
) -> Elastomer:
    """The sensor's gel with its material model; arguments and errors as LinearElastomer."""
    return LinearElastomer(sensor, nodes, cache_dir, progress)
