"""Names of the coordinate frames of a sensor, and the static transforms between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.ros.messages.making import MessageMaker
from cmp_tactile_processing.sensor.description import SensorDescription


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
