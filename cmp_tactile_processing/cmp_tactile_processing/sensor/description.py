"""A sensor: its description, the file that it is read from, and the packaged ones by name."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, astuple, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cmp_tactile_processing.cache.files import expanded_path, packaged_files, write_whole
from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.sensor import parameters, parts
from cmp_tactile_processing.sensor.yaml_file import (
    NotInFile,
    OrElse,
    Part,
    YamlFile,
    file_schema,
    parse_yaml,
    read_yaml,
    text,
)
from cmp_tactile_processing.sensor.yaml_text import dump_yaml, updated_yaml

FORMAT_VERSION = 1
# A lens sees at most 172 degrees over this many of its focal lengths; less is one in mm.
MOST_WIDTH_PER_FOCAL = 30.0
VIEW_NAMES = ("left", "right")
# Larger gels and checkers are mostly lengths in cm.
USUAL_PITCH_M, USUAL_SIDE_M = 5e-3, 0.1

HEADER = """\
# Sensor description of cmp_tactile; docs/sensor_description.md explains every key.
# Lengths in m, moduli in Pa; pixel (0, 0) is the centre of the top-left one; T_ab: rows of [R | t]
# that map points of frame b into frame a.
"""
COMMENTS = {
    "layers": "from the camera on; index: from plane z of the gel frame towards the gel",
    "roi": "x y width height",
    "mirror": "plane {p : normal . p = distance} in the camera's optical frame",
    "size": "x, y, thickness at the apex",
    "distortion": "k1 k2 p1 p2 k3 (ROS: plumb_bob); of an equidistant camera k1 k2 k3 k4",
}
DEFAULT_SENSOR = "prototype"
SENSOR_NAME_HELP = (
    "name of this sensor, the beginning of its tf frames; empty for the name in the sensor "
    "description"
)


@dataclass(frozen=True)
class SensorDescription(Part):
    """One sensor.  `views` holds "left" and "right"; a monocular sensor has one of them.

    One without optics has neither camera nor views, and NO_IMAGE.

    file: that it was read from, which errors name; empty for one that was made otherwise.
    text: of that file; a written file has its layout and comments where values are still the same.
    """

    name: str = field(metadata=text())
    image: Annotated[parts.ImageSize, OrElse(parts.NO_IMAGE)]
    camera: Annotated[parts.Camera | None, OrElse(None)]
    optics: parts.Optics
    views: Annotated[Mapping[str, parts.ViewDescription], OrElse({})]
    pattern: parts.Pattern
    elastomer: parts.Elastomer
    tracking: parameters.TrackingParameters = field(default_factory=parameters.TrackingParameters)
    triangulation: parameters.TriangulationParameters = field(
        default_factory=parameters.TriangulationParameters
    )
    force: parameters.ForceParameters = field(default_factory=parameters.ForceParameters)
    slip: parameters.SlipParameters = field(default_factory=parameters.SlipParameters)
    calibration: parts.CalibrationRecord | None = None
    uncertainty: parts.Uncertainty = field(default_factory=parts.Uncertainty)
    file: Annotated[str, NotInFile()] = field(default="", compare=False, repr=False)
    text: Annotated[str, NotInFile()] = field(default="", compare=False, repr=False)

    def checked(self) -> SensorDescription:
        """The parts belong together; views without a camera of their own have the common one."""
        counts = self.pattern.cols, self.pattern.rows
        extent = [(count - 1) * self.pattern.pitch for count in counts]
        if self.elastomer.size[0] < extent[0] or self.elastomer.size[1] < extent[1]:
            expected = f"at least the markers' {extent[0]:.6g} x {extent[1]:.6g} m"
            raise RefusedValueError(expected, "elastomer", "size")
        kind = self.optics.type
        with_image = kind != parts.NO_OPTICS
        for key, is_given in (("image", self.image != parts.NO_IMAGE), ("views", bool(self.views))):
            if is_given != with_image:
                expected = "a mapping" if with_image else "no such key for optics of type none"
                raise RefusedValueError(expected, key)
        if kind != "two_view" and with_image != (self.camera is not None):
            expected = "a mapping" if with_image else "no such key for optics of type none"
            raise RefusedValueError(expected, "camera")
        for name in self.views:
            if name not in VIEW_NAMES:
                raise RefusedValueError("no such key; allowed: left, right", "views", name)
        if kind == "monocular" and len(self.views) != 1:
            expected = "one view, left or right, for a monocular sensor"
            raise RefusedValueError(expected, "views", found=list(self.views))
        names = list(self.views) if kind == "monocular" else VIEW_NAMES if self.views else ()
        if self.camera is not None:
            _check_focal(self.camera, self.image, "camera")
        return replace(self, views={name: self._checked_view(name) for name in names})

    def _checked_view(self, name: str) -> parts.ViewDescription:
        view, kind = self.views.get(name), self.optics.type
        if view is None:
            raise RefusedValueError("a mapping", "views", name)
        roi, image = view.roi, self.image
        inside = min(roi.x, roi.y) >= 0 and min(roi.width, roi.height) >= 16
        if not inside or roi.x + roi.width > image.width or roi.y + roi.height > image.height:
            expected = (
                f"[x, y, width, height] in whole px inside {image.width} x {image.height}, the "
                "size `image`"
            )
            raise RefusedValueError(expected, "views", name, "roi")
        wanted = {
            "camera": kind == "two_view" and self.camera is None,
            "T_view_gel": kind == "two_view",
            "mirror": kind == "mirror_stereo",
        }
        allowed = {"camera": kind == "two_view", "mirror": kind != "two_view"}
        for key, is_wanted in wanted.items():
            is_given = getattr(view, key) is not None
            if is_wanted and not is_given:
                raise RefusedValueError("a value", "views", name, key)
            if is_given and not allowed.get(key, is_wanted):
                raise RefusedValueError(f"no such key for {kind}", "views", name, key)
        if view.camera is not None:
            _check_focal(view.camera, image, "views", name, "camera")
        return replace(view, camera=view.camera or self.camera) if kind == "two_view" else view

    @property
    def origin(self) -> str:
        """What an error about the description begins with: its file, or else the sensor's name."""
        return self.file or self.name

    @property
    def frame_size(self) -> tuple[int, int]:
        """Width and height of the camera frame, px; InputError where there is no camera."""
        if self.optics.type == parts.NO_OPTICS:
            msg = f"{self.origin}: optics.type: found none, expected a camera for the use of frames"
            raise InputError(msg)
        return self.image.width, self.image.height

    @property
    def sheet(self) -> parts.Pattern:
        """The whole print on the gel: the pattern, and what goes on around it beyond the view."""
        return self.pattern.sheet(self.elastomer.size[:2])

    @property
    def size_doubt(self) -> str:
        """Why the lengths may be in another unit; empty where they are usual or stated."""
        if "pattern.pitch" in self.uncertainty.std:
            return ""
        pitch, side = self.pattern.pitch, max(self.elastomer.size)
        for key, value, limit in (
            ("pattern.pitch", pitch, USUAL_PITCH_M),
            ("elastomer.size", side, USUAL_SIDE_M),
        ):
            if value > limit:
                return (
                    f"{self.origin}: {key}: found {value:g} m, expected at most {limit:g} m in "
                    "front of a camera: are all lengths in cm? If not, state how well the pitch "
                    "is known, as uncertainty: {std: {pattern.pitch: 0.005}}"
                )
        return ""

    @property
    def ros_name(self) -> str:
        """The name as a ROS namespace and frame prefix: other characters become one underscore."""
        name = re.sub(r"[^A-Za-z0-9]+", "_", self.name).strip("_")
        return name if name[:1].isalpha() else f"sensor_{name}".rstrip("_")

    @classmethod
    def load(cls, path: str | Path) -> SensorDescription:
        """Read a sensor description (format version 1).

        Raises InputError naming file, key path, what was found and what is expected.
        """
        return read_sensor_description(Path(path))


def read_sensor_description(path: Path) -> SensorDescription:
    """Read and check the file; see SensorDescription.load."""
    return sensor_description_of(read_yaml(path))


def sensor_description_of(file: YamlFile) -> SensorDescription:
    """Check a sensor description that was read already; errors as SensorDescription.load."""
    sensor = file.read(SensorDescription, FORMAT_VERSION)
    return replace(sensor, file=str(file.path), text=file.text)


def sensor_schema() -> dict[str, Any]:
    """JSON schema of a sensor description's file."""
    return file_schema(SensorDescription, FORMAT_VERSION)


def _check_focal(camera: parts.Camera, image: parts.ImageSize, *key: str) -> None:
    least = image.width / MOST_WIDTH_PER_FOCAL
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if focal < least:
            expected = (
                f"px, at least {least:.3g} for an image {image.width} px wide; did you mean "
                f"{focal:g} mm divided by the size of a pixel in mm?"
            )
            raise RefusedValueError(expected, *key, name)


def write_sensor_description(path: str | Path, sensor: SensorDescription) -> None:
    """Write the file; it is there whole or not at all.

    Raises InputError for a description that its reader would refuse, and OutputError where the
    file cannot be written; then what was there stays.
    """
    text = sensor_description_text(sensor)
    sensor_description_of(parse_yaml(Path(path), text))
    write_whole(Path(path), text)


def sensor_description_text(sensor: SensorDescription) -> str:
    """The file of a sensor as text.

    SensorDescription.load gives the same sensor of it, to the last bit.  Of the stages' parameters
    those that are not the default are written.  What is the same in the file that the sensor was
    read from keeps its layout and comments.
    """
    if sensor.text:
        file = parse_yaml(Path(sensor.origin), sensor.text)
        read = sensor_description_of(file)
        before, after = (_mapping(item, file.content, item.camera) for item in (read, sensor))
        return updated_yaml(sensor.text, before, after)
    text = HEADER + dump_yaml({"version": FORMAT_VERSION, **_mapping(sensor, {}, sensor.camera)})
    for key, comment in COMMENTS.items():
        text = re.sub(rf"(?m)^( +{key}:.*)$", rf"\1  # {comment}", text)
    return text


def _mapping(part: Any, given: Any, shared: parts.Camera | None) -> dict[str, Any]:
    """What a file says of a part.

    given: by the file that the part was read from; a default that it states is written again.
    shared: the camera of all views.
    """
    found: dict[str, Any] = {}
    given = given if isinstance(given, dict) else {}
    for item in fields(part):
        key, value = item.metadata.get("alias", item.name), getattr(part, item.name)
        repeated = isinstance(part, parts.ViewDescription) and isinstance(value, parts.Camera)
        surface = isinstance(part, parts.PatternSurface)
        unused = surface and key not in parts.SURFACE_KEYS[part.type]
        if not item.compare or unused or value is None or (repeated and value == shared):
            continue
        plain = _plain(value, given.get(key), shared)
        left_out = plain == {} or (_goes_without(item, value) and not surface)
        if not left_out or given.get(key, MISSING) == plain:
            found[key] = plain
    return found


def _goes_without(item: Field[Any], value: Any) -> bool:
    """Whether a file without the key gives the same value."""
    if isinstance(value, float) and math.isnan(value):
        return item.default is not MISSING
    return not isinstance(value, np.ndarray) and bool(value == item.default)


def _plain(value: Any, given: Any, shared: parts.Camera | None) -> Any:
    if isinstance(value, parts.Roi):
        return list(astuple(value))
    if is_dataclass(value):
        return {} if value == parts.NO_IMAGE else _mapping(value, given, shared)
    if isinstance(value, Mapping):
        below = given if isinstance(given, dict) else {}
        return {name: _plain(item, below.get(name), shared) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        # The last row of a pose is the same in all.
        return value[:3].tolist()
    if isinstance(value, tuple):
        return [_plain(item, None, shared) for item in value]
    return value


def packaged_sensors() -> dict[str, Path]:
    """Names and files of the sensor descriptions that come with the package."""
    return packaged_files("cmp_tactile_processing", "config/*.yaml")


def find_sensor_description(name_or_path: str) -> Path:
    """The file of a packaged sensor ("sample_rig") or the path as given.

    Raises InputError where there is neither.
    """
    packaged = packaged_sensors()
    if name_or_path in packaged:
        return packaged[name_or_path]
    path = expanded_path(name_or_path)
    if path.is_file():
        return path
    msg = f"{name_or_path}: found no such file, expected a path or one of {', '.join(packaged)}"
    raise InputError(msg)


def load_sensor(name_or_path: str, sensor_name: str = "") -> SensorDescription:
    """The sensor description of that name or path; InputError where it cannot be used.

    sensor_name: of this one among several sensors of the same description, instead of its name.
    """
    sensor = SensorDescription.load(find_sensor_description(name_or_path))
    return replace(sensor, name=sensor_name) if sensor_name else sensor
