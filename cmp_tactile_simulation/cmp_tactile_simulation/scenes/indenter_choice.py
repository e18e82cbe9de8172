"""The indenter that a scene describes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np

from cmp_tactile_processing.sensor.yaml_section import YamlSection
from cmp_tactile_simulation.contact.state import Pose
from cmp_tactile_simulation.errors import IndenterError
from cmp_tactile_simulation.indenters.mesh import MeshIndenter
from cmp_tactile_simulation.indenters.shapes import (
    Cuboid,
    Cylinder,
    FlatProbe,
    HexagonalBar,
    Indenter,
    Ring,
    Sphere,
    SphereGroup,
)
from cmp_tactile_simulation.scenes.description import (
    IndenterDescription,
    MoveBy,
    MoveTo,
    Phase,
    Start,
)
from cmp_tactile_simulation.scenes.motion import turned

__all__ = ["INDENTERS", "MESH", "MESH_KEYS", "indenter_of", "read_indenter"]

MESH = "mesh"
MESH_KEYS = ("scale", "resolution", "edge_radius")
MAX_FRICTION = 10.0
# Of everything that presses on a gel.
SIDE_M = 1e-6, 0.2
DEFAULT_FRICTION = 0.6
# Of a mesh from its rotation at the start: more would show sides that its heights do not hold.
MAX_TILT_DEG = 30.0

INDENTERS: Mapping[str, Any] = {
    shape.name: shape
    for shape in (Sphere, Cylinder, FlatProbe, Cuboid, Ring, HexagonalBar, SphereGroup)
}


def read_indenter(
    section: YamlSection, folder: Path, start: Start, motion: Sequence[Phase]
) -> IndenterDescription:
    """The description of `indenter`; its keys are the fields of the shape.

    folder: of the scene file, which a mesh's path is relative to.
    Raises DescriptionError for wrong keys, for a shape that cannot be made of their values, and
    for a motion that tilts a mesh by more than MAX_TILT_DEG from the start.
    """
    kind = section.choice("type", (*INDENTERS, MESH))
    friction = DEFAULT_FRICTION
    if "friction" in section:
        friction = section.number("friction", 0.0, MAX_FRICTION)
    file = None
    if kind == MESH:
        file = folder / section.text("file")
        if not file.is_file():
            raise section.error("file", str(section.raw("file")), f"a file; there is no {file}")
        values = {key: section.positive(key) for key in MESH_KEYS if key in section}
    else:
        values = _read_values(section, INDENTERS[kind])
    section.finish()
    description = IndenterDescription(kind, friction, values, file)
    try:
        indenter = indenter_of(description, start)
    except IndenterError as error:
        raise section.error("", values or str(file), f"another indenter ({error})") from None
    if isinstance(indenter, MeshIndenter):
        _check_tilt(section, indenter, motion)
    return description


def indenter_of(description: IndenterDescription, start: Start) -> Indenter:
    """The indenter itself; IndenterError where it cannot be made.

    start: its rotation says which side of a mesh touches.
    """
    indenter: Indenter
    if description.file is not None:
        indenter = MeshIndenter.load(
            description.file, **description.values, rotation=turned(start.rotation_deg)
        )
    else:
        indenter = INDENTERS[description.type](**description.values)
    return indenter


def _check_tilt(section: YamlSection, mesh: MeshIndenter, motion: Sequence[Phase]) -> None:
    """Refuse a motion that tilts the mesh too far; its phases turn at a constant rate."""
    rotation = mesh.rotation
    for phase in motion:
        begin = Pose(rotation=rotation)
        if isinstance(phase.goal, MoveTo) and phase.goal.rotation_deg is not None:
            rotation = turned(phase.goal.rotation_deg)
        elif isinstance(phase.goal, MoveBy):
            rotation = turned(phase.goal.rotation_deg) @ rotation
        if np.array_equal(begin.rotation, rotation):
            continue
        way = [begin.towards(Pose(rotation=rotation), share) for share in np.linspace(0, 1, 37)]
        tilt = max(mesh.view_tilt_deg(pose.rotation) for pose in way)
        if tilt > MAX_TILT_DEG + 1e-6:
            raise section.error(
                "",
                f"a mesh that phase {phase.name!r} tilts by {tilt:.3g} degrees from the start",
                f"at most {MAX_TILT_DEG:g}: a mesh has only the side that faces the gel at the "
                "start; let `start.rotation_deg` turn it",
            )


def _read_values(section: YamlSection, shape: Any) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for item in fields(shape):
        if item.name not in section and item.default is not MISSING:
            continue
        if item.name == "centres":
            centres = section.raw("centres", "a list of points [x, y, z]")
            count = len(centres) if isinstance(centres, list) else 0
            values["centres"] = section.number_rows("centres", count, 3)
        elif item.name == "size":
            values["size"] = section.quantities("size", "m", (SIDE_M,) * 3)
        else:
            values[item.name] = section.quantity(item.name, "m", *SIDE_M)
    return values
