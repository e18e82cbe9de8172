"""A scene: what is simulated, from which sensor, over time.

docs/scenes.md lists the keys of its file; `cmp_tactile_simulation.scenes.reader` reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects

__all__ = [
    "EASINGS",
    "FIRST_STAMP_NS",
    "PATTERN_TYPES",
    "Goal",
    "Hold",
    "IndenterDescription",
    "MoveBy",
    "MoveTo",
    "Phase",
    "Press",
    "Release",
    "Scene",
    "Start",
    "Touch",
    "Vector",
]

EASINGS = ("smooth", "linear")
PATTERN_TYPES = ("cmp", "dmp")
# Recordings of the same scene are to be the same bytes, whenever they are made.
FIRST_STAMP_NS = 1_750_000_000 * 10**9

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Hold:
    """Stay where it is."""


@dataclass(frozen=True)
class MoveTo:
    """Move to a place in the gel frame; None keeps position or rotation.

    position m.  rotation_deg: turned about the gel's x, then y, then z axis, from the
    indenter's own axes.
    """

    position: Vector | None = None
    rotation_deg: Vector | None = None


@dataclass(frozen=True)
class MoveBy:
    """Move relative to where the phase begins.

    offset m, gel frame.  rotation_deg: turned about the gel's x, then y, then z direction
    through the indenter's origin.
    """

    offset: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Press:
    """Reach a load, from the one that the phase begins with."""

    load: Load


@dataclass(frozen=True)
class Touch:
    """Come to where the indenter, let down at (x, y), would touch the undeformed gel.

    at (x, y) m of the indenter's origin.  clearance m above that place.
    """

    at: tuple[float, float]
    clearance: float = 0.0


@dataclass(frozen=True)
class Release:
    """Move straight up until the undeformed gel is `clearance` (m) below the indenter."""

    clearance: float


Goal = Hold | MoveTo | MoveBy | Press | Touch | Release


@dataclass(frozen=True)
class Phase:
    """A part of the motion: `frames` frames, the last of which is at the goal.

    easing: smooth (starts and ends at rest) or linear.
    """

    name: str
    frames: int
    goal: Goal
    easing: str = "smooth"


@dataclass(frozen=True)
class Start:
    """Where the indenter is before the first frame: position (m), or above a place to touch."""

    place: Vector | Touch
    rotation_deg: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class IndenterDescription:
    """type: name of the shape.  friction: Coulomb's coefficient.  values: keys of that shape.

    file: of a mesh, absent for other shapes.
    """

    type: str
    friction: float
    values: Mapping[str, Any] = field(default_factory=dict)
    file: Path | None = None


@dataclass(frozen=True)
class Scene:
    """All that a simulation depends on.

    source: paper section or other origin.  note: how and why it departs from the source.
    sensor_mapping: the resolved sensor description as a file holds it.
    pattern_type: cmp (checkerboard) or dmp (dots).  contact_nodes: nodes along the
    longer side of the contact patch.  rate: frames/s.  defects: of the print.  samples: of a pixel
    along each direction.  file: that `load_scene` found it in; no output depends on it.
    """

    name: str
    title: str
    source: str
    note: str
    sensor: SensorDescription
    sensor_mapping: Mapping[str, Any]
    indenter: IndenterDescription
    start: Start
    motion: tuple[Phase, ...]
    pattern_type: str = "cmp"
    contact_nodes: int = 40
    rate: float = 30.0
    camera: CameraSettings = field(default_factory=CameraSettings)
    defects: PrintDefects = field(default_factory=PrintDefects)
    samples: int = 4
    seed: int = 0
    file: Path | None = field(default=None, compare=False)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return sum(phase.frames for phase in self.motion)

    def stamp_ns(self, frame: int) -> int:
        """Stamp of a frame, ns."""
        return FIRST_STAMP_NS + round(frame * 1e9 / self.rate)
