"""A scene: what is simulated, from which sensor, with which indenter, over time.

docs/scenes.md lists the keys of its file; `cmp_tactile_simulation.scenes.file` reads and writes it.
`Motion` says where the indenter is to be, or what it is to press with, in each frame.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.yaml_section import (
    YamlSection,
    choice,
    meant,
    number,
    part,
    read_by,
    text,
    whole,
)
from cmp_tactile_simulation import indenter_shapes, indenters
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.gel import NODES_RANGE
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects

MAX_REACH_M = 0.2
MAX_SAMPLES = 8
# At the lowest rate the stamps of a longest scene fit the 32 bits of a message.
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1000.0
MAX_SEED = 2**32 - 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
NOWHERE = (0.0, 0.0, 0.0)
# Recordings of the same scene are to be the same bytes, whenever they are made.
FIRST_STAMP_NS = 1_750_000_000 * NS_PER_S

Vector = tuple[float, float, float]

MESH = "mesh"
MESH_KEYS = ("scale", "edge_radius")
MAX_FRICTION = 10.0
# Of everything that presses on a gel.
SIDE_M = 1e-6, 0.2
DEFAULT_FRICTION = 0.6


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
        raise section.error(key, list(turn), "a rotation of less than 180 degrees in a phase")
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
    sensor: SensorDescription
    sensor_mapping: Mapping[str, Any]
    indenter: IndenterDescription
    start: Start
    motion: tuple[Phase, ...]
    title: str = field(default="", metadata=text())
    source: str = field(default="", metadata=text())
    note: str = field(default="", metadata=text())
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


@dataclass(frozen=True)
class PhaseStart:
    """Pose and load at the beginning of a phase; what it reaches for is interpolated from them."""

    pose: Pose
    load: Load


class Motion:
    """The phases of a scene on the axis of frames."""

    def __init__(self, phases: Sequence[Phase]) -> None:
        self._phases = tuple(phases)
        self._ends = list(accumulate(phase.frames for phase in phases))

    def phase(self, frame: int) -> Phase:
        """The phase that a frame belongs to."""
        return self._phases[bisect_right(self._ends, frame)]

    def begins_phase(self, frame: int) -> bool:
        """Whether a frame is the first of its phase."""
        return frame == 0 or frame in self._ends

    def share(self, frame: int) -> float:
        """How far towards the phase's goal a frame is, 0 to 1; the last frame is there."""
        phase = self.phase(frame)
        last = self._ends[bisect_right(self._ends, frame)]
        share = 1.0 - (last - 1 - frame) / phase.frames
        return share if phase.easing == "linear" else share * share * (3.0 - 2.0 * share)


def turned(rotation_deg: Vector) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of turns about the fixed x, then y, then z direction, degrees."""
    return np.asarray(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix())


def start_pose(start: Start, contact: ContactSimulation) -> Pose:
    """The pose before the first frame."""
    rotation = turned(start.rotation_deg)
    if isinstance(start.place, Touch):
        return _touching(start.place.at, start.place.clearance, rotation, contact)
    return Pose(np.array(start.place), rotation)


def goal_pose(goal: Goal, begin: Pose, contact: ContactSimulation) -> Pose:
    """The pose that a phase which begins at `begin` ends at; a load has none (ValueError)."""
    if isinstance(goal, Hold):
        return begin
    if isinstance(goal, MoveTo):
        position = begin.position if goal.position is None else np.array(goal.position)
        rotation = begin.rotation if goal.rotation_deg is None else turned(goal.rotation_deg)
        return Pose(position, rotation)
    if isinstance(goal, MoveBy):
        return Pose(begin.position + goal.offset, turned(goal.rotation_deg) @ begin.rotation)
    if isinstance(goal, Touch):
        return _touching(goal.at, goal.clearance, begin.rotation, contact)
    if isinstance(goal, Release):
        x, y, _ = begin.position.tolist()
        return _touching((x, y), goal.clearance, begin.rotation, contact)
    msg = f"found {goal!r}, expected a position as goal"
    raise ValueError(msg)


def load_between(begin: Load, goal: Press, share: float) -> Load:
    """The load at a share 0..1 of the way."""
    end = goal.load

    def between(first: float, last: float) -> float:
        return first + share * (last - first)

    return Load(
        normal=between(begin.normal, end.normal),
        tangential=(
            between(begin.tangential[0], end.tangential[0]),
            between(begin.tangential[1], end.tangential[1]),
        ),
        torque=between(begin.torque, end.torque),
    )


def _touching(
    at: tuple[float, float],
    clearance: float,
    rotation: NDArray[np.float64],
    contact: ContactSimulation,
) -> Pose:
    touching = contact.touch(Pose(np.array([*at, 0.0]), rotation))
    return Pose(touching.position + (0.0, 0.0, clearance), rotation)


INDENTERS: Mapping[str, Any] = {
    shape.name: shape
    for shape in (
        indenter_shapes.Sphere,
        indenter_shapes.Cylinder,
        indenter_shapes.FlatProbe,
        indenter_shapes.Cuboid,
        indenter_shapes.Ring,
        indenter_shapes.HexagonalBar,
        indenter_shapes.SphereGroup,
    )
}


def read_indenter(section: YamlSection, folder: Path, start: Start) -> IndenterDescription:
    """The description of `indenter`; its keys are the fields of the shape.

    folder: of the scene file, which a mesh's path is relative to.
    Raises InputError for wrong keys, and for a shape that cannot be made of their values.
    """
    kind = section.choice("type", (*INDENTERS, MESH))
    friction = DEFAULT_FRICTION
    if "friction" in section:
        friction = section.number("friction", 0.0, MAX_FRICTION)
    file = None
    if kind == MESH:
        file = folder / section.text("file")
        if not file.is_file():
            raise section.error(
                "file", str(section.raw("file")), f"an existing file; found no {file}"
            )
        values = {key: section.positive(key) for key in MESH_KEYS if key in section}
    else:
        values = _read_values(section, INDENTERS[kind])
    section.finish()
    description = IndenterDescription(kind, friction, values, file)
    try:
        indenter_of(description, start)
    except InputError as error:
        raise section.error("", values or str(file), f"another indenter ({error})") from None
    return description


def indenter_of(description: IndenterDescription, start: Start) -> indenters.Indenter:
    """The indenter itself; InputError where it cannot be made.

    start: its rotation says which side of a mesh touches.
    """
    if description.file is not None:
        return indenters.MeshIndenter.load(
            description.file, **description.values, rotation=turned(start.rotation_deg)
        )
    indenter: indenters.Indenter = INDENTERS[description.type](**description.values)
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
            values["size"] = section.quantities("size", "m", (SIDE_M,) * 3)
        else:
            values[item.name] = section.quantity(item.name, "m", *SIDE_M)
    return values
