"""Messages from the core's dataclasses and back: float64 in the core, float32 on the wire.

Arrays cross as whole buffers, never point by point.  Reading checks the size of every array
against the sensor's grid, and that coordinates and status tell the same story, before anything
is reshaped: GeometryError names field, found and expected.
"""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3, Wrench, WrenchStamped
from numpy.typing import NDArray
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Contact as ContactMsg
from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured.force_field import (
    Contact,
    ForceField,
    ForceFlag,
    SlipEstimate,
    SlipState,
)
from cmp_tactile_processing.measured.grid import Grid, GridFault, GridShape, ViewPlacement
from cmp_tactile_processing.measured.markers_3d import MarkerFault
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.ros.messages.arrays import (
    byte_array,
    check_consistent,
    check_seen,
    float_array,
    known_float_array,
    read_array,
    read_codes,
    read_deviations,
    read_points,
    read_status,
)

__all__ = [
    "force_field_from_msg",
    "force_field_to_msg",
    "grid_from_msg",
    "grid_to_msg",
    "header_at",
    "stamp_ns",
    "surface_from_msg",
    "surface_to_msg",
    "wrench_to_msg",
]

NS_PER_S = 1_000_000_000
# A symmetric (3, 3) travels as its six entries xx, xy, xz, yy, yz, zz.
UPPER_TRIANGLE = np.triu_indices(3)
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient", "friction_std")


def stamp_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header_at(stamp: Any, frame_id: str) -> Header:
    """A header with the stamp of an input message and a frame of its own."""
    return Header(stamp=stamp, frame_id=frame_id)


def grid_to_msg(grid: Grid, header: Header) -> GridMsg:
    """The message of a Grid."""
    msg = _with_shape(GridMsg(header=header), grid.shape)
    msg.corner_px = float_array(grid.corners)
    msg.corner_status = byte_array(grid.corner_status)
    msg.row_line_px = float_array(grid.row_lines)
    msg.row_line_status = byte_array(grid.row_line_status)
    msg.col_line_px = float_array(grid.col_lines)
    msg.col_line_status = byte_array(grid.col_line_status)
    msg.corner_std_px = known_float_array(grid.corner_std)
    msg.row_line_std_px = known_float_array(grid.row_line_std)
    msg.col_line_std_px = known_float_array(grid.col_line_std)
    msg.found_fraction = grid.found_fraction
    msg.residual_px = float(grid.residual_px)
    msg.confidence = float(grid.confidence)
    msg.followed = bool(grid.followed)
    msg.fault = grid.fault.value
    msg.reason = grid.reason
    return msg


def grid_from_msg(msg: GridMsg, shape: GridShape, placement: ViewPlacement | None = None) -> Grid:
    """The Grid of a message; GeometryError unless it has the given shape and is consistent."""
    _check_shape(msg, shape)
    grid = Grid(
        shape=shape,
        corners=read_points(msg, "corner_px", (*shape.corners, 2)),
        corner_status=read_status(msg, "corner_status", shape.corners),
        row_lines=read_points(msg, "row_line_px", (*shape.row_lines, 2)),
        row_line_status=read_status(msg, "row_line_status", shape.row_lines),
        col_lines=read_points(msg, "col_line_px", (*shape.col_lines, 2)),
        col_line_status=read_status(msg, "col_line_status", shape.col_lines),
        residual_px=float(msg.residual_px),
        reason=msg.reason,
        placement=placement,
        fault=_read_fault(msg),
        corner_std=read_deviations(msg, "corner_std_px", shape.corners),
        row_line_std=read_deviations(msg, "row_line_std_px", shape.row_lines),
        col_line_std=read_deviations(msg, "col_line_std_px", shape.col_lines),
        confidence=_read_confidence(msg),
        followed=bool(msg.followed),
    )
    check_consistent("corner_px", grid.corners, grid.corner_status)
    check_consistent("row_line_px", grid.row_lines, grid.row_line_status)
    check_consistent("col_line_px", grid.col_lines, grid.col_line_status)
    return grid


def surface_to_msg(surface: Surface, header: Header) -> SurfaceMsg:
    """The message of a Surface."""
    msg = _with_shape(SurfaceMsg(header=header), surface.shape)
    msg.reference = float_array(surface.reference)
    msg.position = float_array(surface.position)
    msg.displacement = float_array(surface.displacement)
    msg.status = byte_array(surface.status)
    msg.fault = byte_array(surface.fault)
    msg.covariance = float_array(surface.covariance[..., UPPER_TRIANGLE[0], UPPER_TRIANGLE[1]])
    msg.ray_gap = float_array(surface.ray_gap)
    msg.row_position = float_array(surface.row_position)
    msg.row_status = byte_array(surface.row_status)
    msg.row_std = float_array(surface.row_std)
    msg.col_position = float_array(surface.col_position)
    msg.col_status = byte_array(surface.col_status)
    msg.col_std = float_array(surface.col_std)
    msg.reference_stamp.sec, msg.reference_stamp.nanosec = divmod(
        surface.reference_stamp_ns, NS_PER_S
    )
    msg.reference_id = surface.reference_id
    return msg


def surface_from_msg(msg: SurfaceMsg, shape: GridShape) -> Surface:
    """The Surface of a message; GeometryError unless it has the given shape and is consistent."""
    _check_shape(msg, shape)
    surface = Surface(
        shape=shape,
        reference=read_points(msg, "reference", (*shape.corners, 3)),
        position=read_points(msg, "position", (*shape.corners, 3)),
        displacement=read_points(msg, "displacement", (*shape.corners, 3)),
        status=read_status(msg, "status", shape.corners),
        fault=read_codes(msg, "fault", shape.corners, MarkerFault),
        covariance=read_points(msg, "covariance", (*shape.corners, 6))[..., SYMMETRIC],
        ray_gap=read_points(msg, "ray_gap", shape.corners),
        row_position=read_points(msg, "row_position", (*shape.row_lines, 3)),
        row_status=read_status(msg, "row_status", shape.row_lines),
        row_std=read_points(msg, "row_std", shape.row_lines),
        col_position=read_points(msg, "col_position", (*shape.col_lines, 3)),
        col_status=read_status(msg, "col_status", shape.col_lines),
        col_std=read_points(msg, "col_std", shape.col_lines),
        reference_id=msg.reference_id,
        reference_stamp_ns=stamp_ns(msg.reference_stamp),
    )
    # One view alone gives no z, and a marker without a reference has a position all the same.
    check_seen("position", surface.position[..., :2], surface.status)
    check_consistent("displacement", surface.displacement[..., :2], surface.status)
    check_seen("row_position", surface.row_position[..., :2], surface.row_status)
    check_seen("col_position", surface.col_position[..., :2], surface.col_status)
    return surface


def force_field_to_msg(field: ForceField, header: Header) -> ForceFieldMsg:
    """The message of a ForceField."""
    msg = ForceFieldMsg(header=header, rows=field.rows, cols=field.cols)
    msg.position = float_array(field.position)
    msg.force = float_array(field.force)
    msg.force_std = known_float_array(field.force_std)
    msg.contact = byte_array(field.contact)
    msg.wrench = _wrench(field.wrench)
    msg.wrench_covariance = field.wrench_covariance.ravel()
    msg.reference_point = _point(field.reference_point)
    msg.contact_area = float(field.contact_area)
    msg.centre_of_pressure = _point(field.centre_of_pressure)
    msg.contacts = [_contact_to_msg(contact) for contact in field.contacts]
    msg.flags = int(field.flags)
    _write_slip(field.slip, msg)
    msg.slip_state = int(field.slip_state)
    msg.valid_fraction = float(field.valid_fraction)
    msg.regularization = float(field.regularization)
    msg.young = float(field.young)
    msg.poisson = float(field.poisson)
    msg.noise_scale = float(field.noise_scale)
    msg.corrected = bool(field.corrected)
    msg.relaxed = bool(field.relaxed)
    return msg


def _contact_to_msg(contact: Contact) -> ContactMsg:
    msg = ContactMsg()
    msg.nodes = array.array("H", contact.nodes.tolist())
    msg.wrench = _wrench(contact.wrench)
    msg.wrench_covariance = contact.covariance.ravel()
    msg.area = float(contact.area)
    msg.centre_of_pressure = _point(contact.centre_of_pressure)
    msg.outline = float_array(contact.outline)
    msg.at_border = bool(contact.at_border)
    _write_slip(contact.slip, msg)
    return msg


def _write_slip(slip: SlipEstimate, msg: ForceFieldMsg | ContactMsg) -> None:
    msg.slip_state = int(slip.state)
    for name in SLIP_FIGURES:
        setattr(msg, name, float(getattr(slip, name)))


def force_field_from_msg(msg: ForceFieldMsg) -> ForceField:
    """The ForceField of a message; GeometryError unless its arrays belong together."""
    nodes = msg.rows * msg.cols
    slip = _read_slip(msg, "")
    return ForceField(
        rows=msg.rows,
        cols=msg.cols,
        position=read_points(msg, "position", (nodes, 3)),
        force=read_points(msg, "force", (nodes, 3)),
        force_std=read_deviations(msg, "force_std", (nodes, 3)),
        contact=read_array(msg, "contact", np.uint8, (nodes,)) != 0,
        wrench=_six(msg.wrench),
        wrench_covariance=np.array(msg.wrench_covariance).reshape(6, 6),
        contact_area=msg.contact_area,
        centre_of_pressure=_xyz(msg.centre_of_pressure),
        reference_point=_xyz(msg.reference_point),
        contacts=tuple(
            _contact_from_msg(item, nodes, f"contacts[{index}].")
            for index, item in enumerate(msg.contacts)
        ),
        flags=ForceFlag(msg.flags),
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


def _contact_from_msg(msg: ContactMsg, nodes: int, owner: str) -> Contact:
    numbers = np.array(msg.nodes, np.intp)
    if (numbers >= nodes).any():
        text = f"{owner}nodes: found {numbers.max()}, expected numbers below {nodes}"
        raise GeometryError(text)
    if len(msg.outline) % 3:
        text = f"{owner}outline: found {len(msg.outline)} values, expected a multiple of 3"
        raise GeometryError(text)
    return Contact(
        nodes=numbers,
        wrench=_six(msg.wrench),
        covariance=np.array(msg.wrench_covariance).reshape(6, 6),
        area=msg.area,
        centre_of_pressure=_xyz(msg.centre_of_pressure),
        outline=np.array(msg.outline, np.float64).reshape(-1, 3),
        at_border=msg.at_border,
        slip=_read_slip(msg, owner),
    )


def _read_slip(msg: ForceFieldMsg | ContactMsg, owner: str) -> SlipEstimate:
    if msg.slip_state not in list(SlipState):
        text = f"{owner}slip_state: found {msg.slip_state}, expected one of SLIP_* (0 to 4)"
        raise GeometryError(text)
    figures = {name: getattr(msg, name) for name in SLIP_FIGURES}
    return SlipEstimate(SlipState(msg.slip_state), **figures)


def wrench_to_msg(field: ForceField, header: Header) -> WrenchStamped:
    """The resultant of a ForceField as a WrenchStamped."""
    return WrenchStamped(header=header, wrench=_wrench(field.wrench))


def _with_shape(msg: Any, shape: GridShape) -> Any:
    msg.rows, msg.cols, msg.points_per_segment = shape.rows, shape.cols, shape.points_per_segment
    return msg


def _check_shape(msg: Any, shape: GridShape) -> None:
    found = GridShape(msg.rows, msg.cols, msg.points_per_segment)
    if found != shape:
        text = f"rows, cols, points_per_segment: found {_words(found)}, expected {_words(shape)}"
        raise GeometryError(text)


def _words(shape: GridShape) -> str:
    return f"{shape.rows}, {shape.cols}, {shape.points_per_segment}"


def _read_fault(msg: Any) -> GridFault:
    try:
        return GridFault(msg.fault)
    except ValueError:
        known = ", ".join(repr(item.value) for item in GridFault)
        text = f"fault: found {msg.fault!r}, expected one of {known}"
        raise GeometryError(text) from None


def _read_confidence(msg: Any) -> float:
    if not math.isnan(msg.confidence) and not 0 <= msg.confidence <= 1:
        text = f"confidence: found {msg.confidence:g}, expected 0 to 1, or NaN"
        raise GeometryError(text)
    return float(msg.confidence)


def _point(xyz: NDArray[np.float64]) -> Point:
    x, y, z = xyz.tolist()
    return Point(x=x, y=y, z=z)


def _xyz(point: Any) -> NDArray[np.float64]:
    return np.array([point.x, point.y, point.z])


def _six(wrench: Wrench) -> NDArray[np.float64]:
    return np.concatenate([_xyz(wrench.force), _xyz(wrench.torque)])


def _wrench(wrench: NDArray[np.float64]) -> Wrench:
    fx, fy, fz, tx, ty, tz = wrench.tolist()
    return Wrench(force=Vector3(x=fx, y=fy, z=fz), torque=Vector3(x=tx, y=ty, z=tz))
