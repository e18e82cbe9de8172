"""The parts of a sensor description: camera, optics, views, pattern, elastomer, records.

The fields declare what the keys of a file may hold.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import RefusedValueError
from cmp_tactile_processing.measured import GridShape
from cmp_tactile_processing.sensor.dot_code import LARGEST_SEED, LARGEST_SHEET, dot_map
from cmp_tactile_processing.sensor.yaml_file import (
    Check,
    Limits,
    OrElse,
    Part,
    choice,
    did_you_mean,
    meant,
    number,
    positive,
    text,
)

MAX_IMAGE_SIDE = 16384
MIN_CORNERS, MAX_CORNERS, MAX_BEYOND_VIEW = 4, 60, 200
MAX_POINTS_PER_SEGMENT = 20
MAX_CALIBRATION_FRAMES = 1_000_000
CODES, FEWEST_CODED = ("none", "dots"), 42
# Beyond these it is not a gel or rig that this package can measure, but mostly another unit:
# mm for m, kPa or MPa for Pa.
PITCH_M = 1e-5, 0.05
RADIUS_M = 1e-4, 2.0
SIDE_M = 1e-4, 0.3
SKIN_M = 0.0, 0.02
YOUNG_PA = 1e3, 1e10
DISTANCE_M = -2.0, 2.0
MAX_RELAXATION_S = 1e6
MAX_FOCAL_PX = 1e6
MIDDLE_PX = -MAX_IMAGE_SIDE, 2 * MAX_IMAGE_SIDE
# So that no sum of powers overflows.
MAX_COEFFICIENT = 1e30
# Rotations and normals are written with 6 digits or more.
UNIT_TOLERANCE = 1e-5
# What is a unit vector to this is not scaled: it would change in its last bits at every reading.
UNIT_ROUNDING = 1e-15
NO_OPTICS = "none"
DISTORTION_LENGTH = {"pinhole": 5, "equidistant": 4}
SURFACE_KEYS = {
    "plane": ("type",),
    "sphere_cap": ("type", "radius"),
    "cylinder": ("type", "radius", "axis"),
}


def _not_empty(text: str) -> str:
    if not text:
        raise RefusedValueError("a text")
    return text


Texts = tuple[Annotated[str, Check(_not_empty)], ...]


@dataclass(frozen=True)
class ImageSize(Part):
    """Size of the camera frame, px.

    readout_time: from the first row to the last, s; 0 where all rows are exposed at once.
    """

    width: int = field(metadata=number(16, MAX_IMAGE_SIDE))
    height: int = field(metadata=number(16, MAX_IMAGE_SIDE))
    readout_time: float = field(default=0.0, metadata=number(0.0, 1.0, "s"))


# That of a sensor without a camera.
NO_IMAGE = ImageSize(0, 0)


@dataclass(frozen=True)
class Camera(Part):
    """Intrinsics: focal lengths and principal point in px of the whole frame.

    model: pinhole with distortion (k1, k2, p1, p2, k3), or equidistant with (k1, k2, k3, k4).
    """

    model: str = field(metadata=choice(*DISTORTION_LENGTH))
    fx: float = field(metadata=positive(MAX_FOCAL_PX, "px"))
    fy: float = field(metadata=positive(MAX_FOCAL_PX, "px"))
    cx: float = field(metadata=number(*MIDDLE_PX))
    cy: float = field(metadata=number(*MIDDLE_PX))
    distortion: tuple[Annotated[float, Limits(-MAX_COEFFICIENT, MAX_COEFFICIENT)], ...]

    def checked(self) -> Camera:
        """The coefficients are as many as the model has."""
        count = DISTORTION_LENGTH[self.model]
        if len(self.distortion) != count:
            raise RefusedValueError(f"a list of {count} numbers", "distortion")
        return self


@dataclass(frozen=True)
class RefractingLayer(Part):
    """From the plane z (gel frame, m) towards the gel the refractive index is `index`."""

    z: float = field(metadata=number(*DISTANCE_M, "m"))
    index: float = field(metadata=number(1.0, 4.0))


Row = tuple[float, float, float, float]


def _pose(given: tuple[Row, Row, Row]) -> NDArray[np.float64]:
    """A rigid motion, (4, 4), of its rows [R | t]."""
    rows = np.array(given)
    # Nothing in a rotation is above 1; numpy would warn of what overflows.
    rotation = np.clip(rows[:, :3], -2.0, 2.0)
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(rotation) < 0:
        expected = (
            "rows of [R | t] with R a right-handed rotation; here R R^T is off by "
            f"{off:.2g} and det R is {np.linalg.det(rotation):.3g}"
        )
        raise RefusedValueError(expected)
    if np.abs(rows[:, 3]).max() > DISTANCE_M[1]:
        found = rows[:, 3].tolist()
        expected = f"m, at most {DISTANCE_M[1]:g}" + meant(found, "m", *DISTANCE_M)
        raise RefusedValueError(expected, found=f"a translation of {found}")
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


Pose = Annotated[NDArray[np.float64] | None, Check(_pose, tuple[Row, Row, Row])]


@dataclass(frozen=True)
class Optics(Part):
    """How the camera sees the gel.  T_camera_gel: (4, 4), absent for two_view.

    type none: markers' positions come from elsewhere, and nothing is known of a camera.
    """

    type: str = field(metadata=choice("mirror_stereo", "two_view", "monocular", NO_OPTICS))
    T_camera_gel: Annotated[Pose, OrElse(None)]
    layers: Annotated[tuple[RefractingLayer, ...], OrElse(())]

    def checked(self) -> Optics:
        """The pose is there where the type has one; the layers are in order."""
        poseless = self.type in ("two_view", NO_OPTICS)
        if poseless != (self.T_camera_gel is None):
            expected = f"no such key for {self.type}" if poseless else "3 lists of 4 numbers"
            raise RefusedValueError(expected, "T_camera_gel")
        for place, (above, below) in enumerate(pairwise(self.layers), start=1):
            if below.z <= above.z:
                expected = f"more than {above.z} (layers in order)"
                raise RefusedValueError(expected, "layers", place, "z")
        return self


def _unit_vector(given: tuple[float, float, float]) -> NDArray[np.float64]:
    length = math.hypot(*given)
    if abs(length - 1) > UNIT_TOLERANCE:
        raise RefusedValueError(f"a unit vector; this one's length is {length:.6g}")
    normal = np.array(given)
    return normal if abs(length - 1) <= UNIT_ROUNDING else normal / length


@dataclass(frozen=True)
class Mirror(Part):
    """The plane {p : normal . p = distance} in the camera's optical frame, m; normal (3,) unit."""

    normal: Annotated[NDArray[np.float64], Check(_unit_vector, tuple[float, float, float])]
    distance: float = field(metadata=number(*DISTANCE_M, "m"))


@dataclass(frozen=True)
class Roi:
    """Part of the frame: top-left pixel (x, y) and size, px."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class ViewDescription(Part):
    """One view: its part of the frame, and the mirror or the camera of its own.

    T_view_gel: (4, 4), gel frame -> optical frame of the view's own camera.
    """

    roi: Annotated[Roi, Check(lambda given: Roi(*given), tuple[int, int, int, int])]
    mirror: Mirror | None = None
    camera: Camera | None = None
    T_view_gel: Pose = None


@dataclass(frozen=True)
class PatternSurface(Part):
    """Shape of the undeformed marker surface: height over (x, y), gel frame, apex at z = 0.

    type: plane, sphere_cap (convex towards the object) or cylinder (its axis along `axis`).
    """

    type: str = field(default="plane", metadata=choice(*SURFACE_KEYS))
    radius: float = field(default=math.inf, metadata=number(*RADIUS_M, "m"))
    axis: str = field(default="", metadata=choice("x", "y"))

    def checked(self) -> PatternSurface:
        """The keys are those of the type."""
        for key, is_given in (("radius", math.isfinite(self.radius)), ("axis", bool(self.axis))):
            if is_given != (key in SURFACE_KEYS[self.type]):
                expected = "no such key" if is_given else f"the {key}"
                raise RefusedValueError(f"{expected} of a {self.type}", key)
        return self

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height z in m at points (..., 2) in m; NaN outside the sphere or cylinder."""
        xy = np.asarray(xy, dtype=np.float64)
        if self.type == "plane":
            return np.zeros(xy.shape[:-1])
        if self.type == "sphere_cap":
            distance2 = (xy**2).sum(axis=-1)
        else:
            distance2 = xy[..., 1 if self.axis == "x" else 0] ** 2
        with np.errstate(invalid="ignore"):
            # Equal to sqrt(R^2 - d^2) - R, without its cancellation near the apex.
            return np.asarray(-distance2 / (self.radius + np.sqrt(self.radius**2 - distance2)))


@dataclass(frozen=True)
class Pattern(Part):
    """A checkerboard of rows x cols inner corners, regular in x and y with the given pitch, m.

    corner_checker: dark or light, the checker outside corner (0, 0).
    code: dots where checkers bear dots that show which ones they are, else none; code_seed: which
    of the sheets with different dots it is.
    border: in_view where the pattern ends within the view, beyond_view where it goes on, so that
    rows x cols number a part of it: with a code the middle of the largest sheet.
    """

    rows: int = field(metadata=number(MIN_CORNERS, MAX_BEYOND_VIEW))
    cols: int = field(metadata=number(MIN_CORNERS, MAX_BEYOND_VIEW))
    pitch: float = field(metadata=number(*PITCH_M, "m"))
    corner_checker: str = field(metadata=choice("dark", "light"))
    points_per_segment: Annotated[int, OrElse(6)] = field(
        metadata=number(0, MAX_POINTS_PER_SEGMENT)
    )
    surface: PatternSurface
    code: str = field(default="none", metadata=choice(*CODES))
    code_seed: int = field(default=0, metadata=number(0, LARGEST_SEED))
    border: str = field(default="in_view", metadata=choice("in_view", "beyond_view"))

    def checked(self) -> Pattern:
        """The pattern is not too large for its border, code and surface."""
        for key, count in (("rows", self.rows), ("cols", self.cols)):
            if self.border == "in_view" and count > MAX_CORNERS:
                expected = (
                    f"a whole number from {MIN_CORNERS} to {MAX_CORNERS}; with border: beyond_view "
                    f"up to {MAX_BEYOND_VIEW}"
                )
                raise RefusedValueError(expected, key)
        if self.code == "none" and self.code_seed:
            raise RefusedValueError("no such key without code: dots", "code_seed")
        if self.code == "dots" and max(self.rows, self.cols) > MAX_CORNERS:
            expected = (
                f"none, or at most {MAX_CORNERS} rows and cols: the largest sheet has "
                f"{LARGEST_SHEET} checkers along a side, too few for {self.rows} x {self.cols} "
                "corners"
            )
            raise RefusedValueError(expected, "code")
        if self.code == "dots" and (self.rows + 1) * (self.cols + 1) < FEWEST_CODED:
            expected = (
                f"none, or at least {FEWEST_CODED} checkers: with {self.rows + 1} x "
                f"{self.cols + 1}, the dots cannot be identified with certainty"
            )
            raise RefusedValueError(expected, "code")
        if not np.isfinite(self.corners()).all():
            raise RefusedValueError("a radius large enough for the pattern", "surface", "radius")
        return self

    @property
    def shape(self) -> GridShape:
        """Numbers of corners and virtual markers."""
        return GridShape(self.rows, self.cols, self.points_per_segment)

    def dots(self) -> NDArray[np.bool_]:
        """Checkers with a dot, (rows + 1, cols + 1); [0, 0] is the one outside corner (0, 0)."""
        if self.code == "none":
            return np.zeros((self.rows + 1, self.cols + 1), dtype=np.bool_)
        if self.border == "in_view":
            return dot_map(self.rows + 1, self.cols + 1, self.code_seed)
        row, col = (MAX_CORNERS - self.rows) // 2, (MAX_CORNERS - self.cols) // 2
        sheet = dot_map(LARGEST_SHEET, LARGEST_SHEET, self.code_seed)
        return sheet[row : row + self.rows + 1, col : col + self.cols + 1]

    def sheet(self, size: tuple[float, float]) -> Pattern:
        """The print that this is a part of, about the same middle: itself where it ends in view.

        It covers a skin of that size (x, y), m; with a code it ends where the largest sheet does.
        """
        if self.border == "in_view":
            return self
        more = []
        for count, extent in ((self.rows, size[1]), (self.cols, size[0])):
            most = math.inf if self.code == "none" else (MAX_CORNERS - count) // 2
            around = min((extent / self.pitch - count - 1) / 2, most)
            more.append(max(math.ceil(around), 0))
        colours = ("dark", "light") if sum(more) % 2 == 0 else ("light", "dark")
        return replace(
            self,
            rows=self.rows + 2 * more[0],
            cols=self.cols + 2 * more[1],
            corner_checker=colours[("dark", "light").index(self.corner_checker)],
        )

    def dark_checkers(self) -> NDArray[np.bool_]:
        """Checkers that are dark, (rows + 1, cols + 1), in the order of `dots`."""
        even = np.indices((self.rows + 1, self.cols + 1)).sum(axis=0) % 2 == 0
        return np.asarray(even == (self.corner_checker == "dark"))

    def checker_middles(self) -> NDArray[np.float64]:
        """Middles of all checkers at rest, x and y, (rows + 1, cols + 1, 2) m, gel frame."""
        i, j = np.mgrid[: self.rows + 1, : self.cols + 1] - 0.5
        return self.at(i, j)[..., :2]

    def corners(self) -> NDArray[np.float64]:
        """Corners at rest, (rows, cols, 3) m, gel frame."""
        i, j = np.mgrid[: self.rows, : self.cols].astype(np.float64)
        return self.at(i, j)

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the undeformed surface at fractional rows i and columns j, (..., 3) m."""
        x = (j - (self.cols - 1) / 2) * self.pitch
        y = (i - (self.rows - 1) / 2) * self.pitch
        xy = np.stack([x, y], axis=-1)
        return np.concatenate([xy, self.surface.height(xy)[..., None]], axis=-1)


@dataclass(frozen=True)
class ShadingLayer(Part):
    """The opaque skin above the marker surface: thickness in m, Young's modulus in Pa."""

    thickness: float = field(metadata=number(*SKIN_M, "m"))
    young: Annotated[float, OrElse(math.nan)] = field(metadata=number(*YOUNG_PA, "Pa"))


@dataclass(frozen=True)
class GelRelaxation(Part):
    """How the gel yields while it is held: E(t) = young (1 - share + share exp(-t / time)).

    share: of the modulus that is lost in the long run, 0 to 1; time: s.  One Prony term, the same
    for all components, so `young` is the modulus of a quick press.
    """

    share: float = field(metadata=number(0.0, 0.99))
    time: float = field(metadata=positive(MAX_RELAXATION_S, "s"))


# Python's own reader takes other forms in 3.10 than in later versions.
_DATE_UTC = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(\.\d+)?(Z|[+-]00:00)", re.ASCII)


def _date(text: str) -> str:
    found = _DATE_UTC.fullmatch(text)
    try:
        date = found and datetime.fromisoformat(found[1])
    except ValueError:
        date = None
    if date is None:
        raise RefusedValueError("a date and time in UTC, as 2026-07-01T12:00:00Z")
    return text


Date = Annotated[str, Check(_date)]


@dataclass(frozen=True)
class MaterialRecord(Part):
    """What the moduli of a description were measured with, and how well they are known.

    method: weights or force_sensor; date: ISO 8601, UTC; samples: loads that were used; source: the
    recordings of these, in words.
    young_std, poisson_std: relative and absolute standard deviation, NaN where held.
    normal_std, tangential_std: relative standard deviations of normal and tangential force that
    follow from these and from how they hang together.
    determined, held: names of the parameters that the data determined, and of those that were
    kept.
    """

    method: str = field(metadata=choice("weights", "force_sensor"))
    date: Date
    samples: int = field(metadata=number(1, MAX_CALIBRATION_FRAMES))
    normal_std: float = field(metadata=number(0.0))
    tangential_std: float = field(metadata=number(0.0))
    young_std: float = field(default=math.nan, metadata=number(0.0))
    poisson_std: float = field(default=math.nan, metadata=number(0.0))
    determined: Texts = ()
    held: Texts = ()
    source: str = field(default="", metadata=text())


Side = Annotated[float, Limits(*SIDE_M)]


@dataclass(frozen=True)
class Elastomer(Part):
    """The gel: size (x, y, thickness at the apex, shading layer included) in m, moduli in Pa."""

    size: tuple[Side, Side, Side] = field(metadata=number(unit="m"))
    young: float = field(metadata=number(*YOUNG_PA, "Pa"))
    poisson: float = field(metadata=number(0.0, 0.4999))
    model: Annotated[str, OrElse("linear")] = field(metadata=choice("linear", "neo_hookean"))
    shading_layer: Annotated[ShadingLayer, OrElse(ShadingLayer(0.0, math.nan))]
    relaxation: GelRelaxation | None = None
    calibration: MaterialRecord | None = None

    def checked(self) -> Elastomer:
        """The layer is thinner than the gel; one of thickness 0 has the gel's modulus."""
        layer = self.shading_layer
        if self.size[2] <= layer.thickness:
            expected = f"a thickness above the layer's {layer.thickness}"
            raise RefusedValueError(expected, "size", 2)
        if not math.isnan(layer.young):
            return self
        if layer.thickness:
            raise RefusedValueError("its modulus, Pa", "shading_layer", "young")
        return replace(self, shading_layer=ShadingLayer(0.0, self.young))


# Where a description states none: of the modulus, the thickness and the skin, relative, as of a gel
# that was cast by its data sheet and measured with a caliper; of Poisson's ratio, absolute.
USUAL_STD = {
    "elastomer.young": 0.05,
    "elastomer.thickness": 0.015,
    "elastomer.shading_layer": 0.1,
    "elastomer.poisson": 0.005,
    "pattern.pitch": 0.005,
}


CORRELATION_DIGITS = 9
# Optical values as RigParameters names them, without the gel's pose.
OPTICAL_VALUE = re.compile(
    r"(views\.(left|right)\.)?(camera\.(fx|fy / fx|cx|cy|distortion\[[0-4]\])"
    r"|mirror: tilt towards [xyz]|mirror\.distance)|optics\.layers\[\d+\]\.(z|index)"
)


@dataclass(frozen=True)
class Uncertainty(Part):
    """How well the values of a description are known.

    std: standard deviations by name, relative for elastomer.young, .thickness, .shading_layer,
    pattern.pitch and focal lengths, else in the value's unit; optical ones as in RigParameters.
    correlation: of these, in their order; without it they are independent.
    assumed: names of the values that nobody measured.
    """

    std: Mapping[str, Annotated[float, Limits(0.0, math.inf)]] = field(default_factory=dict)
    correlation: tuple[tuple[float, ...], ...] = ()
    assumed: Texts = ()

    def checked(self) -> Uncertainty:
        """The names are known; the correlation is one of the values that are named."""
        for name in self.std:
            if name not in USUAL_STD and not OPTICAL_VALUE.fullmatch(name):
                known = (
                    *USUAL_STD,
                    "camera.fx",
                    "camera.cx",
                    "camera.cy",
                    "optics.layers[0].index",
                )
                expected = f"no such key; known: {', '.join(known)}{did_you_mean(name, known)}"
                raise RefusedValueError(expected, "std", name)
        count, rows = len(self.std), self.correlation
        if not rows:
            return self
        if len(rows) != count or any(len(row) != count for row in rows):
            raise RefusedValueError(f"{count} lists of {count} numbers", "correlation")
        matrix = np.array(rows)
        likely = np.allclose(matrix, matrix.T) and np.allclose(np.diag(matrix), 1.0)
        if not likely or np.linalg.eigvalsh(matrix).min(initial=0.0) < -UNIT_TOLERANCE:
            expected = "a symmetric matrix with 1 on its diagonal and no negative eigenvalue"
            raise RefusedValueError(expected, "correlation")
        return self

    def of(self, name: str) -> float:
        """The standard deviation of one of USUAL_STD."""
        return self.std.get(name, USUAL_STD[name])

    def updated(self, names: Sequence[str], covariance: NDArray[np.float64]) -> Uncertainty:
        """With what a fit of some values (n,) found, (n, n); the others keep their deviations.

        The pose of the gel is left out: it is that of one gel, and changes no displacement.
        """
        kept = [k for k, name in enumerate(names) if "gel: " not in name]
        std = np.sqrt(np.diag(covariance))
        fitted = {names[k]: float(std[k]) for k in kept}
        others = {name: value for name, value in self.std.items() if name not in fitted}
        matrix = np.eye(len(fitted) + len(others))
        found = (covariance / np.outer(std, std))[np.ix_(kept, kept)]
        matrix[: len(kept), : len(kept)] = found.round(CORRELATION_DIGITS)
        assumed = tuple(name for name in self.assumed if name not in fitted)
        rows = tuple(tuple(row) for row in matrix.tolist())
        return Uncertainty({**fitted, **others}, rows, assumed)

    def covariance(self, names: Sequence[str], usual: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, n) of some values; usual (n,): their deviations where none is stated."""
        stated = list(self.std)
        std = np.array([self.std.get(name, s) for name, s in zip(names, usual, strict=True)])
        matrix = np.eye(len(names))
        known = [k for k, name in enumerate(names) if name in self.std]
        if self.correlation and known:
            at = [stated.index(names[k]) for k in known]
            matrix[np.ix_(known, known)] = np.array(self.correlation)[np.ix_(at, at)]
        return np.asarray(matrix * np.outer(std, std))


@dataclass(frozen=True)
class CalibrationRecord(Part):
    """What the optical values of a description were measured with.

    method: board or gel; date: ISO 8601, UTC; frames: used; reprojection: RMS, px; ray_gap: RMS
    length of the common normal at rest, m, NaN for one view.  determined, held: names of the
    parameters that the data determined, and of those that kept what was known before.
    """

    method: str = field(metadata=choice("board", "gel"))
    date: Date
    frames: int = field(metadata=number(1, MAX_CALIBRATION_FRAMES))
    reprojection: float = field(metadata={**number(0.0), "alias": "reprojection_px"})
    ray_gap: float = field(default=math.nan, metadata=number(0.0))
    determined: Texts = ()
    held: Texts = ()
