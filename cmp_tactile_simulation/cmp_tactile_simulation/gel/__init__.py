"""The gel under contact: linear, neo-Hookean, relaxing.

In: `SensorDescription`, tractions on the contact nodes.
Out: displacements of contact nodes and markers.
"""

from __future__ import annotations

from pathlib import Path

from cmp_tactile_processing.elastic.model import Progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.gel.linear import (
    NODES_RANGE,
    ContactProblem,
    LinearElastomer,
    RelaxingElastomer,
    contact_nodes,
    observers,
)
from cmp_tactile_simulation.gel.neo_hookean import NeoHookeanElastomer

__all__ = [
    "NODES_RANGE",
    "ContactProblem",
    "Elastomer",
    "LinearElastomer",
    "NeoHookeanElastomer",
    "contact_nodes",
    "elastomer_of",
    "observers",
]

_MODELS: dict[str, type[LinearElastomer]] = {
    "linear": LinearElastomer,
    "neo_hookean": NeoHookeanElastomer,
}

# What the contact solver and the renderer load and observe.
Elastomer = LinearElastomer | RelaxingElastomer


def elastomer_of(
    sensor: SensorDescription,
    nodes: int = 40,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
) -> Elastomer:
    """The gel of a sensor: the material that `elastomer.model` names, with `elastomer.relaxation`.

    nodes: contact nodes along the longer side of the contact patch.
    cache_dir, progress: where the compliance is kept, and who hears how far it is built.
    Raises what the elastomer itself raises.
    """
    elastic = _MODELS[sensor.elastomer.model](sensor, nodes, cache_dir, progress)
    relaxation = sensor.elastomer.relaxation
    return elastic if relaxation is None else RelaxingElastomer(elastic, relaxation)
