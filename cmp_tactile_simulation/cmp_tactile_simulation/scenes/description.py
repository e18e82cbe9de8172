"""A scene: what is simulated, from which sensor, with which indenter, over time.

docs/scenes.md lists the keys of its file; `cmp_tactile_simulation.scenes.file` reads and writes it.
`Motion` says where the indenter is to be, or what it is to press with, in each frame.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.yaml_file import (
    NOTHING,
    Check,
    Limits,
    Part,
    YamlFile,
    choice,
    meant,
    number,
    part_schema,
    positive,
    text,
)
from cmp_tactile_simulation import indenter_shapes, indenters
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.gel import NODES_RANGE
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.simulator import (
    DEFAULT_FRICTION,
    FIRST_STAMP_NS,
    MAX_FRICTION,
    Look,
    turned,
)

MAX_REACH_M = 0.2
MAX_SAMPLES = 8
# At the lowest rate the stamps of a longest scene fit the 32 bits of a message.
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1000.0
MAX_SEED = 2**32 - 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
NOWHERE = (0.0, 0.0, 0.0)

Vector = tuple[float, float, float]

MESH = "mesh"
MESH_KEYS = ("scale", "edge_radius")
# Of everything that presses on a gel.
SIDE_M = 1e-6, 0.2


def _file_name(name: str) -> str:
    if not NAME.fullmatch(name):
        raise RefusedValueError("letters, digits, '_', '.' and '-', for a file name")
    return name


def _within_reach(place: tuple[float, ...]) -> tuple[float, ...]:
    if max(abs(value) for value in place) > MAX_REACH_M:
        hint = meant(place, "m", -MAX_REACH_M, MAX_REACH_M)
        raise RefusedValueError(f"m, each at most {MAX_REACH_M:g}{hint}")
    return place


def _less_than_half_a_turn(turn: Vector) -> Vector:
    """Beyond it the way there is not defined."""
    if sum(angle**2 for angle in turn) >= 180.0**2:
        raise RefusedValueError("a rotation of less than 180 degrees in a phase")
    return turn


Name = Annotated[str, Check(_file_name)]
Place = Annotated[Vector, Check(_within_reach)]
Point = Annotated[tuple[float, float], Check(_within_reach)]


@dataclass(frozen=True)
class Hold:
    """Stay where it is."""


@dataclass(frozen=True)
class MoveTo(Part):
    """Move to a place in the gel frame; None keeps position or rotation.

    position m.  rotation_deg: turned about the gel's x, then y, then z axis, from the
    indenter's own axes.
    """

    position: Place | None = None
    rotation_deg: Vector | None = None


@dataclass(frozen=True)
class MoveBy(Part):
    """Move relative to where the phase begins.

    offset m, gel frame.  rotation_deg: turned about the gel's x, then y, then z direction
    through the indenter's origin.
    """

    offset: Place = field(default=NOWHERE, metadata={"alias": "position"})
    rotation_deg: Annotated[Vector, Check(_less_than_half_a_turn)] = NOWHERE


@dataclass(frozen=True)
class Press:
    """Reach a load, from the one that the phase begins with."""

    load: Load


@dataclass(frozen=True)
class Touch(Part):
    """Come to where the indenter, let down at (x, y), would touch the undeformed gel.

    at (x, y) m of the indenter's origin.  clearance m above that place.
    """

    at: Point
    clearance: float = field(default=0.0, metadata=number(0.0, MAX_REACH_M, "m"))


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
    rotation_deg: Vector = NOWHERE


@dataclass(frozen=True)
class IndenterDescription:
    """type: name of the shape.  friction: Coulomb's coefficient.  values: keys of that shape.

    file: of a mesh, absent for other shapes.
    """

    type: str
    friction: float
    values: Mapping[str, Any] = field(default_factory=dict)
    file: Path | None = None


@dataclass(frozen=True, kw_only=True)
class SceneKeys(Part):
    """The keys of a scene that its file holds as they are.

    source: paper section or other origin.  note: how and why it departs from the source.
    pattern_type: cmp (checkerboard) or dmp (dots).  contact_nodes: nodes along the
    longer side of the contact patch.  rate: frames/s.  defects: of the print.  samples: of a pixel
    along each direction.
    """

    name: Name
    title: str = field(default="", metadata=text())
    source: str = field(default="", metadata=text())
    note: str = field(default="", metadata=text())
    pattern_type: str = field(default="cmp", metadata=choice("cmp", "dmp"))
    contact_nodes: int = field(default=40, metadata=number(*NODES_RANGE))
    rate: float = field(default=30.0, metadata=number(MIN_RATE_HZ, MAX_RATE_HZ))
    camera: CameraSettings = field(default_factory=CameraSettings)
    defects: PrintDefects = field(default_factory=PrintDefects, metadata={"alias": "print"})
    samples: int = field(default=4, metadata=number(1, MAX_SAMPLES))
    seed: int = field(default=0, metadata=number(0, MAX_SEED))


@dataclass(frozen=True, kw_only=True)
class Scene(SceneKeys):
    """All that a simulation depends on.

    sensor_mapping: the resolved sensor description as a file holds it.
    file: that `load_scene` found it in; no output depends on it.
    """

    sensor: SensorDescription
    sensor_mapping: Mapping[str, Any]
    indenter: IndenterDescription
    start: Start
    motion: tuple[Phase, ...]
    file: Path | None = field(default=None, compare=False)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return sum(phase.frames for phase in self.motion)

    @property
    def look(self) -> Look:
        """What its pictures are made with."""
        return Look(self.pattern_type, self.camera, self.defects, self.samples, self.seed)

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


def read_indenter(file: YamlFile, folder: Path, start: Start) -> IndenterDescription:
    """The description of `indenter`; its keys are the fields of the shape.

    folder: of the scene file, which a mesh's path is relative to.
    Raises InputError for wrong keys, and for a shape that cannot be made of their values.
    """
    kind = str(file.content.get("type"))
    if kind not in (*INDENTERS, MESH):
        found = file.content.get("type", NOTHING)
        raise file.error("type", found, f"one of {', '.join((*INDENTERS, MESH))}")
    keys = file.read(_indenter_keys(kind))
    values = {key: getattr(keys, key) for key in file.content if key != "type"}
    friction, path = values.pop("friction", DEFAULT_FRICTION), None
    if kind == MESH:
        name = values.pop("file")
        path = folder / name
        if not path.is_file():
            raise file.error("file", name, f"an existing file; found no {path}")
    description = IndenterDescription(kind, friction, values, path)
    try:
        indenter_of(description, start)
    except InputError as error:
        raise file.error("", values or str(path), f"another indenter ({error})") from None
    return description


@lru_cache
def _indenter_keys(kind: str) -> type[Part]:
    """What the file may say of an indenter of a type."""
    own: list[Any] = [
        ("friction", float, field(default=DEFAULT_FRICTION, metadata=number(0.0, MAX_FRICTION)))
    ]
    if kind == MESH:
        own.insert(0, ("file", str, field(metadata=text())))
        own += [(key, float | None, field(default=None, metadata=positive())) for key in MESH_KEYS]
    side = Annotated[float, Limits(*SIDE_M)]
    kinds = {"size": tuple[side, side, side], "centres": tuple[Vector, ...]}
    for item in fields(INDENTERS[kind]) if kind != MESH else ():
        unit = {"json_schema_extra": {"unit": "m"}}
        declared = field(default=item.default, metadata=unit)
        own.insert(0, (item.name, kinds.get(item.name, side), declared))
    own.insert(0, ("type", str, field()))
    return make_dataclass("Indenter", own, bases=(Part,), frozen=True, kw_only=True)


def indenter_schema() -> dict[str, Any]:
    """JSON schema of `indenter`: the keys of each type."""
    kinds = []
    for kind in (*INDENTERS, MESH):
        schema = part_schema(_indenter_keys(kind))
        schema["properties"]["type"] = {"const": kind}
        kinds.append(schema)
    return {"oneOf": kinds}


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
