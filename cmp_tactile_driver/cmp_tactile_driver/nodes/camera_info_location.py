"""The file that a camera_info_url names, as camera_info_manager reads it."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import unquote

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from cmp_tactile_processing.errors import ParameterError

__all__ = ["camera_info_path"]

EXPECTED = "file://PATH or package://PACKAGE/PATH"


def camera_info_path(url: str, camera_name: str) -> Path | None:
    """The path; None for an empty URL.  ${NAME} is the camera's, ${ROS_HOME} as ROS has it.

    Raises ParameterError for another kind of URL and for a package that is not there.
    """
    if not url:
        return None
    home = os.environ.get("ROS_HOME") or str(Path.home() / ".ros")
    text = url.replace("${NAME}", camera_name).replace("${ROS_HOME}", home)
    scheme, separator, rest = text.partition("://")
    rest = unquote(rest)
    if separator and scheme == "file" and rest.startswith("/"):
        return Path(rest)
    package, _, path = rest.partition("/")
    if separator and scheme == "package" and package and path:
        try:
            return Path(get_package_share_directory(package)) / path
        except (PackageNotFoundError, ValueError):
            msg = f"camera_driver.camera_info_url: found no package {package!r} for {url!r}"
            raise ParameterError(msg) from None
    msg = f"camera_driver.camera_info_url: found {url!r}, expected {EXPECTED}"
    raise ParameterError(msg)
