"""Reads a scene and checks every key of it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.description import SensorDescription, sensor_description_of
from cmp_tactile_processing.sensor.library import find_sensor_description
from cmp_tactile_processing.sensor.parameter_section import read_parameters
from cmp_tactile_processing.sensor.yaml_section import YamlSection, read_yaml
from cmp_tactile_simulation.errors import SceneError
from cmp_tactile_simulation.gel.contact_patch import NODES_RANGE
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes.description import PATTERN_TYPES, Scene, Start
from cmp_tactile_simulation.scenes.indenter_choice import read_indenter
from cmp_tactile_simulation.scenes.motion_reader import (
    MAX_REACH_M,
    reach_text,
    read_motion,
    read_rotation,
    read_touch,
)

__all__ = ["read_scene", "variants_of"]

FORMAT_VERSION = 1
MAX_SAMPLES = 8
# At the lowest rate the stamps of a longest scene fit the 32 bits of a message.
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1000.0
MAX_SEED = 2**32 - 1

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def variants_of(path: Path) -> tuple[str, ...]:
    """Names of a scene's variants; empty where it has none.  SceneError as for `read_scene`."""
    try:
        return tuple(_variants(read_yaml(path)))
    except DescriptionError as error:
        raise SceneError(str(error)) from None


def read_scene(path: Path, variant: str = "") -> Scene:
    """Read and check a scene file.

    variant: one of the file's variants; needed where it has some.
    Raises SceneError naming file, key path, what was found and what is expected.
    """
    try:
        return _read(_with_variant(read_yaml(path), path, variant), path)
    except DescriptionError as error:
        raise SceneError(str(error)) from None


def _read(top: YamlSection, path: Path) -> Scene:
    top.integer("version", FORMAT_VERSION, FORMAT_VERSION)
    name = _name(top, "name")
    sensor, mapping = _read_sensor(top, path)
    rate = top.number("rate", MIN_RATE_HZ, MAX_RATE_HZ) if "rate" in top else Scene.rate
    motion = read_motion(top, rate)
    start = _read_start(top.section("start"))
    scene = Scene(
        name=name,
        title=top.text("title"),
        source=top.text("source"),
        note=top.text("note") if "note" in top else "",
        sensor=sensor,
        sensor_mapping=mapping,
        indenter=read_indenter(top.section("indenter"), path.parent, start, motion),
        start=start,
        motion=motion,
        pattern_type=_choice(top, "pattern_type", PATTERN_TYPES, Scene.pattern_type),
        contact_nodes=_integer(top, "contact_nodes", NODES_RANGE, Scene.contact_nodes),
        rate=rate,
        camera=read_parameters(top.optional_section("camera"), CameraSettings),
        defects=read_parameters(top.optional_section("print"), PrintDefects),
        samples=_integer(top, "samples", (1, MAX_SAMPLES), Scene.samples),
        seed=_integer(top, "seed", (0, MAX_SEED), Scene.seed),
    )
    top.finish()
    return scene


def _variants(top: YamlSection) -> dict[str, Any]:
    section = top.optional_section("variants")
    variants: dict[str, Any] = {}
    for name, value in section.items() if section else ():
        if not NAME.fullmatch(name) or not isinstance(value, dict):
            expected = "a name of letters, digits, '_', '.' and '-', and a mapping of scene keys"
            raise top.error(f"variants.{name}", value, expected)
        variants[name] = value
    return variants


def _with_variant(top: YamlSection, path: Path, variant: str) -> YamlSection:
    """The mapping with the variant's keys laid over it; its name tells the variant."""
    variants = _variants(top)
    if variant not in variants and (variant or variants):
        allowed = f"one of {', '.join(variants)}" if variants else "none: the scene has no variants"
        raise top.error("variants", variant or "no variant", allowed)
    content = {key: value for key, value in top.items() if key != "variants"}
    if variant:
        content["name"] = f"{_name(top, 'name')}_{variant}"
        content = merged(content, variants[variant])
    return YamlSection(path, "", content)


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A mapping with another laid over it: mappings are merged, all else is replaced."""
    result = dict(base)
    for key, value in over.items():
        below = result.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        result[key] = merged(below, value) if both else value  # type: ignore[arg-type]
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
    except DescriptionError as error:
        raise top.error(key, base, f"a sensor description ({error})") from None
    content = dict(read_yaml(source).items())
    if not over:
        return SensorDescription.load(source), content
    mapping = merged(content, over)
    return sensor_description_of(YamlSection(path, "sensor", mapping)), mapping


def _read_start(section: YamlSection) -> Start:
    rotation = read_rotation(section)
    if ("touch" in section) == ("position" in section):
        raise section.error("", list(dict(section.items())), "either `position` or `touch`")
    if "touch" in section:
        start = Start(read_touch(section.section("touch")), rotation)
    else:
        start = Start(_position(section), rotation)
    section.finish()
    return start


def _position(section: YamlSection) -> tuple[float, float, float]:
    x, y, z = section.numbers("position", 3)
    if max(abs(x), abs(y), abs(z)) > MAX_REACH_M:
        raise section.error("position", [x, y, z], reach_text([x, y, z]))
    return x, y, z


def _name(top: YamlSection, key: str) -> str:
    name = top.text(key)
    if not NAME.fullmatch(name):
        raise top.error(key, name, "letters, digits, '_', '.' and '-', for a file name")
    return name


def _choice(top: YamlSection, key: str, choices: tuple[str, ...], default: str) -> str:
    return top.choice(key, choices) if key in top else default


def _integer(top: YamlSection, key: str, limits: tuple[int, int], default: int) -> int:
    return top.integer(key, *limits) if key in top else default
