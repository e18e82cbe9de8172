"""Node: serves a page in the browser for sensors that run."""

from __future__ import annotations

import os
import signal
import sys
import threading
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.cache.files import split_paths
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.ros.base_nodes import ReportingNode
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_viewer.nodes.controls import RunningSensor
from cmp_tactile_viewer.nodes.live_sensors import LiveSensors
from cmp_tactile_viewer.page.page import Page
from cmp_tactile_viewer.page.server import DEFAULT_PORT, Access
from cmp_tactile_viewer.snapshot import Pose, ShownSensor

END_WITH_STDIN = "--end-with-stdin"


@dataclass(frozen=True)
class WebViewerParameters(Parameters):
    """What the page shows, and to whom."""

    sensors: str = parameter(
        "", "namespaces of the sensors, separated by spaces; empty: the node's own"
    )
    sensor_descriptions: str = parameter(
        "sample_rig", "descriptions of the sensors, files or packaged names, separated by colons"
    )
    sensor_names: str = parameter(
        "", "names of the sensors, separated by spaces; empty for those of the descriptions"
    )
    mounts: str = parameter(
        "",
        "poses of the gel frames in the scene, x y z in m and roll pitch yaw in rad, separated by "
        "commas; empty: all at the origin",
    )
    grasp: str = parameter(
        "", "topic of the grasp's state, to show grip, margin and weight; empty for none"
    )
    scene_frame: str = parameter(
        "",
        "tf frame, such as world, in which gels and a held object are shown where tf has them; "
        "empty: all at their mounts",
    )
    host: str = parameter("127.0.0.1", "address to listen on; 0.0.0.0 for all interfaces")
    port: int = parameter(
        0, f"port to listen on; 0 for the first free one from {DEFAULT_PORT}", within=(0, 65535)
    )
    token: str = parameter(
        "", "secret word that the address of the page must contain; empty for none"
    )
    allow_hosts: str = parameter(
        "",
        "further host names of this machine, separated by spaces, such as that of a proxy",
    )
    read_only: bool = parameter(False, "page without buttons and parameters")
    max_rate: float = parameter(
        30.0, "highest rate at which the page is drawn", unit="Hz", within=(0.1, 120.0)
    )


class WebViewer(ReportingNode):
    """Shows sensors in a browser: surface, force, contacts, camera image, plots, health, buttons.

    The log and the diagnostics give the address of the page.  Its buttons call the services of the
    sensor's nodes; `indenter/target` moves a simulated indenter.
    Run it in a separate process, so that it takes no time from the sensor's nodes.
    While a browser looks, it subscribes to `surface`, `force_field`, `left/grid`, `right/grid` and
    `image_raw` of each sensor, and to `/diagnostics`.  If more messages come than `max_rate`, it
    reads only the newest.
    With `scene_frame` it subscribes to `/tf`, `/tf_static` and `/object/marker` too: gels move as
    their frames do, and the triangles of the marker are drawn as the object that they hold.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("web_viewer", **node_kwargs)
        with self.destroyed_on_error():
            own = declare_parameters(self, WebViewerParameters())
            sensors = running_sensors(own, self.get_namespace())
            self._live = LiveSensors(self, sensors, own.max_rate, own.grasp, own.scene_frame)
            access = Access(
                own.host,
                own.port or None,
                own.token,
                own.read_only,
                tuple(own.allow_hosts.split()),
            )
            self.page = Page(self._live, access, own.max_rate)
            self.start_reporting()
            self.warn_of_unknown_parameters()
        self.get_logger().info(f"open {self.page.url} in a browser")
        if not access.is_local and not access.read_only:
            who = "anyone who has this address" if access.token else "anyone on that network"
            where = f"{access.host}, port {self.page.port}"
            self.get_logger().warning(f"listening on {where}: {who} can press the buttons")

    def destroy_node(self) -> None:
        """End the page, then destroy the node."""
        page = getattr(self, "page", None)
        if page is not None:
            page.close()
        super().destroy_node()

    def _status(self) -> DiagnosticStatus:
        values = {"address": self.page.url, "browsers": self.page.viewers}
        return self.status_of("", values, [], f"{self.page.viewers} browsers show the page")


def running_sensors(given: WebViewerParameters, namespace: str) -> list[RunningSensor]:
    """The sensors that the parameters name; InputError where their numbers differ."""
    spaces = given.sensors.split() or [namespace.rstrip("/")]
    files = [str(path) for path in split_paths(given.sensor_descriptions)]
    names = given.sensor_names.split() or [""] * len(spaces)
    mounts = [_pose(item) for item in given.mounts.split(",") if item.strip()]
    mounts = mounts or [(0.0,) * 6] * len(spaces)
    for what, found in (
        ("sensor_descriptions", files), ("sensor_names", names), ("mounts", mounts)
    ):  # fmt: skip
        if len(found) != len(spaces):
            msg = (
                f"parameter {what}: found {len(found)}, expected {len(spaces)}, one for each sensor"
            )
            raise InputError(msg)
    return [_running(*item) for item in zip(spaces, files, names, mounts, strict=True)]


def _running(namespace: str, file: str, name: str, mount: tuple[float, ...]) -> RunningSensor:
    description = load_sensor(file, name)
    x, y, z, w = Rotation.from_euler("xyz", mount[3:]).as_quat().tolist()
    pose = Pose((mount[0], mount[1], mount[2]), (w, x, y, z))
    shown = ShownSensor(name or description.ros_name, description, pose)
    return RunningSensor(f"/{namespace.strip('/')}", file, name, shown)


def _pose(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        msg = f"parameter mounts: found {text!r}, expected six numbers, x y z roll pitch yaw"
        raise InputError(msg)
    return numbers


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_viewer web_viewer`.

    With the argument --end-with-stdin it ends with the process that holds the other end.
    """
    if END_WITH_STDIN in sys.argv:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
    return run_node(WebViewer)


def _end_with_stdin() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
