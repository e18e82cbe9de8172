"""The held object as it is drawn: its mesh, and the marker with which viewers show it."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from cmp_tactile_processing.ros.messages.making import MessageMaker
from cmp_tactile_simulation.grasp.scene import GraspScene

OBJECT_FRAME = "object"
# Red, green, blue.
OBJECT_COLOUR = (90, 170, 120)


def object_mesh(scene: GraspScene) -> Any:
    """The object's surface in its own frame, m: a mesh of trimesh."""
    kind, values = scene.object.type, scene.object.values
    mesh: Any
    if scene.object.file is not None:
        mesh = trimesh.load_mesh(scene.object.file)
        mesh.apply_scale(values.get("scale") or 1.0)
    elif kind == "cuboid":
        mesh = trimesh.creation.box(values["size"])
    elif kind == "sphere":
        mesh = trimesh.creation.icosphere(3, values["radius"])
    else:
        mesh = trimesh.creation.cylinder(values["radius"], values["length"], sections=48)
        mesh.vertices = mesh.vertices[:, [2, 1, 0]]
        mesh.invert()
    return mesh


def object_marker(make: MessageMaker, scene: GraspScene) -> Any:
    """A visualization_msgs/Marker of the object, which moves with OBJECT_FRAME."""
    triangles = np.asarray(object_mesh(scene).triangles, np.float64)
    # Without a stamp, viewers take the newest transform.
    return make.triangles(triangles, OBJECT_COLOUR, make.header(0, OBJECT_FRAME))
