"""Writes a sensor description: the file that its reader reads back to the last bit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.atomic_file import write_whole
from cmp_tactile_processing.sensor.description import (
    FORMAT_VERSION,
    SensorDescription,
    sensor_description_of,
)
from cmp_tactile_processing.sensor.parts import (
    CalibrationRecord,
    Camera,
    Elastomer,
    MaterialRecord,
    Optics,
    ViewDescription,
)
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_processing.sensor.yaml_section import parse_yaml
from cmp_tactile_processing.sensor.yaml_text import yaml_number, yaml_numbers, yaml_text

__all__ = ["sensor_description_text", "write_sensor_description"]

HEADER = """\
# Sensor description of cmp_tactile; docs/sensor_description.md explains every key.
# Lengths in m, moduli in Pa; pixel (0, 0) is the centre of the top-left one; T_ab: rows of [R | t]
# that map points of frame b into frame a.
"""
COEFFICIENTS = {"pinhole": "k1 k2 p1 p2 k3 (ROS: plumb_bob)", "equidistant": "k1 k2 k3 k4"}


def write_sensor_description(path: str | Path, sensor: SensorDescription) -> None:
    """Write the file; it is there whole or not at all.

    Raises DescriptionError, and leaves what was there, for a description that its reader would
    refuse and where the file cannot be written.
    """
    text = sensor_description_text(sensor)
    sensor_description_of(parse_yaml(Path(path), text))
    write_whole(Path(path), text)


def sensor_description_text(sensor: SensorDescription) -> str:
    """The file of a sensor as text.

    SensorDescription.load gives the same sensor of it, to the last bit.  Of the stages' parameters
    those that are not the default are written.
    """
    return HEADER + "".join(f"{line}\n" for line in _lines(sensor))


def _lines(sensor: SensorDescription) -> Iterator[str]:
    yield f"version: {FORMAT_VERSION}"
    yield f"name: {yaml_text(sensor.name)}"
    yield f"image: {{width: {sensor.image.width}, height: {sensor.image.height}}}"
    if sensor.camera is not None:
        yield from _section("camera", _camera(sensor.camera))
    yield from _section("optics", _optics(sensor.optics))
    yield from _section("views", _views(sensor.views, sensor.camera))
    yield from _section("pattern", _pattern(sensor.pattern))
    yield from _section("elastomer", _elastomer(sensor.elastomer))
    for stage in ("tracking", "triangulation", "force", "slip"):
        yield from _section(stage, _parameters(getattr(sensor, stage)))
    if sensor.calibration is not None:
        yield from _section("calibration", _calibration(sensor.calibration))


def _section(key: str, lines: Iterable[str]) -> Iterator[str]:
    """A mapping below `key`; nothing where it is empty."""
    indented = [f"  {line}" for line in lines]
    if indented:
        yield f"{key}:"
        yield from indented


def _camera(camera: Camera) -> Iterator[str]:
    yield f"model: {camera.model}"
    for key in ("fx", "fy", "cx", "cy"):
        yield f"{key}: {yaml_number(getattr(camera, key))}"
    names = COEFFICIENTS.get(camera.model, "")
    yield f"distortion: {yaml_numbers(camera.distortion)}  # {names}"


def _optics(optics: Optics) -> Iterator[str]:
    yield f"type: {optics.type}"
    if optics.T_camera_gel is not None:
        yield from _pose("T_camera_gel", optics.T_camera_gel)
    if not optics.layers:
        yield "layers: []"
        return
    yield "layers:  # from the camera on; index: from plane z of the gel frame towards the gel"
    for layer in optics.layers:
        yield f"  - {{z: {yaml_number(layer.z)}, index: {yaml_number(layer.index)}}}"


def _views(views: Mapping[str, ViewDescription], shared: Camera | None) -> Iterator[str]:
    for name, view in views.items():
        yield from _section(name, _view(view, shared))


def _view(view: ViewDescription, shared: Camera | None) -> Iterator[str]:
    roi = view.roi
    yield f"roi: [{roi.x}, {roi.y}, {roi.width}, {roi.height}]  # x y width height"
    if view.mirror is not None:
        yield "mirror:  # plane {p : normal . p = distance} in the camera's optical frame"
        yield f"  normal: {yaml_numbers(view.mirror.normal)}"
        yield f"  distance: {yaml_number(view.mirror.distance)}"
    if view.camera is not None and view.camera != shared:
        yield from _section("camera", _camera(view.camera))
    if view.T_view_gel is not None:
        yield from _pose("T_view_gel", view.T_view_gel)


def _pose(key: str, T: NDArray[np.float64]) -> Iterator[str]:
    yield f"{key}:"
    for row in T[:3]:
        yield f"  - {yaml_numbers(row)}"


def _pattern(pattern: Pattern) -> Iterator[str]:
    yield f"rows: {pattern.rows}"
    yield f"cols: {pattern.cols}"
    yield f"pitch: {yaml_number(pattern.pitch)}"
    yield f"corner_checker: {pattern.corner_checker}"
    yield f"points_per_segment: {pattern.points_per_segment}"
    surface = pattern.surface
    keys = [f"type: {surface.type}"]
    if surface.type != "plane":
        keys.append(f"radius: {yaml_number(surface.radius)}")
    if surface.type == "cylinder":
        keys.append(f"axis: {yaml_text(surface.axis)}")
    yield f"surface: {{{', '.join(keys)}}}"


def _elastomer(elastomer: Elastomer) -> Iterator[str]:
    yield f"size: {yaml_numbers(elastomer.size)}  # x, y, thickness at the apex"
    yield f"young: {yaml_number(elastomer.young)}"
    yield f"poisson: {yaml_number(elastomer.poisson)}"
    yield f"model: {elastomer.model}"
    layer = elastomer.shading_layer
    thickness, young = yaml_number(layer.thickness), yaml_number(layer.young)
    yield f"shading_layer: {{thickness: {thickness}, young: {young}}}"
    if elastomer.relaxation is not None:
        share = yaml_number(elastomer.relaxation.share)
        yield f"relaxation: {{share: {share}, time: {yaml_number(elastomer.relaxation.time)}}}"
    if elastomer.calibration is not None:
        yield from _section("calibration", _material(elastomer.calibration))


def _material(record: MaterialRecord) -> Iterator[str]:
    yield f"method: {record.method}"
    yield f"date: {yaml_text(record.date)}"
    yield f"samples: {record.samples}"
    for key in ("normal_std", "tangential_std", "young_std", "poisson_std"):
        value = getattr(record, key)
        if not math.isnan(value):
            yield f"{key}: {yaml_number(value)}"
    yield from _names("determined", record.determined)
    yield from _names("held", record.held)


def _parameters(parameters: Any) -> Iterator[str]:
    """Fields of a dataclass of parameters that are not the default."""
    for item in dataclasses.fields(parameters):
        value = getattr(parameters, item.name)
        if value != item.default:
            yield f"{item.name}: {_value(value)}"


def _calibration(record: CalibrationRecord) -> Iterator[str]:
    yield f"method: {record.method}"
    yield f"date: {yaml_text(record.date)}"
    yield f"frames: {record.frames}"
    yield f"reprojection_px: {yaml_number(record.reprojection)}"
    if not math.isnan(record.ray_gap):
        yield f"ray_gap: {yaml_number(record.ray_gap)}"
    yield from _names("determined", record.determined)
    yield from _names("held", record.held)


def _names(key: str, names: tuple[str, ...]) -> Iterator[str]:
    if not names:
        yield f"{key}: []"
    else:
        yield f"{key}:"
        yield from (f"  - {yaml_text(name)}" for name in names)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    return yaml_text(value) if isinstance(value, str) else yaml_number(value)
