"""Makes messages, of ROS's own classes for nodes or of those of `rosbags` for bags, without ROS.

Arrays are float64 in the core and float32 on the wire, and travel as whole buffers.  Here are the
names of a sensor's coordinate frames, too, and the static transforms between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing import measured
from cmp_tactile_processing.geometry.rectification import ROS_MODEL, Rectification, ViewCameraInfo
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.sensor.description import SensorDescription

if TYPE_CHECKING:  # the driver does without the room of forces
    from cmp_tactile_processing.force.grasp import GraspState

GRID = "cmp_tactile_msgs/msg/Grid"
SURFACE = "cmp_tactile_msgs/msg/Surface"
CONTACT = "cmp_tactile_msgs/msg/Contact"
FORCE_FIELD = "cmp_tactile_msgs/msg/ForceField"
GRASP_STATE = "cmp_tactile_msgs/msg/GraspState"
OUR_TYPES = GRID, SURFACE, CONTACT, FORCE_FIELD, GRASP_STATE
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
MARKER = "visualization_msgs/msg/Marker"
# Of the mesh of a held object.
MARKER_TOPIC = "/object/marker"
TRIANGLE_LIST = 11
# A symmetric (3, 3) travels as its six entries xx, xy, xz, yy, yz, zz.
UPPER_TRIANGLE = np.triu_indices(3)
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient", "friction_std")
# Points of a cloud begin at multiples of four bytes, as readers like them.
ALIGNMENT = 4
# sensor_msgs/PointField: FLOAT32, UINT8.
FIELD_TYPES = {"<f4": 7, "u1": 2}


class MessageMaker:
    """Makes messages of types such as "sensor_msgs/msg/Image".

    new: makes one from all its fields.  array: makes the value of a field without fixed length
    from a contiguous array of the field's type.
    """

    def __init__(
        self, new: Callable[..., Any], array: Callable[[NDArray[Any]], Any] = lambda values: values
    ) -> None:
        self.new, self._array = new, array

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """std_msgs/Header."""
        return self.new("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame_id)

    def time(self, stamp_ns: int) -> Any:
        """builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
        return self.new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def point(self, xyz: NDArray[np.float64], kind: str = "Point") -> Any:
        """geometry_msgs/Point, or Vector3."""
        x, y, z = xyz.tolist()
        return self.new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def quaternion(self, rotation: Rotation) -> Any:
        """geometry_msgs/Quaternion."""
        x, y, z, w = rotation.as_quat().tolist()
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(
        self, header: Any, child: str, origin: NDArray[np.float64], rotation: Rotation
    ) -> Any:
        """geometry_msgs/TransformStamped: the pose of a child in the frame of the header."""
        return self.new(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=child,
            transform=self.new(
                "geometry_msgs/msg/Transform",
                translation=self.point(origin, "Vector3"),
                rotation=self.quaternion(rotation),
            ),
        )

    def wrench(self, wrench: NDArray[np.float64]) -> Any:
        """geometry_msgs/Wrench of (6,) N and N m."""
        force, torque = (self.point(part, "Vector3") for part in np.split(wrench, 2))
        return self.new("geometry_msgs/msg/Wrench", force=force, torque=torque)

    def wrench_stamped(self, field: measured.ForceField, header: Any) -> Any:
        """geometry_msgs/WrenchStamped with the resultant of a ForceField."""
        kind = "geometry_msgs/msg/WrenchStamped"
        return self.new(kind, header=header, wrench=self.wrench(field.wrench))

    def camera_info(self, info: ViewCameraInfo, header: Any) -> Any:
        """sensor_msgs/CameraInfo, in the conventions of image_pipeline."""
        no_roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self.new(
            CAMERA_INFO,
            header=header,
            height=info.height,
            width=info.width,
            distortion_model=info.model,
            d=self._array(np.ascontiguousarray(info.D, np.float64)),
            k=info.K.ravel(),
            r=info.R.ravel(),
            p=info.P.ravel(),
            binning_x=0,
            binning_y=0,
            roi=self.new("sensor_msgs/msg/RegionOfInterest", **no_roi),
        )

    def image(self, image: NDArray[np.uint8], encoding: str, header: Any) -> Any:
        """sensor_msgs/Image, "mono8" (H, W) or "bgr8" (H, W, 3)."""
        height, width = image.shape[:2]
        return self.new(
            "sensor_msgs/msg/Image",
            header=header,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=math.prod(image.shape[1:]),
            data=self._bytes(image),
        )

    def grid(self, grid: measured.Grid, header: Any) -> Any:
        """cmp_tactile_msgs/Grid."""
        return self.new(
            GRID,
            header=header,
            **_shape(grid.shape),
            corner_px=self._floats(grid.corners),
            corner_status=self._bytes(grid.corner_status),
            row_line_px=self._floats(grid.row_lines),
            row_line_status=self._bytes(grid.row_line_status),
            col_line_px=self._floats(grid.col_lines),
            col_line_status=self._bytes(grid.col_line_status),
            corner_std_px=self._floats(grid.corner_std),
            row_line_std_px=self._floats(grid.row_line_std),
            col_line_std_px=self._floats(grid.col_line_std),
            found_fraction=grid.found_fraction,
            residual_px=float(grid.residual_px),
            confidence=float(grid.confidence),
            followed=bool(grid.followed),
            numbering=grid.numbering.value,
            fault=grid.fault.value,
            reason=grid.reason,
        )

    def surface(self, surface: measured.Surface, header: Any) -> Any:
        """cmp_tactile_msgs/Surface."""
        seen = surface.systematics
        return self.new(
            SURFACE,
            header=header,
            **_shape(surface.shape),
            reference=self._floats(surface.reference),
            position=self._floats(surface.position),
            displacement=self._floats(surface.displacement),
            status=self._bytes(surface.status),
            fault=self._bytes(surface.fault),
            covariance=self._floats(surface.covariance[..., UPPER_TRIANGLE[0], UPPER_TRIANGLE[1]]),
            ray_gap=self._floats(surface.ray_gap),
            row_position=self._floats(surface.row_position),
            row_status=self._bytes(surface.row_status),
            row_std=self._floats(surface.row_std),
            col_position=self._floats(surface.col_position),
            col_status=self._bytes(surface.col_status),
            col_std=self._floats(surface.col_std),
            reference_stamp=self.time(surface.reference_stamp_ns),
            reference_id=surface.reference_id,
            reference_faults=int(surface.reference_faults),
            systematic_bias=self._floats(None if seen is None else seen.bias),
            systematic_spread=self._floats(None if seen is None else seen.spread),
        )

    def force_field(self, field: measured.ForceField, header: Any) -> Any:
        """cmp_tactile_msgs/ForceField."""
        return self.new(
            FORCE_FIELD,
            header=header,
            rows=field.rows,
            cols=field.cols,
            position=self._floats(field.position),
            force=self._floats(field.force),
            force_std=self._floats(field.force_std),
            contact=self._bytes(field.contact),
            wrench=self.wrench(field.wrench),
            wrench_covariance=field.wrench_covariance.ravel(),
            systematic_covariance=field.systematic_covariance.ravel(),
            reference_point=self.point(field.reference_point),
            contact_area=float(field.contact_area),
            centre_of_pressure=self.point(field.centre_of_pressure),
            contacts=[self._contact(contact) for contact in field.contacts],
            flags=int(field.flags),
            **(_slip(field.slip) | {"slip_state": int(field.slip_state)}),
            valid_fraction=float(field.valid_fraction),
            regularization=float(field.regularization),
            young=float(field.young),
            poisson=float(field.poisson),
            noise_scale=float(field.noise_scale),
            corrected=bool(field.corrected),
            relaxed=bool(field.relaxed),
        )

    def grasp_state(self, state: GraspState, header: Any) -> Any:
        """cmp_tactile_msgs/GraspState."""
        values = {item.name: getattr(state, item.name) for item in fields(state)}
        vectors = {
            name: self.point(values[name], "Vector3") for name in ("grip_axis", "load_across")
        }
        values |= {
            **vectors,
            "centre_of_contact": self.point(state.centre_of_contact),
            "load": self.wrench(state.load),
            "load_covariance": state.load_covariance.ravel(),
            "slip_state": int(state.slip_state),
            "flags": int(state.flags),
        }
        return self.new(GRASP_STATE, header=header, usable=state.usable, **values)

    def _contact(self, contact: measured.Contact) -> Any:
        return self.new(
            CONTACT,
            nodes=self._array(np.ascontiguousarray(contact.nodes, np.uint16)),
            wrench=self.wrench(contact.wrench),
            wrench_covariance=contact.covariance.ravel(),
            area=float(contact.area),
            centre_of_pressure=self.point(contact.centre_of_pressure),
            outline=self._floats(contact.outline),
            at_border=bool(contact.at_border),
            **_slip(contact.slip),
        )

    def cloud(
        self,
        header: Any,
        positions: NDArray[np.float64],
        vectors: NDArray[np.float64],
        vector_fields: tuple[str, str, str],
        status: NDArray[np.uint8] | None = None,
    ) -> Any:
        """sensor_msgs/PointCloud2 of height rows and width cols, with one vector per point.

        positions, vectors: (rows, cols, 3) in the frame of the header.  status (rows, cols), where
        given, becomes the field `status`, uint8.  NaN stays, and makes the cloud not dense.
        """
        columns: list[NDArray[Any]] = [*np.moveaxis(positions, -1, 0), *np.moveaxis(vectors, -1, 0)]
        names, formats = ["x", "y", "z", *vector_fields], ["<f4"] * len(columns)
        if status is not None:
            names, formats, columns = [*names, "status"], [*formats, "u1"], [*columns, status]
        sizes = [np.dtype(form).itemsize for form in formats]
        offsets = [int(start) for start in np.cumsum([0, *sizes[:-1]])]
        step = -(-sum(sizes) // ALIGNMENT) * ALIGNMENT
        rows, cols = positions.shape[:2]
        layout = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": step}
        )
        points: NDArray[Any] = np.zeros((rows, cols), layout)
        for name, column in zip(names, columns, strict=True):
            points[name] = column
        return self.new(
            "sensor_msgs/msg/PointCloud2",
            header=header,
            height=rows,
            width=cols,
            fields=[
                self.new(
                    "sensor_msgs/msg/PointField",
                    name=name,
                    offset=offset,
                    datatype=FIELD_TYPES[form],
                    count=1,
                )
                for name, offset, form in zip(names, offsets, formats, strict=True)
            ],
            is_bigendian=False,
            point_step=step,
            row_step=cols * step,
            data=self._array(points.ravel().view(np.uint8)),
            is_dense=bool(np.isfinite(positions).all() and np.isfinite(vectors).all()),
        )

    def triangles(
        self, triangles: NDArray[np.float64], colour: tuple[int, int, int], header: Any
    ) -> Any:
        """visualization_msgs/Marker of triangles (n, 3, 3) m, fixed to the frame of the header.

        colour: red, green, blue, 0 to 255.
        """
        no_data = self._bytes(np.zeros(0, np.uint8))
        red, green, blue = (part / 255 for part in colour)
        place = self.new(
            "geometry_msgs/msg/Pose",
            position=self.point(np.zeros(3)),
            orientation=self.quaternion(Rotation.identity()),
        )
        return self.new(
            MARKER,
            header=header,
            ns=header.frame_id,
            id=0,
            type=TRIANGLE_LIST,
            action=0,
            pose=place,
            scale=self.point(np.ones(3), "Vector3"),
            color=self.new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            lifetime=self.new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=True,
            points=[self.point(corner) for corner in triangles.reshape(-1, 3)],
            colors=[],
            texture_resource="",
            texture=self.new(
                "sensor_msgs/msg/CompressedImage", header=header, format="", data=no_data
            ),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=self.new("visualization_msgs/msg/MeshFile", filename="", data=no_data),
            mesh_use_embedded_materials=False,
        )

    def _floats(self, values: NDArray[Any] | None) -> Any:
        """Values as float32; empty where nothing is known."""
        known = () if values is None else values
        return self._array(np.ascontiguousarray(known, np.float32).ravel())

    def _bytes(self, values: NDArray[Any]) -> Any:
        return self._array(np.ascontiguousarray(values, np.uint8).ravel())


def encoding_of(image: NDArray[np.uint8]) -> str:
    """The ROS name of the pixel format of (H, W) or (H, W, 3) uint8."""
    return "mono8" if image.ndim == 2 else "bgr8"


def whole_frame_info(sensor: SensorDescription) -> ViewCameraInfo:
    """The calibration of the whole frame, unrectified.

    A sensor with a camera per view has none: its K is zero, which ROS reads as uncalibrated.
    """
    size, camera = sensor.frame_size, sensor.camera
    if camera is None:
        zero = np.zeros((3, 3))
        return ViewCameraInfo(*size, "", np.zeros(0), zero, zero, np.zeros((3, 4)))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    P = np.column_stack([K, np.zeros(3)])
    return ViewCameraInfo(
        *size, ROS_MODEL[camera.model], np.array(camera.distortion), K, np.eye(3), P
    )


def _slip(slip: measured.SlipEstimate) -> dict[str, float]:
    figures = {name: float(getattr(slip, name)) for name in SLIP_FIGURES}
    return {"slip_state": int(slip.state), **figures}


def _shape(shape: measured.GridShape) -> dict[str, int]:
    return {
        "rows": shape.rows,
        "cols": shape.cols,
        "points_per_segment": shape.points_per_segment,
    }


def _named(sensor: SensorDescription, frame: str) -> str:
    """Frames of all sensors share one tree: each begins with the name of its sensor."""
    return f"{sensor.ros_name}_{frame}"


def gel_frame(sensor: SensorDescription) -> str:
    """The frame of the gel: origin at the apex of the undeformed surface, z towards the object."""
    return _named(sensor, "gel_frame")


def camera_frame(sensor: SensorDescription) -> str:
    """The optical frame of the one real camera."""
    return _named(sensor, "camera_optical_frame")


def view_frame(sensor: SensorDescription, view: str) -> str:
    """The optical frame of a view: in its virtual camera, turned as its rectified image is.

    Nodes of ROS take what they make of rectified images for points of the optical frame, and R of
    camera_info for the rotation from the view as published into it.
    """
    return _named(sensor, f"{view}_optical_frame")


def rectified_frame(sensor: SensorDescription, view: str) -> str:
    """The frame that camera_info and rectified image of a view carry.

    For both views of a pair it is the left one's: P of the right view takes points of that frame.
    """
    return view_frame(sensor, "left" if "left" in sensor.views else view)


def sensor_frames(sensor: SensorDescription) -> list[str]:
    """All frames of the sensor that tf knows, the gel's first."""
    frames = [view_frame(sensor, name) for name in sensor.views]
    if sensor.optics.T_camera_gel is not None:
        frames.append(camera_frame(sensor))
    return [gel_frame(sensor), *sorted(frames)]


def static_transforms(
    make: MessageMaker, sensor: SensorDescription, rectification: Rectification
) -> list[Any]:
    """From the gel frame to each optical frame, as TransformStamped with stamp 0."""
    poses = {view_frame(sensor, name): rectification.pose(name) for name in sensor.views}
    if sensor.optics.T_camera_gel is not None:
        poses[camera_frame(sensor)] = sensor.optics.T_camera_gel
    header = make.header(0, gel_frame(sensor))
    # A TransformStamped maps points of the child into the parent.
    inverse = {child: np.linalg.inv(T).astype(np.float64) for child, T in sorted(poses.items())}
    return [
        make.transform(header, child, T[:3, 3], Rotation.from_matrix(T[:3, :3]))
        for child, T in inverse.items()
    ]
