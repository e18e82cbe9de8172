"""A scene: what is simulated, from which sensor, over time.

docs/scenes.md lists the keys of its file; `cmp_tactile_simulation.scenes.file` reads and writes it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.fields import choice, number, part, read_by, text, whole
from cmp_tactile_processing.sensor.yaml_section import YamlSection, meant
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.gel.contact_problem import NODES_RANGE
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects

__all__ = [
    "FIRST_STAMP_NS",
    "NAME",
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
    "read_name",
    "read_place",
    "read_rotation",
]

MAX_REACH_M = 0.2
MAX_SAMPLES = 8
# At the lowest rate the stamps of a longest scene fit the 32 bits of a message.
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1000.0
MAX_SEED = 2**32 - 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
NOWHERE = (0.0, 0.0, 0.0)
# Recordings of the same scene are to be the same bytes, whenever they are made.
FIRST_STAMP_NS = 1_750_000_000 * 10**9

Vector = tuple[float, float, float]


def read_name(section: YamlSection, key: str) -> str:
    """A name that files may bear."""
    name = section.text(key)
    if not NAME.fullmatch(name):
        raise section.error(key, name, "letters, digits, '_', '.' and '-', for a file name")
    return name


def read_place(section: YamlSection, key: str, count: int = 3) -> tuple[float, ...]:
    """A place or a way of so many coordinates, none of which is out of reach, m."""
    place = section.numbers(key, count)
    if max(abs(value) for value in place) > MAX_REACH_M:
        hint = meant(place, "m", -MAX_REACH_M, MAX_REACH_M)
        raise section.error(key, list(place), f"m, each at most {MAX_REACH_M:g}{hint}")
    return place


def read_rotation(section: YamlSection, key: str = "rotation_deg") -> tuple[float, ...]:
    """Turns about x, then y, then z, degrees."""
    return section.numbers(key, 3)


def _read_turn(section: YamlSection, key: str) -> tuple[float, ...]:
    """A turn of less than half a revolution, beyond which the way there is not defined."""
    turn = read_rotation(section, key)
    if sum(angle**2 for angle in turn) >= 180.0**2:
        raise section.error(key, list(turn), "a turn of less than 180 degrees a phase")
    return turn


def _read_point(section: YamlSection, key: str) -> tuple[float, ...]:
    return read_place(section, key, 2)


@dataclass(frozen=True)
class Hold:
    """Stay where it is."""


@dataclass(frozen=True)
class MoveTo:
    """Move to a place in the gel frame; None keeps position or rotation.

    position m.  rotation_deg: turned about the gel's x, then y, then z axis, from the
    indenter's own axes.
    """

    position: Vector | None = field(default=None, metadata=read_by(read_place))
    rotation_deg: Vector | None = field(default=None, metadata=read_by(read_rotation))


@dataclass(frozen=True)
class MoveBy:
    """Move relative to where the phase begins.

    offset m, gel frame.  rotation_deg: turned about the gel's x, then y, then z direction
    through the indenter's origin.
    """

    offset: Vector = field(default=NOWHERE, metadata=read_by(read_place, "position"))
    rotation_deg: Vector = field(default=NOWHERE, metadata=read_by(_read_turn))


@dataclass(frozen=True)
class Press:
    """Reach a load, from the one that the phase begins with."""

    load: Load


@dataclass(frozen=True)
class Touch:
    """Come to where the indenter, let down at (x, y), would touch the undeformed gel.

    at (x, y) m of the indenter's origin.  clearance m above that place.
    """

    at: tuple[float, float] = field(metadata=read_by(_read_point))
    clearance: float = field(default=0.0, metadata=number(0.0, MAX_REACH_M, "m"))


@dataclass(frozen=True)
class Release:
    """Move straight up until the undeformed gel is `clearance` (m) below the indenter."""

    clearance: float = field(metadata=number(0.0, MAX_REACH_M, "m", key="release"))


Goal = Hold | MoveTo | MoveBy | Press | Touch | Release


@dataclass(frozen=True)
class Phase:
    """A part of the motion: `frames` frames, the last of which is at the goal.

    easing: smooth (starts and ends at rest) or linear.
    """

    name: str = field(metadata=text())
    frames: int
    goal: Goal
    easing: str = field(default="smooth", metadata=choice("smooth", "linear"))


@dataclass(frozen=True)
class Start:
    """Where the indenter is before the first frame: position (m), or above a place to touch."""

    place: Vector | Touch
    rotation_deg: Vector = field(default=NOWHERE, metadata=read_by(read_rotation))


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

    name: str = field(metadata=read_by(read_name))
    title: str = field(metadata=text())
    source: str = field(metadata=text())
    note: str = field(metadata=text())
    sensor: SensorDescription
    sensor_mapping: Mapping[str, Any]
    indenter: IndenterDescription
    start: Start
    motion: tuple[Phase, ...]
    pattern_type: str = field(default="cmp", metadata=choice("cmp", "dmp"))
    contact_nodes: int = field(default=40, metadata=whole(*NODES_RANGE))
    rate: float = field(default=30.0, metadata=number(MIN_RATE_HZ, MAX_RATE_HZ))
    camera: CameraSettings = field(default_factory=CameraSettings, metadata=part(CameraSettings))
    defects: PrintDefects = field(
        default_factory=PrintDefects, metadata=part(PrintDefects, key="print")
    )
    samples: int = field(default=4, metadata=whole(1, MAX_SAMPLES))
    seed: int = field(default=0, metadata=whole(0, MAX_SEED))
    file: Path | None = field(default=None, compare=False)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return sum(phase.frames for phase in self.motion)

    def stamp_ns(self, frame: int) -> int:
        """Stamp of a frame, ns."""
        return FIRST_STAMP_NS + round(frame * 1e9 / self.rate)
