"""The sensor description: everything that is known of one sensor, from one YAML file.

The format is version 1; docs/sensor_description.md lists its keys.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parameter_section import read_parameters
from cmp_tactile_processing.sensor.parameters import (
    ForceParameters,
    SlipParameters,
    TrackingParameters,
    TriangulationParameters,
)
from cmp_tactile_processing.sensor.parts import (
    CalibrationRecord,
    Camera,
    Elastomer,
    GelRelaxation,
    ImageSize,
    MaterialRecord,
    Mirror,
    Optics,
    RefractingLayer,
    Roi,
    ShadingLayer,
    ViewDescription,
)
from cmp_tactile_processing.sensor.pattern import Pattern, PatternSurface
from cmp_tactile_processing.sensor.yaml_section import YamlSection, meant, read_yaml

__all__ = ["SensorDescription", "read_sensor_description", "sensor_description_of"]

FORMAT_VERSION = 1
MAX_IMAGE_SIDE = 16384
MIN_CORNERS, MAX_CORNERS = 4, 60
MAX_POINTS_PER_SEGMENT = 20
MAX_CALIBRATION_FRAMES = 1_000_000
# Beyond these it is not a gel or rig that this package can measure, but mostly another unit:
# mm for m, kPa or MPa for Pa.
PITCH_M = 1e-5, 0.05
RADIUS_M = 1e-4, 2.0
SIDE_M = 1e-4, 0.3
SKIN_M = 0.0, 0.02
YOUNG_PA = 1e3, 1e10
DISTANCE_M = -2.0, 2.0
MAX_RELAXATION_S = 1e6
# A lens sees at most 172 degrees over this many of its focal lengths; less is one in mm.
MOST_WIDTH_PER_FOCAL = 30.0
MAX_FOCAL_PX = 1e6
# So that no sum of powers overflows.
MAX_COEFFICIENT = 1e30
# Rotations and normals are written with 6 digits or more.
UNIT_TOLERANCE = 1e-5
# What is a unit vector to this is not scaled: it would change in its last bits at every reading.
UNIT_ROUNDING = 1e-15
OPTICS_TYPES = ("mirror_stereo", "two_view", "monocular")
VIEW_NAMES = ("left", "right")
CALIBRATION_METHODS = ("board", "gel")
MATERIAL_METHODS = ("weights", "force_sensor")
DISTORTION_LENGTH = {"pinhole": 5, "equidistant": 4}


@dataclass(frozen=True)
class SensorDescription:
    """One sensor.  `views` holds "left" and "right"; a monocular sensor has one of them.

    file: that it was read from, which errors name; empty for one that was made otherwise.
    """

    name: str
    image: ImageSize
    camera: Camera | None
    optics: Optics
    views: Mapping[str, ViewDescription]
    pattern: Pattern
    elastomer: Elastomer
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    triangulation: TriangulationParameters = field(default_factory=TriangulationParameters)
    force: ForceParameters = field(default_factory=ForceParameters)
    slip: SlipParameters = field(default_factory=SlipParameters)
    calibration: CalibrationRecord | None = None
    file: str = field(default="", compare=False, repr=False)

    @property
    def origin(self) -> str:
        """What an error about the description begins with: its file, or else the sensor's name."""
        return self.file or self.name

    @property
    def ros_name(self) -> str:
        """The name as a ROS namespace and frame prefix: other characters become underscores."""
        name = re.sub(r"[^A-Za-z0-9_]", "_", self.name)
        return name if name[0].isalpha() else f"sensor_{name}"

    @classmethod
    def load(cls, path: str | Path) -> SensorDescription:
        """Read a sensor description (format version 1).

        Raises DescriptionError naming file, key path, what was found and what is expected.
        """
        return read_sensor_description(Path(path))


def read_sensor_description(path: Path) -> SensorDescription:
    """Read and check the file; see SensorDescription.load."""
    return sensor_description_of(read_yaml(path))


def sensor_description_of(top: YamlSection) -> SensorDescription:
    """Check a sensor description that was read already; errors as SensorDescription.load."""
    top.integer("version", FORMAT_VERSION, FORMAT_VERSION)
    name = top.text("name")
    image = _read_image(top.section("image"))
    optics_section = top.section("optics")
    optics_type = optics_section.choice("type", OPTICS_TYPES)
    camera = None
    if optics_type != "two_view" or "camera" in top:
        camera = _read_camera(top.section("camera"), image)
    optics = _read_optics(optics_section, optics_type)
    pattern = _read_pattern(top.section("pattern"))
    description = SensorDescription(
        name=name,
        image=image,
        camera=camera,
        optics=optics,
        views=_read_views(top.section("views"), optics_type, image, camera),
        pattern=pattern,
        elastomer=_read_elastomer(top.section("elastomer"), pattern),
        tracking=read_parameters(top.optional_section("tracking"), TrackingParameters),
        triangulation=read_parameters(
            top.optional_section("triangulation"), TriangulationParameters
        ),
        force=read_parameters(top.optional_section("force"), ForceParameters),
        slip=read_parameters(top.optional_section("slip"), SlipParameters),
        calibration=_read_calibration(top.optional_section("calibration")),
        file=str(top.path),
    )
    top.finish()
    return description


def _read_image(section: YamlSection) -> ImageSize:
    image = ImageSize(
        section.integer("width", 16, MAX_IMAGE_SIDE), section.integer("height", 16, MAX_IMAGE_SIDE)
    )
    section.finish()
    return image


def _read_camera(section: YamlSection, image: ImageSize) -> Camera:
    model = section.choice("model", tuple(DISTORTION_LENGTH))
    middle = -MAX_IMAGE_SIDE, 2 * MAX_IMAGE_SIDE
    camera = Camera(
        model=model,
        fx=_read_focal(section, "fx", image),
        fy=_read_focal(section, "fy", image),
        cx=section.number("cx", *middle),
        cy=section.number("cy", *middle),
        distortion=section.numbers("distortion", DISTORTION_LENGTH[model]),
    )
    section.finish()
    largest = max(abs(value) for value in camera.distortion)
    if largest > MAX_COEFFICIENT:
        expected = f"coefficients up to {MAX_COEFFICIENT:g}"
        raise section.error("distortion", list(camera.distortion), expected)
    return camera


def _read_focal(section: YamlSection, key: str, image: ImageSize) -> float:
    focal = section.positive(key, MAX_FOCAL_PX)
    least = image.width / MOST_WIDTH_PER_FOCAL
    if focal < least:
        expected = (
            f"px, at least {least:.3g} for an image {image.width} px wide: did you mean "
            f"{focal:g} mm divided by the size of a pixel in mm?"
        )
        raise section.error(key, focal, expected)
    return focal


def _read_optics(section: YamlSection, optics_type: str) -> Optics:
    pose = None if optics_type == "two_view" else _read_pose(section, "T_camera_gel")
    layers: list[RefractingLayer] = []
    for item in section.sections("layers"):
        layer = RefractingLayer(
            z=item.quantity("z", "m", *DISTANCE_M), index=item.number("index", 1.0, 4.0)
        )
        item.finish()
        if layers and layer.z <= layers[-1].z:
            raise item.error("z", layer.z, f"more than {layers[-1].z} (layers in order)")
        layers.append(layer)
    section.finish()
    return Optics(optics_type, pose, tuple(layers))


def _read_pose(section: YamlSection, key: str) -> NDArray[np.float64]:
    rows = np.array(section.number_rows(key, 3, 4))
    # Nothing in a rotation is above 1; numpy would warn of what overflows.
    rotation = np.clip(rows[:, :3], -2.0, 2.0)
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(rotation) < 0:
        expected = (
            "rows of [R | t] with R a right-handed rotation; here R R^T is off by "
            f"{off:.2g} and det R is {np.linalg.det(rotation):.3g}"
        )
        raise section.error(key, rows.tolist(), expected)
    if np.abs(rows[:, 3]).max() > DISTANCE_M[1]:
        found = rows[:, 3].tolist()
        expected = f"m, at most {DISTANCE_M[1]:g}" + meant(found, "m", *DISTANCE_M)
        raise section.error(key, f"a translation of {found}", expected)
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


def _read_views(
    section: YamlSection, optics_type: str, image: ImageSize, shared: Camera | None
) -> dict[str, ViewDescription]:
    names = [name for name in VIEW_NAMES if name in section]
    if optics_type == "monocular":
        if len(names) != 1:
            raise section.error("", names, "one view for a monocular sensor: left or right")
    else:
        names = list(VIEW_NAMES)
    views = {}
    for name in names:
        view = section.section(name)
        roi = _read_roi(view, image)
        mirror = camera = pose = None
        if optics_type == "two_view":
            own = "camera" in view or shared is None
            camera = _read_camera(view.section("camera"), image) if own else shared
            pose = _read_pose(view, "T_view_gel")
        elif optics_type == "mirror_stereo" or "mirror" in view:
            mirror = _read_mirror(view.section("mirror"))
        view.finish()
        views[name] = ViewDescription(roi, mirror, camera, pose)
    section.finish()
    return views


def _read_roi(section: YamlSection, image: ImageSize) -> Roi:
    expected = f"[x, y, width, height] in whole px inside {image.width} x {image.height}"
    values = section.raw("roi", expected)
    whole = isinstance(values, list) and len(values) == 4
    whole = whole and all(isinstance(v, int) and not isinstance(v, bool) for v in values)
    if not whole:
        raise section.error("roi", values, expected)
    roi = Roi(*values)
    inside = roi.x >= 0 and roi.y >= 0 and min(roi.width, roi.height) >= 16
    if not inside or roi.x + roi.width > image.width or roi.y + roi.height > image.height:
        raise section.error("roi", values, expected)
    return roi


def _read_mirror(section: YamlSection) -> Mirror:
    normal = np.array(section.numbers("normal", 3))
    length = math.hypot(*normal)
    if abs(length - 1) > UNIT_TOLERANCE:
        expected = f"a unit vector; this one's length is {length:.6g}"
        raise section.error("normal", normal.tolist(), expected)
    if abs(length - 1) > UNIT_ROUNDING:
        normal /= length
    mirror = Mirror(normal, section.quantity("distance", "m", *DISTANCE_M))
    section.finish()
    return mirror


def _read_pattern(section: YamlSection) -> Pattern:
    pattern = Pattern(
        rows=section.integer("rows", MIN_CORNERS, MAX_CORNERS),
        cols=section.integer("cols", MIN_CORNERS, MAX_CORNERS),
        pitch=section.quantity("pitch", "m", *PITCH_M),
        corner_checker=section.choice("corner_checker", ("dark", "light")),
        points_per_segment=section.integer("points_per_segment", 0, MAX_POINTS_PER_SEGMENT),
        surface=_read_surface(section.section("surface")),
    )
    section.finish()
    if not np.isfinite(pattern.corners()).all():
        raise section.error("surface", pattern.surface.radius, "a radius that spans the pattern")
    return pattern


def _read_surface(section: YamlSection) -> PatternSurface:
    kind = section.choice("type", ("plane", "sphere_cap", "cylinder"))
    radius = math.inf if kind == "plane" else section.quantity("radius", "m", *RADIUS_M)
    axis = section.choice("axis", ("x", "y")) if kind == "cylinder" else "x"
    section.finish()
    return PatternSurface(kind, radius, axis)


def _read_elastomer(section: YamlSection, pattern: Pattern) -> Elastomer:
    size = section.quantities("size", "m", (SIDE_M,) * 3)
    layer_section = section.section("shading_layer")
    layer = ShadingLayer(
        layer_section.quantity("thickness", "m", *SKIN_M),
        layer_section.quantity("young", "Pa", *YOUNG_PA),
    )
    layer_section.finish()
    elastomer = Elastomer(
        size=(size[0], size[1], size[2]),
        young=section.quantity("young", "Pa", *YOUNG_PA),
        poisson=section.number("poisson", 0.0, 0.4999),
        model=section.choice("model", ("linear", "neo_hookean")),
        shading_layer=layer,
        relaxation=_read_relaxation(section.optional_section("relaxation")),
        calibration=_read_material(section.optional_section("calibration")),
    )
    section.finish()
    extent = ((pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch)
    if size[0] < extent[0] or size[1] < extent[1]:
        raise section.error(
            "size", list(size), f"at least the markers' {extent[0]:.6g} x {extent[1]:.6g} m"
        )
    if size[2] <= layer.thickness:
        raise section.error("size", size[2], f"a thickness above the layer's {layer.thickness}")
    return elastomer


def _read_relaxation(section: YamlSection | None) -> GelRelaxation | None:
    if section is None:
        return None
    relaxation = GelRelaxation(
        section.number("share", 0.0, 0.99), section.positive("time", MAX_RELAXATION_S)
    )
    section.finish()
    return relaxation


def _read_material(section: YamlSection | None) -> MaterialRecord | None:
    if section is None:
        return None
    record = MaterialRecord(
        method=section.choice("method", MATERIAL_METHODS),
        date=_read_date(section),
        samples=section.integer("samples", 1, MAX_CALIBRATION_FRAMES),
        normal_std=section.number("normal_std", 0.0),
        tangential_std=section.number("tangential_std", 0.0),
        young_std=_optional(section, "young_std"),
        poisson_std=_optional(section, "poisson_std"),
        determined=section.texts("determined"),
        held=section.texts("held"),
    )
    section.finish()
    return record


def _read_calibration(section: YamlSection | None) -> CalibrationRecord | None:
    if section is None:
        return None
    record = CalibrationRecord(
        method=section.choice("method", CALIBRATION_METHODS),
        date=_read_date(section),
        frames=section.integer("frames", 1, MAX_CALIBRATION_FRAMES),
        reprojection=section.number("reprojection_px", 0.0),
        ray_gap=_optional(section, "ray_gap"),
        determined=section.texts("determined"),
        held=section.texts("held"),
    )
    section.finish()
    return record


def _optional(section: YamlSection, key: str) -> float:
    """A number of at least 0; NaN where the key is absent."""
    return section.number(key, 0.0) if key in section else math.nan


def _read_date(section: YamlSection) -> str:
    text = section.text("date")
    try:
        # Python 3.10 does not read the Z.
        date = datetime.fromisoformat(text[:-1] + "+00:00" if text.endswith("Z") else text)
    except ValueError:
        date = None
    if date is None or date.utcoffset() != timedelta(0):
        raise section.error("date", text, "a date and time in UTC, as 2026-07-01T12:00:00Z")
    return text
