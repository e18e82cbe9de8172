"""Scene files: found by path or packaged name, read with every key checked, and written.

A scene is written as it was resolved.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from cmp_tactile_processing.cache.files import atomic_path, expanded_path, packaged_files
from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    find_sensor_description,
    sensor_description_of,
)
from cmp_tactile_processing.sensor.yaml_file import (
    NOTHING,
    Limits,
    Part,
    SecondWith,
    YamlFile,
    choice,
    did_you_mean,
    file_schema,
    number,
    positive,
    read_yaml,
    text,
)
from cmp_tactile_processing.sensor.yaml_text import dump_yaml
from cmp_tactile_simulation.contact.laws import Load
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes import description

FORMAT_VERSION = 1
SCENE_FILE = "scene.yaml"
SENSOR_FILE = "sensor.yaml"
MAX_FRAMES = 100_000
MAX_REPEATS = 1000
MAX_PHASE_S = 3600.0
MAX_LOAD_N = 1000.0
MAX_TORQUE_NM = 10.0
# Keys of a scene that `scene_mapping` does not write as they are.
WRITTEN_APART = ("sensor_mapping", "file")
GOALS = ("to", "by", "load", "touch", "hold", "release")

Tangential = Annotated[float, Limits(-MAX_LOAD_N, MAX_LOAD_N)]

VARIANT_MARK = ":"


def variants_of(path: Path) -> tuple[str, ...]:
    """Names of a scene's variants; empty where it has none.  InputError as for `read_scene`."""
    return tuple(_variants(read_yaml(path)))


def read_scene(path: Path, variant: str = "") -> description.Scene:
    """Read and check a scene file.

    variant: one of the file's variants; needed where it has some.
    Raises InputError naming file, key path, what was found and what is expected.
    """
    return _read(_with_variant(read_yaml(path), path, variant), path)


@dataclass(frozen=True)
class _StartKeys(Part):
    position: description.Place | None = None
    touch: description.Touch | None = None
    rotation_deg: description.Vector = description.NOWHERE

    def checked(self) -> _StartKeys:
        """One place is there."""
        if (self.position is None) == (self.touch is None):
            raise RefusedValueError("either `position` or `touch`")
        return self

    @property
    def start(self) -> description.Start:
        """What it means."""
        place = self.touch or self.position or description.NOWHERE
        return description.Start(place, self.rotation_deg)


@dataclass(frozen=True)
class _LoadKeys(Part):
    normal: float = field(metadata=number(0.0, MAX_LOAD_N, "N"))
    tangential: tuple[Tangential, Tangential] = (0.0, 0.0)
    torque: float = field(default=0.0, metadata=number(-MAX_TORQUE_NM, MAX_TORQUE_NM, "N m"))


@dataclass(frozen=True)
class _TouchKeys(Part):
    at: description.Point | None = None
    clearance: float = field(default=0.0, metadata=number(0.0, description.MAX_REACH_M, "m"))


@dataclass(frozen=True)
class _PhaseKeys(Part):
    """A phase as a file holds it, one of GOALS among its keys."""

    name: str = field(metadata=text())
    frames: int = field(default=0, metadata=number(1, MAX_FRAMES))
    duration: float = field(default=0.0, metadata=positive(MAX_PHASE_S, "s"))
    to: description.MoveTo | None = None
    by: description.MoveBy | None = None
    load: _LoadKeys | None = None
    touch: _TouchKeys | None = None
    hold: bool | None = None
    release: float | None = field(default=None, metadata=number(0.0, description.MAX_REACH_M, "m"))
    easing: str = field(default="smooth", metadata=choice("smooth", "linear"))

    def checked(self) -> _PhaseKeys:
        """One goal and one length are there."""
        kinds = [kind for kind in GOALS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise RefusedValueError(f"one of {', '.join(GOALS)}", found=kinds or "none of them")
        if bool(self.frames) == bool(self.duration):
            found = "both" if self.frames else "neither"
            raise RefusedValueError("either `frames` or `duration`", found=found)
        if self.hold is False:
            raise RefusedValueError("true", "hold")
        by = self.by
        # A key that the file does not give has the default itself.
        stays = by and by.offset is by.rotation_deg is description.NOWHERE
        if self.to == description.MoveTo() or stays:
            expected = "`position`, `rotation_deg` or both"
            raise RefusedValueError(expected, "by" if by else "to")
        return self

    def phase(
        self, rate: float, number: str = "", point: description.Point | None = None
    ) -> description.Phase:
        """The phase.  rate: frames/s.  number, point: of the group's round, where there is one."""
        frames = self.frames or round(self.duration * rate)
        if not 0 < frames <= MAX_FRAMES:
            expected = f"1 to {MAX_FRAMES} frames at {rate:g} Hz"
            raise RefusedValueError(expected, "duration", found=f"{frames} frames")
        return description.Phase(f"{self.name}{number}", frames, self._goal(point), self.easing)

    def _goal(self, point: description.Point | None) -> description.Goal:
        if self.load is not None:
            return description.Press(Load(**asdict(self.load)))
        if self.release is not None:
            return description.Release(self.release)
        if self.touch is None:
            return self.to or self.by or description.Hold()
        place = self.touch.at or point
        if place is None:
            raise RefusedValueError("a place [x, y]", "touch", "at")
        return description.Touch(place, self.touch.clearance)


@dataclass(frozen=True)
class _GroupKeys(Part):
    """Phases that are played at each of the points, or as often as it says."""

    motion: tuple[_PhaseKeys, ...]
    points: tuple[description.Point, ...] | None = None
    repeat: int = field(default=0, metadata=number(1, MAX_REPEATS))

    def checked(self) -> _GroupKeys:
        """It is said how often."""
        if (self.points is None) == (not self.repeat):
            expected = "either `points` or `repeat` beside its `motion`"
            raise RefusedValueError(expected, found="a group")
        if self.points is not None and not 0 < len(self.points) <= MAX_REPEATS:
            raise RefusedValueError(f"a list of 1 to {MAX_REPEATS} points [x, y]", "points")
        return self


@dataclass(frozen=True, kw_only=True)
class _SceneFile(description.SceneKeys):
    start: _StartKeys
    motion: tuple[Annotated[_PhaseKeys | _GroupKeys, SecondWith("motion")], ...]


def _read(top: YamlFile, path: Path) -> description.Scene:
    apart = ("sensor", "indenter")
    rest = {key: value for key, value in top.content.items() if key not in apart}
    found = replace(top, content=rest).read(_SceneFile, FORMAT_VERSION)
    sensor, mapping = _read_sensor(top, path)
    start = found.start.start
    values = {item.name: getattr(found, item.name) for item in fields(description.SceneKeys)}
    return description.Scene(
        **{**values, "title": found.title or found.name},
        sensor=sensor,
        sensor_mapping=mapping,
        indenter=description.read_indenter(top.below("indenter"), path.parent, start),
        start=start,
        motion=_phases(top, found),
    )


def scene_schema() -> dict[str, Any]:
    """JSON schema of a scene's file."""
    schema = file_schema(_SceneFile, FORMAT_VERSION)
    sensor = {"type": "object", "required": ["base"], "properties": {"base": {"type": "string"}}}
    own = {
        "sensor": {"anyOf": [{"type": "string"}, sensor]},
        "indenter": description.indenter_schema(),
        "variants": {"type": "object", "additionalProperties": {"type": "object"}},
    }
    schema["properties"] |= own
    schema["required"] += ["sensor", "indenter"]
    return schema


def _phases(top: YamlFile, found: _SceneFile) -> tuple[description.Phase, ...]:
    """The phases in order, those of a group once for each of its points."""
    phases: list[description.Phase] = []
    for place, item in enumerate(found.motion):
        key = f"motion[{place}]"
        try:
            if isinstance(item, _PhaseKeys):
                phases.append(item.phase(found.rate))
                continue
            for count, point in enumerate(item.points or [None] * item.repeat, start=1):
                for inner, phase in enumerate(item.motion):
                    key = f"motion[{place}].motion[{inner}]"
                    phases.append(phase.phase(found.rate, f" {count}", point))
        except RefusedValueError as error:
            where = ".".join((key, *map(str, error.key)))
            raise top.error(where, error.found or NOTHING, error.expected) from None
    frames = sum(phase.frames for phase in phases)
    if not 0 < frames <= MAX_FRAMES:
        raise top.error("motion", f"{frames} frames", f"1 to {MAX_FRAMES} frames")
    return tuple(phases)


def _variants(top: YamlFile) -> dict[str, Any]:
    variants = top.below("variants").content if "variants" in top.content else {}
    for name, value in variants.items():
        if not description.NAME.fullmatch(name) or not isinstance(value, dict):
            expected = "a name of letters, digits, '_', '.' and '-', and a mapping of scene keys"
            raise top.error(f"variants.{name}", value, expected)
    return variants


def _with_variant(top: YamlFile, path: Path, variant: str) -> YamlFile:
    """The file with the variant's keys laid over it; its name ends in the variant's."""
    variants = _variants(top)
    if variant not in variants and (variant or variants):
        if not variants:
            raise top.error("variants", variant, "none, because the scene has no variants")
        expected = (
            f"one of {', '.join(variants)}, given as SCENE{VARIANT_MARK}{next(iter(variants))}"
        )
        raise top.error("variants", variant or NOTHING, expected)
    content = {key: value for key, value in top.content.items() if key != "variants"}
    lines = dict(top.lines)
    if variant:
        content["name"] = f"{content.get('name', '')}_{variant}"
        content = _merged(content, variants[variant])
        above = f"variants.{variant}."
        own = {key: line for key, line in lines.items() if key.startswith(above)}
        lines |= {key.removeprefix(above): line for key, line in own.items()}
    return YamlFile(path, content, lines)


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A mapping with another laid over it: mappings are merged, all else is replaced."""
    result = dict(base)
    for key, value in over.items():
        below = result.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        result[key] = _merged(below, value) if both else value  # type: ignore[arg-type]
    return result


def _read_sensor(top: YamlFile, path: Path) -> tuple[SensorDescription, dict[str, Any]]:
    value = top.content.get("sensor", NOTHING)
    is_mapping = isinstance(value, dict)
    base, key = (value.get("base"), "sensor.base") if is_mapping else (value, "sensor")
    if not isinstance(base, str):
        expected = "a sensor description's name, path, or a mapping with `base`"
        raise top.error(key, base, expected)
    beside = path.parent / base
    try:
        source = beside if beside.is_file() else find_sensor_description(base)
    except InputError as error:
        raise top.error(key, base, f"a sensor description ({error})") from None
    file = read_yaml(source)
    over = {name: item for name, item in value.items() if name != "base"} if is_mapping else {}
    if not over:
        return sensor_description_of(file), file.content
    mapping = _merged(file.content, over)
    return sensor_description_of(YamlFile(path, mapping, top.lines, above="sensor")), mapping


def write_scene(scene: description.Scene, folder: Path) -> None:
    """Write scene.yaml, sensor.yaml and the indenter's mesh; the scene can be run from there."""
    if scene.indenter.file is not None:
        target = folder / scene.indenter.file.name
        if not target.exists() or not target.samefile(scene.indenter.file):
            shutil.copyfile(scene.indenter.file, target)
    _write(folder / SENSOR_FILE, dict(scene.sensor_mapping))
    _write(folder / SCENE_FILE, scene_mapping(scene))


def scene_mapping(scene: description.Scene) -> dict[str, Any]:
    """The mapping of scene.yaml: every key of the scene, its sensor description beside it."""
    return {
        "version": FORMAT_VERSION,
        **{
            key: value
            for key, value in _mapping(scene).items()
            if key not in WRITTEN_APART and value != ""
        },
        "sensor": SENSOR_FILE,
        "indenter": _indenter(scene.indenter),
        "start": _start(scene.start),
        "motion": [_phase(phase) for phase in scene.motion],
    }


def _write(path: Path, content: dict[str, Any]) -> None:
    with atomic_path(path) as beside:
        beside.write_text(dump_yaml(content), encoding="utf-8")


def _indenter(indenter: description.IndenterDescription) -> dict[str, Any]:
    file = {"file": indenter.file.name} if indenter.file else {}
    values = {key: _plain(value) for key, value in indenter.values.items()}
    return {"type": indenter.type, **file, **values, "friction": indenter.friction}


def _start(start: description.Start) -> dict[str, Any]:
    rotation = {"rotation_deg": list(start.rotation_deg)}
    if isinstance(start.place, description.Touch):
        return {"touch": _mapping(start.place), **rotation}
    return {"position": list(start.place), **rotation}


def _phase(phase: description.Phase) -> dict[str, Any]:
    return {
        "name": phase.name,
        "frames": phase.frames,
        **_goal(phase.goal),
        "easing": phase.easing,
    }


def _goal(goal: description.Goal) -> dict[str, Any]:
    if isinstance(goal, description.Hold):
        return {"hold": True}
    if isinstance(goal, description.Release):
        return {"release": goal.clearance}
    keys = {description.MoveTo: "to", description.MoveBy: "by", description.Touch: "touch"}
    key = keys.get(type(goal))
    return {key: _mapping(goal)} if key else _mapping(goal)


def _mapping(part: Any) -> dict[str, Any]:
    """What a file says of a part of a scene: all of its fields that are known."""
    values = {
        item.metadata.get("alias", item.name): getattr(part, item.name) for item in fields(part)
    }
    return {
        key: _plain(value) for key, value in values.items() if value is not None and value != ""
    }


def _plain(value: Any) -> Any:
    """As YAML knows it: lists for tuples, mappings for parameters and loads."""
    if isinstance(value, (CameraSettings, PrintDefects, Load)):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value


class SceneName(NamedTuple):
    """A scene file and one of its variants, empty where it has none."""

    path: Path
    variant: str = ""

    @classmethod
    def find(cls, text: str) -> SceneName:
        """From NAME, NAME:VARIANT, FILE or FILE:VARIANT; InputError where there is no such file."""
        packaged = packaged_scenes()
        if text in packaged:
            return cls(packaged[text])
        whole = expanded_path(text)
        if whole.is_file():
            return cls(whole)
        base, _, variant = text.rpartition(VARIANT_MARK)
        if base in packaged:
            return cls(packaged[base], variant)
        path = expanded_path(base)
        if base and path.is_file():
            return cls(path, variant)
        msg = f"{text}: found no such scene, expected a file or one of {', '.join(packaged)}"
        raise InputError(msg + did_you_mean(text, packaged))


def packaged_scenes() -> dict[str, Path]:
    """Names and files of the scenes that come with the package."""
    return packaged_files("cmp_tactile_simulation", "scenes/*.yaml")


def packaged_scene_names() -> Iterator[str]:
    """What may be asked for: every scene, those with variants once for each."""
    for name, path in packaged_scenes().items():
        variants = variants_of(path)
        yield from (f"{name}{VARIANT_MARK}{variant}" for variant in variants)
        if not variants:
            yield name


def load_scene(name_or_path: str) -> description.Scene:
    """The scene of that name or file, `:VARIANT` behind it where it has variants.

    Raises InputError naming file, key, found and expected.
    """
    found = SceneName.find(name_or_path)
    return replace(read_scene(*found), file=found.path)
