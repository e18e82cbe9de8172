"""CameraInfo messages of the views."""

from __future__ import annotations

from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from cmp_tactile_processing.geometry.rectification import ViewCameraInfo

__all__ = ["camera_info_to_msg"]


def camera_info_to_msg(info: ViewCameraInfo, header: Header) -> CameraInfo:
    """The message of a view's calibration, in the conventions of image_pipeline."""
    return CameraInfo(
        header=header,
        width=info.width,
        height=info.height,
        distortion_model=info.model,
        d=[float(value) for value in info.D],
        k=info.K.ravel().tolist(),
        r=info.R.ravel().tolist(),
        p=info.P.ravel().tolist(),
    )
