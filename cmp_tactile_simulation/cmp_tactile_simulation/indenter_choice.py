"""The indenter that a scene describes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from cmp_tactile_processing.yaml_section import YamlSection
from cmp_tactile_simulation.errors import IndenterError
from cmp_tactile_simulation.indenter import Indenter
from cmp_tactile_simulation.mesh_indenter import MeshIndenter
from cmp_tactile_simulation.scene import IndenterDescription
from cmp_tactile_simulation.shapes import (
    Cuboid,
    Cylinder,
    FlatProbe,
    HexagonalBar,
    Ring,
    Sphere,
    SphereGroup,
)

__all__ = ["INDENTERS", "MESH", "MESH_KEYS", "indenter_of", "read_indenter"]

MESH = "mesh"
MESH_KEYS = ("scale", "resolution", "edge_radius")
MAX_FRICTION = 10.0
DEFAULT_FRICTION = 0.6

INDENTERS: Mapping[str, Any] = {
    shape.name: shape
    for shape in (Sphere, Cylinder, FlatProbe, Cuboid, Ring, HexagonalBar, SphereGroup)
}


def read_indenter(section: YamlSection, folder: Path) -> IndenterDescription:
    """The description of `indenter`, whose keys are the fields of the shape.

    folder: of the scene file, which a mesh's path is relative to.
    Raises DescriptionError for wrong keys and for a shape that cannot be made of their values.
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
        indenter_of(description)
    except IndenterError as error:
        raise section.error("", values or str(file), f"another indenter ({error})") from None
    return description


def indenter_of(description: IndenterDescription) -> Indenter:
    """The indenter itself; IndenterError where it cannot be made."""
    indenter: Indenter
    if description.file is not None:
        indenter = MeshIndenter.load(description.file, **description.values)
    else:
        indenter = INDENTERS[description.type](**description.values)
    return indenter


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
            values["size"] = section.numbers("size", 3)
        else:
            values[item.name] = section.positive(item.name)
    return values
