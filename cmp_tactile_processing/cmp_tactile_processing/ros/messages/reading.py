"""The core's dataclasses and images from messages, of ROS or of `rosbags`.

Reading checks the size of every array against the sensor's grid, and that coordinates and status
agree, before anything is reshaped: InputError names field, found and expected.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum, IntEnum
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing import measured
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.geometry.split import LUMINANCE
from cmp_tactile_processing.image.encodings import BitDepth, decode_compressed, decode_raw
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.messages.making import SLIP_FIGURES

Name = TypeVar("Name", bound=Enum)
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# A plain number: NumPy looks for long what an enumeration's member may be.
MISSING = int(measured.Status.MISSING)


def stamp_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def camera_info_from_msg(msg: Any) -> ViewCameraInfo:
    """The numbers of a sensor_msgs/CameraInfo."""
    K, R, P = (np.array(values, np.float64).reshape(3, -1) for values in (msg.k, msg.r, msg.p))
    D = np.array(msg.d, np.float64)
    return ViewCameraInfo(msg.width, msg.height, msg.distortion_model, D, K, R, P)


def image_camera_info_from_msg(msg: Any) -> ViewCameraInfo:
    """As `camera_info_from_msg`, but of the image: size and K of its window (roi), after binning.

    P stays that of the whole sensor chip.
    """
    info, roi = camera_info_from_msg(msg), msg.roi
    bins = np.array([max(msg.binning_x, 1), max(msg.binning_y, 1)])
    size = np.array([roi.width or msg.width, roi.height or msg.height]) // bins
    K = info.K.copy()
    # The centre of the first binned pixel is not that of the first pixel.
    K[:2, 2] += 0.5 - np.array([roi.x_offset, roi.y_offset])
    K[:2] /= bins[:, None]
    K[:2, 2] -= 0.5
    return replace(info, width=int(size[0]), height=int(size[1]), K=K if info.K.any() else info.K)


def grid_from_msg(
    msg: Any, shape: measured.GridShape, placement: measured.ViewPlacement | None = None
) -> measured.Grid:
    """The Grid of a message; InputError unless it has the given shape and is consistent."""
    check_shape(measured.GridShape(msg.rows, msg.cols, msg.points_per_segment), shape)
    grid = measured.Grid(
        shape=shape,
        corners=_read_points(msg, "corner_px", (*shape.corners, 2)),
        corner_status=_read_status(msg, "corner_status", shape.corners),
        row_lines=_read_points(msg, "row_line_px", (*shape.row_lines, 2)),
        row_line_status=_read_status(msg, "row_line_status", shape.row_lines),
        col_lines=_read_points(msg, "col_line_px", (*shape.col_lines, 2)),
        col_line_status=_read_status(msg, "col_line_status", shape.col_lines),
        residual_px=float(msg.residual_px),
        reason=msg.reason,
        placement=placement,
        fault=_read_named(msg, "fault", measured.GridFault),
        corner_std=_read_deviations(msg, "corner_std_px", shape.corners),
        row_line_std=_read_deviations(msg, "row_line_std_px", shape.row_lines),
        col_line_std=_read_deviations(msg, "col_line_std_px", shape.col_lines),
        confidence=float(msg.confidence),
        followed=bool(msg.followed),
        numbering=_read_named(msg, "numbering", measured.NumberingKind),
    )
    _check_consistent("corner_px", grid.corners, grid.corner_status)
    _check_consistent("row_line_px", grid.row_lines, grid.row_line_status)
    _check_consistent("col_line_px", grid.col_lines, grid.col_line_status)
    return grid


def surface_from_msg(msg: Any, shape: measured.GridShape) -> measured.Surface:
    """The Surface of a message; InputError unless it has the given shape and is consistent."""
    check_shape(measured.GridShape(msg.rows, msg.cols, msg.points_per_segment), shape)
    surface = measured.Surface(
        shape=shape,
        reference=_read_points(msg, "reference", (*shape.corners, 3)),
        position=_read_points(msg, "position", (*shape.corners, 3)),
        displacement=_read_points(msg, "displacement", (*shape.corners, 3)),
        status=_read_status(msg, "status", shape.corners),
        fault=_read_codes(msg, "fault", shape.corners, measured.MarkerFault),
        covariance=_read_points(msg, "covariance", (*shape.corners, 6))[..., SYMMETRIC],
        ray_gap=_read_points(msg, "ray_gap", shape.corners),
        row_position=_read_points(msg, "row_position", (*shape.row_lines, 3)),
        row_status=_read_status(msg, "row_status", shape.row_lines),
        row_std=_read_points(msg, "row_std", shape.row_lines),
        col_position=_read_points(msg, "col_position", (*shape.col_lines, 3)),
        col_status=_read_status(msg, "col_status", shape.col_lines),
        col_std=_read_points(msg, "col_std", shape.col_lines),
        reference_id=msg.reference_id,
        reference_stamp_ns=stamp_ns(msg.reference_stamp),
        reference_faults=measured.ReferenceFault(getattr(msg, "reference_faults", 0)),
        systematics=_read_systematics(msg),
    )
    # One view alone gives no z, and a marker without a reference has a position all the same.
    _check_seen("position", surface.position[..., :2], surface.status)
    _check_consistent("displacement", surface.displacement[..., :2], surface.status)
    _check_seen("row_position", surface.row_position[..., :2], surface.row_status)
    _check_seen("col_position", surface.col_position[..., :2], surface.col_status)
    return surface


def force_field_from_msg(msg: Any) -> measured.ForceField:
    """The ForceField of a message; InputError unless its arrays belong together."""
    nodes = msg.rows * msg.cols
    slip = _read_slip(msg, "")
    return measured.ForceField(
        rows=msg.rows,
        cols=msg.cols,
        position=_read_points(msg, "position", (nodes, 3)),
        force=_read_points(msg, "force", (nodes, 3)),
        force_std=_read_deviations(msg, "force_std", (nodes, 3)),
        contact=_read_array(msg, "contact", np.uint8, (nodes,)) != 0,
        wrench=_six(msg.wrench),
        wrench_covariance=np.array(msg.wrench_covariance).reshape(6, 6),
        systematic_covariance=_read_systematic_covariance(msg),
        contact_area=msg.contact_area,
        centre_of_pressure=_xyz(msg.centre_of_pressure),
        reference_point=_xyz(msg.reference_point),
        contacts=tuple(
            _contact_from_msg(item, nodes, f"contacts[{index}].")
            for index, item in enumerate(msg.contacts)
        ),
        flags=measured.ForceFlag(msg.flags),
        slip=slip,
        slip_state=slip.state,
        valid_fraction=msg.valid_fraction,
        regularization=msg.regularization,
        young=msg.young,
        poisson=msg.poisson,
        noise_scale=msg.noise_scale,
        corrected=msg.corrected,
        relaxed=msg.relaxed,
    )


def _contact_from_msg(msg: Any, nodes: int, owner: str) -> measured.Contact:
    numbers = np.array(msg.nodes, np.intp)
    if (numbers >= nodes).any():
        text = f"{owner}nodes: found {numbers.max()}, expected numbers below {nodes}"
        raise InputError(text)
    return measured.Contact(
        nodes=numbers,
        wrench=_six(msg.wrench),
        covariance=np.array(msg.wrench_covariance).reshape(6, 6),
        area=msg.area,
        centre_of_pressure=_xyz(msg.centre_of_pressure),
        outline=np.array(msg.outline, np.float64).reshape(-1, 3),
        at_border=msg.at_border,
        slip=_read_slip(msg, owner),
    )


def _read_systematics(msg: Any) -> measured.Systematics | None:
    """Recordings of earlier versions have none."""
    if not len(getattr(msg, "systematic_bias", ())):
        return None
    shape = (measured.Systematics.COMPONENTS,) * 2
    return measured.Systematics(
        _read_points(msg, "systematic_bias", shape), _read_points(msg, "systematic_spread", shape)
    )


def _read_systematic_covariance(msg: Any) -> NDArray[np.float64]:
    values = getattr(msg, "systematic_covariance", np.full(36, math.nan))
    return np.array(values, np.float64).reshape(6, 6)


def _read_slip(msg: Any, owner: str) -> measured.SlipEstimate:
    if msg.slip_state not in list(measured.SlipState):
        text = f"{owner}slip_state: found {msg.slip_state}, expected one of SLIP_* (0 to 4)"
        raise InputError(text)
    figures = {name: getattr(msg, name) for name in SLIP_FIGURES}
    return measured.SlipEstimate(measured.SlipState(msg.slip_state), **figures)


def image_from_msg(
    msg: Any,
    weights: tuple[float, float, float] | None = LUMINANCE,
    depth: BitDepth | None = None,
) -> NDArray[np.uint8]:
    """Image of an Image or CompressedImage: grey (H, W) uint8, or BGR (H, W, 3) where in colours.

    weights: of red, green and blue in the grey value that is made of it, None for no grey value.
    YUV and Bayer are read as grey where luminance is all that is asked of them.  depth: of the
    topic; absent for an image by itself.
    Raises FrameError, as decode_raw and decode_compressed.
    """
    data = np.frombuffer(msg.data, np.uint8)
    if hasattr(msg, "format"):
        return decode_compressed(msg.format, data, depth)
    return decode_raw(
        (msg.width, msg.height),
        msg.encoding,
        msg.step,
        data,
        big_endian=bool(msg.is_bigendian),
        luminance=weights == LUMINANCE,
        depth=depth,
    )


def check_shape(found: measured.GridShape, shape: measured.GridShape) -> None:
    """Raise InputError where what came is of another pattern than the sensor's."""
    if found != shape:
        text = f"rows, cols, points_per_segment: found {_words(found)}, expected {_words(shape)}"
        raise InputError(text)


def _words(shape: measured.GridShape) -> str:
    return f"{shape.rows}, {shape.cols}, {shape.points_per_segment}"


def _read_named(msg: Any, field: str, names: type[Name]) -> Name:
    """A field with the name of an enumeration's member; the first where it is not there.

    Recordings of earlier versions lack the later fields.
    """
    found = getattr(msg, field, next(iter(names)).value)
    try:
        return names(found)
    except ValueError:
        known = ", ".join(repr(item.value) for item in names)
        text = f"{field}: found {found!r}, expected one of {known}"
        raise InputError(text) from None


def _xyz(point: Any) -> NDArray[np.float64]:
    return np.array([point.x, point.y, point.z])


def _six(wrench: Any) -> NDArray[np.float64]:
    return np.concatenate([_xyz(wrench.force), _xyz(wrench.torque)])


def _read_array(msg: Any, name: str, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Field `name` in the given shape; InputError for another number of values."""
    values = np.frombuffer(getattr(msg, name), dtype=dtype)
    if values.size != math.prod(shape):
        sides = " x ".join(str(side) for side in shape)
        text = f"{name}: found {values.size} values, expected {math.prod(shape)} ({sides})"
        raise InputError(text)
    return values.reshape(shape)


def _read_points(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """A float32 field as float64."""
    return _read_array(msg, name, np.float32, shape).astype(np.float64)


def _read_status(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A field of status codes; InputError for an unknown one."""
    return _read_codes(msg, name, shape, measured.Status)


def _read_codes(
    msg: Any, name: str, shape: tuple[int, ...], known: type[IntEnum]
) -> NDArray[np.uint8]:
    """A field of codes of an enumeration; InputError for an unknown one."""
    codes = _read_array(msg, name, np.uint8, shape)
    if codes.size and int(codes.max()) > _last_code(known):
        names = ", ".join(f"{item.value} ({item.name.lower()})" for item in known)
        text = f"{name}: found code {codes.max()}, expected one of {names}"
        raise InputError(text)
    return codes.copy()


def _read_deviations(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Standard deviations; None where the sender knew none and left the array empty."""
    if not len(getattr(msg, name)):
        return None
    return _read_points(msg, name, shape)


def _check_seen(name: str, points: NDArray[np.float64], status: NDArray[np.uint8]) -> None:
    """Raise InputError where a point that is not missing has no coordinates."""
    bad = (status != MISSING) & ~_in_all(np.isfinite(points))
    if bad.any():
        count = np.count_nonzero(bad)
        text = f"{name}: found NaN or inf at {count} points whose status is not 0, expected numbers"
        raise InputError(text)


def _check_consistent(name: str, points: NDArray[np.float64], status: NDArray[np.uint8]) -> None:
    """Raise InputError where status and coordinates do not agree."""
    _check_seen(name, points, status)
    bad = (status == MISSING) & ~_in_all(np.isnan(points))
    if bad.any():
        count = np.count_nonzero(bad)
        text = f"{name}: found numbers at {count} points whose status is 0 (missing), expected NaN"
        raise InputError(text)


def _in_all(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What holds for all components (..., k): ten times as quick as all(axis=-1) of so few."""
    whole = holds[..., 0]
    for component in range(1, holds.shape[-1]):
        whole = whole & holds[..., component]
    return whole


@cache
def _last_code(known: type[IntEnum]) -> int:
    return int(max(known))
