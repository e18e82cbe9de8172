"""Rectified images and camera models of the views, by the conventions of image_pipeline.

Camera models are written and read as YAML in the form of camera_calibration_parsers, which
camera_info_manager, and with it the camera drivers of ROS, loads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import write_whole
from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.geometry.lens import Lens, fit_stock_lens
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.split import check_image
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MAX_IMAGE_SIDE, Pattern, PatternSurface
from cmp_tactile_processing.sensor.yaml_file import (
    Part,
    YamlFile,
    choice,
    number,
    parse_yaml,
    read_yaml,
)
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

# Share of the image that is left free around the pattern at rest, both sides together.
MARGIN = 0.1
# The centre moves by 1e-4 of its distance in the second of these rounds.
CENTRE_ROUNDS = 3
ROS_MODEL = {"pinhole": "plumb_bob", "equidistant": "equidistant"}
# Where a rectified image shows nothing it takes its pixel from here, outside of every view.
NOWHERE_PX = -10000.0
# Maps are exact at every fourth pixel and bilinear between, which is good to 0.01 px.
MAP_STRIDE = 4
# Lines of the grid of points that the stock lens model of a view with layers is fitted to.
FITTED_LINES = 12
# Coefficients of the distortion models of sensor_msgs.  OpenCV's rational model may go on with
# those of a thin prism (12) and a tilted sensor (14).
DISTORTION_LENGTHS = {"plumb_bob": (5,), "equidistant": (4,), "rational_polynomial": (8, 12, 14)}
# So many may be in a file.
DISTORTION_COLS = {"plumb_bob": (4, 14), "equidistant": (4, 4), "rational_polynomial": (8, 14)}
# Files of other tools hold rotations of 6 digits or more.
ROTATION_TOLERANCE = 1e-5


@dataclass(frozen=True)
class RectifiedCamera:
    """A pinhole camera: T_rect_gel (4, 4): gel frame -> its optical frame; matrix (3, 3) px.

    baseline: along x from the left camera of the pair to this one, m; 0 for the left itself.
    """

    T_rect_gel: NDArray[np.float64]
    matrix: NDArray[np.float64]
    baseline: float = 0.0

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,), gel frame, m."""
        return np.asarray(-self.T_rect_gel[:3, :3].T @ self.T_rect_gel[:3, 3])

    @property
    def projection(self) -> NDArray[np.float64]:
        """(3, 4): points of the left camera's optical frame -> pixels of this one."""
        translation = np.array([[-self.matrix[0, 0] * self.baseline], [0.0], [0.0]])
        return np.concatenate([self.matrix, translation], axis=1)

    def project(self, p_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3), gel frame, m; NaN behind the camera."""
        return self.project_directions(p_gel - self.centre)

    def project_directions(self, v_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of viewing directions (N, 3), gel frame; NaN behind the camera."""
        v = v_gel @ self.T_rect_gel[:3, :3].T
        xy = v[:, :2] / np.where(v[:, 2:] > 0, v[:, 2:], np.nan)
        return np.asarray(xy @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def directions(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Viewing directions (N, 3), gel frame, of length 1 along the axis, of pixels (N, 2)."""
        v = np.concatenate([q, np.ones((len(q), 1))], axis=1) @ np.linalg.inv(self.matrix).T
        return np.asarray(v @ self.T_rect_gel[:3, :3])


def undistorted_camera(view: ViewGeometry) -> RectifiedCamera:
    """The pinhole camera in the place of a view's own, with its matrix."""
    return RectifiedCamera(view.T_view_gel, view.lens.matrix)


def rectified_pair(
    views: Mapping[str, ViewGeometry], points: NDArray[np.float64]
) -> dict[str, RectifiedCamera]:
    """The rectified pair of two views; points (N, 3), gel frame: what both are to show.

    x is along the baseline, z between the optical axes.  Both have one matrix: image_geometry's
    model in Python, and stereo_image_proc together with its model in C++, give wrong depths where
    the principal points differ.
    Raises InputError where one camera is behind the other, so that no such pair sees the points.
    """
    left, right = views["left"], views["right"]
    centres = {name: _effective_centre(view, points) for name, view in views.items()}
    R_rect_gel = _axes(left, right, centres["right"] - centres["left"])
    seen = {}
    for name, centre in centres.items():
        p = (points - centre) @ R_rect_gel.T
        if not p[:, 2].min() > 0:
            msg = (
                f"views: found the {name} camera beside or behind the pattern in the rectified "
                "pair, expected both cameras in front of it: check their poses"
            )
            raise InputError(msg)
        seen[name] = p[:, :2] / p[:, 2:]
    low = np.min([xy.min(axis=0) for xy in seen.values()], axis=0)
    high = np.max([xy.max(axis=0) for xy in seen.values()], axis=0)
    size = np.min([(v.placement.width, v.placement.height) for v in views.values()], axis=0)
    focal = float((size / ((high - low) * (1 + MARGIN))).min())
    for name, view in views.items():
        focal = min(focal, _same_scale(view, centres[name], points))
    cx, cy = (size - 1) / 2 - focal * (low + high) / 2
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    baseline = float(np.linalg.norm(centres["right"] - centres["left"]))
    return {
        name: RectifiedCamera(
            _pose(R_rect_gel, centre), matrix, baseline if name == "right" else 0.0
        )
        for name, centre in centres.items()
    }


def _effective_centre(view: ViewGeometry, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point (3,) that the view's rays to the points come from, behind all layers.

    Refracted rays have no common point.  This one is nearest to them all, by angle seen from the
    points, so that a pinhole there sees points near the given ones where the view does.
    """
    centre = view.centre
    if not view.layers:
        return centre
    _, v = view.rays(view.project(points))
    shown = np.isfinite(v).all(axis=1)
    v, points = v[shown], points[shown]
    across = np.eye(3) - v[:, :, None] * v[:, None, :]
    for _ in range(CENTRE_ROUNDS):
        weighted = across / ((points - centre) ** 2).sum(axis=1)[:, None, None]
        centre = np.linalg.solve(weighted.sum(axis=0), np.einsum("nij,nj->i", weighted, points))
    return np.asarray(centre)


def _axes(
    left: ViewGeometry, right: ViewGeometry, between: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(3, 3) gel frame -> rectified frame: x along the baseline, z between the optical axes."""
    x = between / np.linalg.norm(between)
    z = left.T_view_gel[2, :3] + right.T_view_gel[2, :3]
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _same_scale(
    view: ViewGeometry, centre: NDArray[np.float64], points: NDArray[np.float64]
) -> float:
    """Focal length, px, that shows the points from `centre` as large as the view does."""
    middle = points.mean(axis=0)
    farther = np.linalg.norm(middle - centre) / np.linalg.norm(middle - view.centre)
    return float(view.lens.matrix[0, 0] * farther)


def _pose(R_rect_gel: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_rect_gel, -R_rect_gel @ centre
    return T


def surface_intersection(
    origins: NDArray[np.float64], directions: NDArray[np.float64], surface: PatternSurface
) -> NDArray[np.float64]:
    """Point of the undeformed marker surface on each ray from below, (..., 3) m, gel frame.

    NaN where a ray misses the surface or is NaN.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        if surface.type == "plane":
            t = -origins[..., 2] / directions[..., 2]
        else:
            # The circle or sphere about (0, 0, -R), left by a ray through its upper half.
            curved = (
                [0, 1, 2] if surface.type == "sphere_cap" else [{"x": 1, "y": 0}[surface.axis], 2]
            )
            o, d = (origins + [0.0, 0.0, surface.radius])[..., curved], directions[..., curved]
            a, b = (d * d).sum(axis=-1), (o * d).sum(axis=-1)
            c = (o * o).sum(axis=-1) - surface.radius**2
            t = (-b + np.sqrt(b * b - a * c)) / a
        points = origins + t[..., None] * directions
        points[~((t > 0) & (points[..., 2] >= -surface.radius))] = np.nan
    return np.asarray(points)


@dataclass(frozen=True)
class ViewCameraInfo:
    """The numbers of sensor_msgs/CameraInfo: size px, model name, D, K (3, 3), R (3, 3), P (3, 4).

    The right view's P[0, 3] is -fx times the baseline in m.
    """

    width: int
    height: int
    model: str
    D: NDArray[np.float64]
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    P: NDArray[np.float64]


class Rectification:
    """Camera models of the published views, and their rectified images.

    The rectified pair are two parallel pinhole cameras of one matrix; its rows are along the
    baseline, chosen so that both images show the pattern at rest.  It serves people and other
    nodes: tracking works on the unrectified views, because interpolation costs accuracy.  Without
    refracting layers P gives the same points in 3-D as the views' own rays.

    Rays through refracting layers have no common centre, so no pinhole pair can be exact for all
    points.  Then each rectified pixel shows what the view sees of the nominal marker surface, and
    the cameras stand where those rays come from most nearly: P is exact for the surface at rest,
    and displaced points are wrong in proportion to their displacement (docs/conventions.md has
    the figures).  K, D and R of such a view are those of the stock lens model that fits best, so
    that stock nodes rectify `image_raw` nearly as here; they are not the camera's own.

    A monocular view is undistorted only.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._views = build_views(sensor)
        self._surface = sensor.pattern.surface
        if len(self._views) < 2:
            self._cameras = {name: undistorted_camera(view) for name, view in self._views.items()}
        else:
            corners = sensor.pattern.corners().reshape(-1, 3)
            self._cameras = rectified_pair(self._views, corners)
        self._refracted = len(self._views) == 2 and bool(sensor.optics.layers)
        self._info = {name: self._camera_info(name, sensor.pattern) for name in self._views}
        self._maps: dict[str, tuple[NDArray[np.int16], NDArray[np.uint16]]] = {}

    def info(self, view: str) -> ViewCameraInfo:
        """Camera model of a view; InputError where the sensor has none of that name."""
        self._camera(view)
        return self._info[view]

    def pose(self, view: str) -> NDArray[np.float64]:
        """T_rect_gel (4, 4): gel frame -> optical frame of the view's rectified camera.

        R of `info` turns the axes of the view's own camera into those of this frame.
        """
        return self._camera(view).T_rect_gel

    def rectify(self, view: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectified image of a view, same size; black where it shows nothing."""
        info = self.info(view)
        check_image(image, info.width, info.height, f"{view} view")
        if view not in self._maps:
            self._maps[view] = self._build_maps(view)
        return np.asarray(cv2.remap(image, *self._maps[view], cv2.INTER_LINEAR), dtype=np.uint8)

    def rectify_points(self, view: str, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the rectified image for pixels (..., 2) of the view.

        NaN for NaN, for what the rectified camera cannot show and, with refracting layers, for
        rays that miss the nominal marker surface.
        """
        camera, geometry = self._camera(view), self._views[view]
        flat = np.reshape(q, (-1, 2))
        if self._refracted:
            points = surface_intersection(*geometry.rays(flat), self._surface)
            q_rect = camera.project(points)
        else:
            directions = geometry.lens.directions(flat) @ geometry.T_view_gel[:3, :3]
            q_rect = camera.project_directions(directions)
        return q_rect.reshape(np.shape(q))

    def triangulate(
        self, q_left_rect: NDArray[np.float64], q_right_rect: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Points (..., 3), gel frame, m, by P alone, of pixels (..., 2) of the rectified images.

        The rows of both pixels are averaged.  NaN for NaN, and where the rays do not meet in
        front of the cameras.  Raises InputError for a monocular sensor.
        """
        left, right = self._camera("left"), self._camera("right")
        ql, qr = np.asarray(q_left_rect), np.asarray(q_right_rect)
        disparity = ql[..., 0] - qr[..., 0]
        focal, (cx, cy) = left.matrix[0, 0], left.matrix[:2, 2]
        z = focal * right.baseline / np.where(disparity > 0, disparity, np.nan)
        x, y = ql[..., 0] - cx, (ql[..., 1] + qr[..., 1]) / 2 - cy
        p_rect = np.stack([x / focal * z, y / focal * z, z], axis=-1)
        return np.asarray((p_rect - left.T_rect_gel[:3, 3]) @ left.T_rect_gel[:3, :3])

    def _camera(self, view: str) -> RectifiedCamera:
        if view not in self._cameras:
            msg = f"found no view '{view}', expected one of {', '.join(self._cameras)}"
            raise InputError(msg)
        return self._cameras[view]

    def _camera_info(self, name: str, pattern: Pattern) -> ViewCameraInfo:
        view, camera = self._views[name], self._cameras[name]
        lens, rotation = view.lens, np.eye(3)
        if len(self._views) == 2:
            rotation = camera.T_rect_gel[:3, :3] @ view.T_view_gel[:3, :3].T
        if self._refracted:
            lens, rotation = _stock_lens(view, camera, pattern, rotation)
        return ViewCameraInfo(
            width=view.placement.width,
            height=view.placement.height,
            model=ROS_MODEL[lens.model],
            D=lens.distortion,
            K=lens.matrix,
            R=rotation,
            P=camera.projection,
        )

    def _build_maps(self, name: str) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """As cv2.remap takes them, in steps of 1/32 px."""
        info = self._info[name]
        # Nodes up to the last pixel and beyond; between them the map is next to linear.
        rows, cols = info.height // MAP_STRIDE + 2, info.width // MAP_STRIDE + 2
        y, x = np.mgrid[:rows, :cols] * float(MAP_STRIDE)
        nodes = self._raw_pixels(name, np.column_stack([x.ravel(), y.ravel()]))
        y, x = np.mgrid[: info.height, : info.width].astype(np.float32) / MAP_STRIDE
        q = cv2.remap(nodes.reshape(rows, cols, 2).astype(np.float32), x, y, cv2.INTER_LINEAR)
        q = np.clip(np.nan_to_num(q, nan=NOWHERE_PX), NOWHERE_PX, -NOWHERE_PX)
        maps = cv2.convertMaps(q[..., 0], q[..., 1], cv2.CV_16SC2)
        return np.asarray(maps[0], dtype=np.int16), np.asarray(maps[1], dtype=np.uint16)

    def _raw_pixels(self, name: str, q_rect: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of the view that are shown at pixels (N, 2) of the rectified image."""
        view, camera = self._views[name], self._cameras[name]
        v = camera.directions(q_rect)
        if not self._refracted:
            return view.lens.project(v @ view.T_view_gel[:3, :3].T)
        origins = np.broadcast_to(camera.centre, v.shape)
        return view.project(surface_intersection(origins, v, self._surface))


def _stock_lens(
    view: ViewGeometry, camera: RectifiedCamera, pattern: Pattern, rotation: NDArray[np.float64]
) -> tuple[Lens, NDArray[np.float64]]:
    """Fitted where the pattern is, with the outer checkers."""
    i, j = np.linspace(-1, pattern.rows, FITTED_LINES), np.linspace(-1, pattern.cols, FITTED_LINES)
    points = pattern.at(*np.meshgrid(i, j, indexing="ij")).reshape(-1, 3)
    q = view.project(points)
    shown = np.isfinite(q).all(axis=1)
    v_rect = (points[shown] - camera.centre) @ camera.T_rect_gel[:3, :3].T
    return fit_stock_lens(view.lens, rotation, v_rect, q[shown])


def write_camera_info(path: str | Path, name: str, info: ViewCameraInfo) -> None:
    """Write the camera model of the camera of that name; the file is there whole or not at all.

    Raises InputError for a model that `read_camera_info` would refuse, and OutputError where the
    file cannot be written; then what was there stays.
    """
    text = camera_info_text(name, info)
    _camera_info_of(parse_yaml(Path(path), text))
    write_whole(Path(path), text)


def camera_info_text(name: str, info: ViewCameraInfo) -> str:
    """The file as text; `read_camera_info` gives the same model of it, to the last bit."""
    return dump_yaml(
        {
            "image_width": info.width,
            "image_height": info.height,
            "camera_name": name,
            "camera_matrix": _matrix(info.K),
            "distortion_model": info.model,
            "distortion_coefficients": _matrix(np.reshape(info.D, (1, -1))),
            "rectification_matrix": _matrix(info.R),
            "projection_matrix": _matrix(info.P),
        }
    )


def read_camera_info(path: str | Path) -> tuple[str, ViewCameraInfo]:
    """Name and model of the camera of a file.

    As camera_calibration_parsers does: a file without `camera_name` is of the camera "unknown",
    one without `distortion_model` is plumb_bob, of which k3 may be left out and zeros may follow,
    and keys that belong to other tools are let be.
    Raises InputError naming file, key, what was found and what is expected.
    """
    return _camera_info_of(read_yaml(Path(path)))


def _matrix(matrix: NDArray[np.float64]) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": matrix.ravel().tolist()}


class _Foreign(Part):
    """A part of a file in which other tools have keys of their own."""

    __pydantic_config__: ClassVar[Any] = {**Part.__pydantic_config__, "extra": "ignore"}


@dataclass(frozen=True)
class _Matrix(_Foreign):
    rows: int
    cols: int
    data: tuple[float, ...]

    def of_shape(self, rows: int, cols: int, key: str) -> NDArray[np.float64]:
        """The numbers, (rows, cols); RefusedValueError for those of another shape."""
        for name, found, wanted in (("rows", self.rows, rows), ("cols", self.cols, cols)):
            if found != wanted:
                raise RefusedValueError(str(wanted), key, name)
        if len(self.data) != rows * cols:
            raise RefusedValueError(f"a list of {rows * cols} numbers", key, "data")
        return np.array(self.data).reshape(rows, cols)


@dataclass(frozen=True)
class _PartOfImage(_Foreign):
    x_offset: int
    y_offset: int
    width: int
    height: int


@dataclass(frozen=True)
class _CameraInfoFile(_Foreign):
    image_width: int = field(metadata=number(1, MAX_IMAGE_SIDE))
    image_height: int = field(metadata=number(1, MAX_IMAGE_SIDE))
    camera_matrix: _Matrix
    distortion_coefficients: _Matrix
    rectification_matrix: _Matrix
    projection_matrix: _Matrix
    camera_name: str = "unknown"
    distortion_model: str = field(default="", metadata=choice(*DISTORTION_LENGTHS))
    camera_model: str = ""
    binning_x: int = field(default=0, metadata=number(0, 1))
    binning_y: int = field(default=0, metadata=number(0, 1))
    roi: _PartOfImage | None = None

    def checked(self) -> _CameraInfoFile:
        """The matrices are those of a camera; the image is whole."""
        info = self.info
        for key, matrix in (("camera_matrix", info.K), ("projection_matrix", info.P[:, :3])):
            if min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
                expected = "a calibrated camera: focal lengths above 0 and the last row 0 0 1"
                raise RefusedValueError(expected, key, found=matrix.tolist())
        # Nothing in a rotation is above 1; numpy would warn of what overflows.
        R = np.clip(info.R, -2.0, 2.0)
        off = float(np.abs(R @ R.T - np.eye(3)).max())
        if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            expected = f"a right-handed rotation; here R R^T is off by {off:.2g}"
            raise RefusedValueError(expected, "rectification_matrix", found=info.R.tolist())
        whole = ((0, 0, 0, 0), (0, 0, info.width, info.height))
        if self.roi is not None and astuple(self.roi) not in whole:
            expected = f"the whole image of {info.width} x {info.height} px"
            raise RefusedValueError(expected, "roi", found=list(astuple(self.roi)))
        return self

    @property
    def info(self) -> ViewCameraInfo:
        """The camera model; RefusedValueError for matrices of the wrong shape."""
        return ViewCameraInfo(
            width=self.image_width,
            height=self.image_height,
            model=self._model,
            D=self._distortion(),
            K=self.camera_matrix.of_shape(3, 3, "camera_matrix"),
            R=self.rectification_matrix.of_shape(3, 3, "rectification_matrix"),
            P=self.projection_matrix.of_shape(3, 4, "projection_matrix"),
        )

    @property
    def _model(self) -> str:
        # camera_calibration of Melodic wrote `camera_model`; another tool's may be the projection.
        earlier = self.camera_model if self.camera_model in DISTORTION_LENGTHS else "plumb_bob"
        return self.distortion_model or earlier

    def _distortion(self) -> NDArray[np.float64]:
        model, found = self._model, self.distortion_coefficients
        # Kalibr and others have no k3, the last of plumb_bob; Orbbec's drivers have k4 to k6, too.
        least, most = DISTORTION_COLS[model]
        if not least <= found.cols <= most:
            expected = str(least) if least == most else f"a whole number from {least} to {most}"
            raise RefusedValueError(expected, "distortion_coefficients", "cols")
        values = found.of_shape(1, found.cols, "distortion_coefficients")[0]
        lengths = DISTORTION_LENGTHS[model]
        length = next((length for length in lengths if length >= found.cols), lengths[-1])
        if values[length:].any():
            expected = f"0 after the {length} coefficients of {model}"
            raise RefusedValueError(expected, "distortion_coefficients", "data")
        return np.pad(values[:length], (0, max(length - found.cols, 0)))


def _camera_info_of(file: YamlFile) -> tuple[str, ViewCameraInfo]:
    found = file.read(_CameraInfoFile)
    return found.camera_name, found.info
