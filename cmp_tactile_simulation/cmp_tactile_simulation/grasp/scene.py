"""A grasp: which object, which gripper, and what it does; read from a file.

docs/grasp.md lists the keys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cmp_tactile_processing.cache.files import packaged_files
from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.sensor.description import (
    DEFAULT_SENSOR,
    SensorDescription,
    find_sensor_description,
    load_sensor,
)
from cmp_tactile_processing.sensor.yaml_file import (
    Limits,
    Part,
    YamlFile,
    named_file,
    number,
    positive,
    read_yaml,
    text,
)
from cmp_tactile_simulation.gel import NODES_RANGE
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.scenes.description import (
    IndenterDescription,
    Name,
    Start,
    Vector,
    read_indenter,
)

FORMAT_VERSION = 1
MAX_PHASE_S, MAX_MASS_KG, MAX_FORCE_N, MAX_TORQUE_NM = 60.0, 5.0, 50.0, 2.0
# What MuJoCo and the gel both have a shape of.
SHAPES = ("cuboid", "sphere", "cylinder", "mesh")
Side = Literal["left", "right"]
SIDES = ("left", "right")

Force = tuple[
    Annotated[float, Limits(-MAX_FORCE_N, MAX_FORCE_N)],
    Annotated[float, Limits(-MAX_FORCE_N, MAX_FORCE_N)],
    Annotated[float, Limits(-MAX_FORCE_N, MAX_FORCE_N)],
]
Torque = tuple[
    Annotated[float, Limits(-MAX_TORQUE_NM, MAX_TORQUE_NM)],
    Annotated[float, Limits(-MAX_TORQUE_NM, MAX_TORQUE_NM)],
    Annotated[float, Limits(-MAX_TORQUE_NM, MAX_TORQUE_NM)],
]


@dataclass(frozen=True, kw_only=True)
class Gripper(Part):
    """The packaged gripper: two fingers that close along y on a hand.

    opening: between the fingertips, m.  height: of the fingertips above the table, m.
    speed: of each finger with nothing between them, m/s.
    """

    opening: float = field(default=0.08, metadata=number(0.005, 0.2, "m"))
    height: float = field(default=0.03, metadata=number(0.0, 1.0, "m"))
    speed: float = field(default=0.02, metadata=positive(0.2, "m/s"))


@dataclass(frozen=True, kw_only=True)
class Fingertip(Part):
    """Where a finger of another gripper's model has its gel.

    body: of the finger.  pos m, xyaxes: origin, x and y directions of the gel frame in the body's.
    """

    body: str = field(metadata=text())
    pos: Vector = (0.0, 0.0, 0.0)
    xyaxes: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Servo(Part):
    """What moves the fingers of another gripper's model, for a controller.

    open, closed: controls of the actuators, by name, where the fingers are open and closed.
    held N: with which both fingers press on an object that is held.
    """

    open: Mapping[str, float]
    closed: Mapping[str, float]
    held: float = field(default=1.0, metadata=positive(MAX_FORCE_N, "N"))

    def checked(self) -> Servo:
        """Each actuator has a way to go."""
        if self.open.keys() != self.closed.keys() or not self.open:
            raise RefusedValueError("the same actuators as open, at least one", "closed")
        if any(self.open[name] == self.closed[name] for name in self.open):
            raise RefusedValueError("other values than open", "closed")
        return self

    def controls(self, share: float) -> dict[str, float]:
        """Those of this share of the way from open to closed."""
        return {
            name: (1 - share) * value + share * self.closed[name]
            for name, value in self.open.items()
        }

    def share(self, controls: Mapping[str, float]) -> float:
        """Mean place of these controls between open, 0, and closed, 1; NaN without any of them."""
        shares = [
            (controls[name] - value) / (self.closed[name] - value)
            for name, value in self.open.items()
            if name in controls
        ]
        return sum(shares) / len(shares) if shares else math.nan


@dataclass(frozen=True, kw_only=True)
class GraspPhase(Part):
    """A part of a grasp; what it does not name stays as it was.

    grip N: force of each finger, negative to open.  lift m, tilt_deg: of the hand.  All are reached
    smoothly at the end.
    shake m, shake_hz: amplitude along x and frequency, for this phase.
    force N, torque N m: on the object at its centre of mass, world frame, reached smoothly at the
    end; without them they end as smoothly.
    mass kg: of the object, reached evenly at the end.
    controls: of the actuators of another model, by their names, reached smoothly.
    """

    name: str = field(metadata=text())
    duration: float = field(metadata=positive(MAX_PHASE_S, "s"))
    grip: float | None = field(default=None, metadata=number(-MAX_FORCE_N, MAX_FORCE_N, "N"))
    lift: float | None = field(default=None, metadata=number(-1.0, 1.0, "m"))
    tilt_deg: float | None = field(default=None, metadata=number(-180.0, 180.0, "degrees"))
    shake: float = field(default=0.0, metadata=number(0.0, 0.1, "m"))
    shake_hz: float = field(default=3.0, metadata=positive(50.0, "Hz"))
    force: Force = (0.0, 0.0, 0.0)
    torque: Torque = (0.0, 0.0, 0.0)
    mass: float | None = field(default=None, metadata=positive(MAX_MASS_KG, "kg"))
    controls: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class GraspKeys(Part):
    """The keys of a grasp that its file holds as they are.

    sensor: description of both fingertips; sensors: by side, of one that differs.
    mass kg and position m: of the object on the table.
    rate: of frames, Hz.  contact_nodes, samples: as of a scene.  camera: of both.
    model: MJCF of another gripper, with the sites `left` and `right` (gel frames: z outwards), or
    where fingertips has them; its actuators are set by `controls`.  keyframe: of it, to begin at.
    servo: its actuators that gripper/command moves.
    """

    name: Name
    title: str = field(default="", metadata=text())
    sensor: str = field(default=DEFAULT_SENSOR, metadata=text())
    sensors: Mapping[Side, str] = field(default_factory=dict)
    mass: float = field(default=0.1, metadata=positive(MAX_MASS_KG, "kg"))
    position: Vector = (0.0, 0.0, 0.03)
    gripper: Gripper = field(default_factory=Gripper)
    model: str | None = field(default=None, metadata=text())
    fingertips: Mapping[Side, Fingertip] = field(default_factory=dict)
    keyframe: str | None = field(default=None, metadata=text())
    servo: Servo | None = None
    rate: float = field(default=10.0, metadata=number(1.0, 200.0, "Hz"))
    contact_nodes: int = field(default=20, metadata=number(*NODES_RANGE))
    samples: int = field(default=2, metadata=number(1, 8))
    camera: CameraSettings = field(default_factory=CameraSettings)
    motion: tuple[GraspPhase, ...] = ()

    def checked(self) -> GraspKeys:
        """There is something to do."""
        if not self.motion:
            raise RefusedValueError("a list of one or more phases", "motion")
        for key in ("fingertips", "keyframe", "servo"):
            if self.model is None and getattr(self, key):
                raise RefusedValueError("no such key without a model", key)
        if self.model is not None and self.gripper != Gripper():
            raise RefusedValueError("no such key with a model", "gripper")
        return self


@dataclass(frozen=True, kw_only=True)
class GraspScene(GraspKeys):
    """All that a grasp depends on.

    described: the sensors of the fingertips by side, and files: their descriptions.
    """

    described: Mapping[str, SensorDescription]
    files: Mapping[str, Path]
    object: IndenterDescription
    file: Path

    @property
    def duration(self) -> float:
        """s."""
        return sum(phase.duration for phase in self.motion)


def load_grasp(name_or_path: str) -> GraspScene:
    """The grasp of a packaged name ("box") or a file.

    Raises InputError with file, line, key, found and expected, for all that is wrong with it.
    """
    path = named_file(name_or_path, "grasp", packaged_grasps())
    return _read(read_yaml(path), path)


def packaged_grasps() -> dict[str, Path]:
    """Names and files of the grasps that come with the package."""
    return packaged_files("cmp_tactile_simulation", "grasps/*.yaml")


def _read(top: YamlFile, path: Path) -> GraspScene:
    rest = {key: value for key, value in top.content.items() if key != "object"}
    found = replace(top, content=rest).read(GraspKeys, FORMAT_VERSION)
    shape = top.below("object")
    kind = shape.content.get("type")
    if kind not in SHAPES:
        raise shape.error("type", kind, f"one of {', '.join(SHAPES)}")
    sensors = {side: _sensor(top, path, found, side) for side in SIDES}
    values: dict[str, Any] = {item.name: getattr(found, item.name) for item in fields(GraspKeys)}
    if found.model is not None and not (path.parent / found.model).is_file():
        raise top.error("model", found.model, "an MJCF file")
    held = read_indenter(shape, path.parent, Start((0.0, 0.0, 0.0)))
    files = {side: file for side, (file, _) in sensors.items()}
    described = {side: sensor for side, (_, sensor) in sensors.items()}
    return GraspScene(**values, described=described, files=files, object=held, file=path)


def _sensor(
    top: YamlFile, path: Path, found: GraspKeys, side: str
) -> tuple[Path, SensorDescription]:
    """File and content of a side's description."""
    own = [name for key, name in found.sensors.items() if key == side]
    key, name = (f"sensors.{side}", own[0]) if own else ("sensor", found.sensor)
    beside = path.parent / name
    try:
        source = beside if beside.is_file() else find_sensor_description(name)
        return source, load_sensor(str(source))
    except InputError as error:
        raise top.error(key, name, f"a sensor description ({error})") from None
