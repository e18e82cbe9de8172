"""Scene files: found by path or packaged name, read with every key checked, and written.

A scene is written as it was resolved.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from cmp_tactile_processing.cache.files import atomic_path, expanded_path
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    find_sensor_description,
    sensor_description_of,
)
from cmp_tactile_processing.sensor.yaml_section import (
    YamlSection,
    did_you_mean,
    field_values,
    read_fields,
    read_yaml,
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

Point = tuple[float, float]

PACKAGE = "cmp_tactile_simulation"
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


def _read(top: YamlSection, path: Path) -> description.Scene:
    top.check_version(FORMAT_VERSION, "a scene")
    values = field_values(top, description.Scene)
    values.setdefault("title", values["name"])
    sensor, mapping = _read_sensor(top, path)
    motion = _read_motion(top, values.get("rate", description.Scene.rate))
    start = _read_start(top.section("start"))
    indenter = description.read_indenter(top.section("indenter"), path.parent, start)
    top.finish()
    return description.Scene(
        **values,
        sensor=sensor,
        sensor_mapping=mapping,
        indenter=indenter,
        start=start,
        motion=motion,
    )


def _variants(top: YamlSection) -> dict[str, Any]:
    variants: dict[str, Any] = {}
    for name, value in top.section("variants").items() if "variants" in top else ():
        if not description.NAME.fullmatch(name) or not isinstance(value, dict):
            expected = "a name of letters, digits, '_', '.' and '-', and a mapping of scene keys"
            raise top.error(f"variants.{name}", value, expected)
        variants[name] = value
    return variants


def _with_variant(top: YamlSection, path: Path, variant: str) -> YamlSection:
    """The mapping with the variant's keys laid over it; its name ends in the variant's."""
    variants = _variants(top)
    if variant not in variants and (variant or variants):
        if not variants:
            raise top.error("variants", variant, "none, because the scene has no variants")
        expected = (
            f"one of {', '.join(variants)}, given as SCENE{VARIANT_MARK}{next(iter(variants))}"
        )
        if not variant:
            raise top.missing("variants", expected)
        raise top.error("variants", variant, expected)
    content = {key: value for key, value in top.items() if key != "variants"}
    if variant:
        content["name"] = f"{description.read_name(top, 'name')}_{variant}"
        content = _merged(content, variants[variant])
    return YamlSection(path, "", content)


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A mapping with another laid over it: mappings are merged, all else is replaced."""
    result = dict(base)
    for key, value in over.items():
        below = result.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        result[key] = _merged(below, value) if both else value  # type: ignore[arg-type]
    return result


def _read_sensor(top: YamlSection, path: Path) -> tuple[SensorDescription, dict[str, Any]]:
    value = top.raw("sensor", "a sensor description's name, path, or a mapping with `base`")
    over: dict[str, Any] = {}
    base, key = value, "sensor"
    if isinstance(value, dict):
        section = top.section("sensor")
        base, key = section.text("base"), "sensor.base"
        over = {name: item for name, item in value.items() if name != "base"}
    elif not isinstance(value, str):
        raise top.error("sensor", value, "a name, a path or a mapping with `base`")
    beside = path.parent / base
    try:
        source = beside if beside.is_file() else find_sensor_description(base)
    except InputError as error:
        raise top.error(key, base, f"a sensor description ({error})") from None
    content = dict(read_yaml(source).items())
    if not over:
        return SensorDescription.load(source), content
    mapping = _merged(content, over)
    return sensor_description_of(YamlSection(path, "sensor", mapping)), mapping


def _read_start(section: YamlSection) -> description.Start:
    if ("touch" in section) == ("position" in section):
        raise section.error("", list(dict(section.items())), "either `position` or `touch`")
    if "touch" in section:
        return read_fields(
            section,
            description.Start,
            place=read_fields(section.section("touch"), description.Touch),
        )
    return read_fields(
        section, description.Start, place=description.read_place(section, "position")
    )


def _read_motion(top: YamlSection, rate: float) -> tuple[description.Phase, ...]:
    """The phases of `motion` in order, those of a group once for each of its points.

    rate: frames/s, which makes frames of durations.
    """
    phases: list[description.Phase] = []
    for item in top.sections("motion"):
        phases += _read_group(item, rate) if "motion" in item else [_read_phase(item, rate)]
    frames = sum(phase.frames for phase in phases)
    if not 0 < frames <= MAX_FRAMES:
        raise top.error("motion", f"{frames} frames", f"1 to {MAX_FRAMES} frames")
    return tuple(phases)


def _read_group(section: YamlSection, rate: float) -> list[description.Phase]:
    """The phases of a group, once for each of its points or as often as it says."""
    if ("points" in section) == ("repeat" in section):
        raise section.error("", "a group", "either `points` or `repeat` beside its `motion`")
    points: list[Point] | list[None]
    if "points" in section:
        points = _read_points(section)
    else:
        points = [None] * section.integer("repeat", 1, MAX_REPEATS)
    phases = [
        _read_phase(item, rate, f" {number}", point)
        for number, point in enumerate(points, start=1)
        for item in section.sections("motion")
    ]
    section.finish()
    return phases


def _read_points(section: YamlSection) -> list[Point]:
    expected = f"a list of 1 to {MAX_REPEATS} points [x, y]"
    points = section.raw("points", expected)
    if not isinstance(points, list) or not 0 < len(points) <= MAX_REPEATS:
        raise section.error("points", points, expected)
    return [(x, y) for x, y in section.number_rows("points", len(points), 2)]


def _read_phase(
    section: YamlSection, rate: float, number: str = "", point: Point | None = None
) -> description.Phase:
    """number, point: of the group's round, where there is one."""
    name = section.text("name")
    kinds = [kind for kind in GOALS if kind in section]
    if len(kinds) != 1:
        raise section.error("", kinds or "none of them", f"one of {', '.join(GOALS)}")
    return read_fields(
        section,
        description.Phase,
        name=f"{name}{number}",
        frames=_read_frames(section, rate),
        goal=_read_goal(section, kinds[0], point),
    )


def _read_frames(section: YamlSection, rate: float) -> int:
    if ("frames" in section) == ("duration" in section):
        both = "both" if "frames" in section else "neither"
        raise section.error("", both, "either `frames` or `duration`")
    if "frames" in section:
        return section.integer("frames", 1, MAX_FRAMES)
    frames = round(section.positive("duration", MAX_PHASE_S, "s") * rate)
    if not 0 < frames <= MAX_FRAMES:
        expected = f"1 to {MAX_FRAMES} frames at {rate:g} Hz"
        raise section.error("duration", f"{frames} frames", expected)
    return frames


def _read_goal(section: YamlSection, kind: str, point: Point | None) -> description.Goal:
    """point: of the group, where there is one."""
    if kind == "hold":
        if section.raw("hold") is not True:
            raise section.error("hold", section.raw("hold"), "true")
        return description.Hold()
    if kind == "release":
        return description.Release(**field_values(section, description.Release))
    below = section.section(kind)
    if kind == "load":
        return description.Press(_read_load(below))
    if kind == "touch":
        here = {"at": point} if point is not None and "at" not in below else {}
        return read_fields(below, description.Touch, **here)
    if "position" not in below and "rotation_deg" not in below:
        raise below.error("", "neither", "`position`, `rotation_deg` or both")
    return (
        read_fields(below, description.MoveTo)
        if kind == "to"
        else read_fields(below, description.MoveBy)
    )


def _read_load(section: YamlSection) -> Load:
    x, y = section.numbers("tangential", 2) if "tangential" in section else (0.0, 0.0)
    if max(abs(x), abs(y)) > MAX_LOAD_N:
        raise section.error("tangential", [x, y], f"N, each at most {MAX_LOAD_N:g}")
    torque = 0.0
    if "torque" in section:
        torque = section.number("torque", -MAX_TORQUE_NM, MAX_TORQUE_NM)
    load = Load(section.number("normal", 0.0, MAX_LOAD_N), (x, y), torque)
    section.finish()
    return load


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
    key = {description.MoveTo: "to", description.MoveBy: "by", description.Touch: "touch"}.get(
        type(goal)
    )
    return {key: _mapping(goal)} if key else _mapping(goal)


def _mapping(part: Any) -> dict[str, Any]:
    """What a file says of a part of a scene: all of its fields that are known."""
    values = {
        item.metadata.get("key") or item.name: getattr(part, item.name) for item in fields(part)
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
    found: dict[str, Path] = {}
    for folder in _scene_folders():
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


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


def _scene_folders() -> list[Path]:
    source_tree = Path(__file__).resolve().parents[2] / "scenes"
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    installed = [Path(prefix) / "share" / PACKAGE / "scenes" for prefix in prefixes if prefix]
    return [folder for folder in (*installed, source_tree) if folder.is_dir()]
