"""Simulator of vision-based tactile sensors: elastomer, contact, mirror optics, camera.

>>> simulator = Simulator("sample_rig", Sphere(4e-3), friction=0.6, seed=1)
>>> frame = simulator.press(depth=5e-4, shear=(1e-4, 0.0))
>>> frame.image, frame.truth.displacement, frame.truth.wrench
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cmp_tactile_processing  # noqa: F401  # chooses the folder of compiled functions

# As the processing core does.
__path__[:] = [str(Path(folder).resolve()) for folder in __path__]

if TYPE_CHECKING:
    from cmp_tactile_simulation.contact.laws import Load, Pose
    from cmp_tactile_simulation.indenter_shapes import (
        Cuboid,
        Cylinder,
        FlatProbe,
        HexagonalBar,
        Ring,
        Sphere,
        SphereGroup,
    )
    from cmp_tactile_simulation.rendering.camera import CameraSettings
    from cmp_tactile_simulation.rendering.ink import PrintDefects
    from cmp_tactile_simulation.simulator import Look, SimulatedFrame, Simulator, Truth

__all__ = [
    "CameraSettings",
    "Cuboid",
    "Cylinder",
    "FlatProbe",
    "HexagonalBar",
    "Load",
    "Look",
    "Pose",
    "PrintDefects",
    "Ring",
    "SimulatedFrame",
    "Simulator",
    "Sphere",
    "SphereGroup",
    "Truth",
]

# Imported with the first use of the name, as those of the processing core.
ROOMS = {
    "contact.laws": ("Load", "Pose"),
    "rendering.camera": ("CameraSettings",),
    "rendering.ink": ("PrintDefects",),
    "simulator": ("Look", "SimulatedFrame", "Simulator", "Truth"),
}
SHAPES = "indenter_shapes"


def __getattr__(name: str) -> Any:
    if name not in __all__:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    room = next((room for room, names in ROOMS.items() if name in names), SHAPES)
    value = getattr(import_module(f"{__name__}.{room}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
