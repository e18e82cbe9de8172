"""Node: the markers of a running Tac3D sensor as surfaces."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped

from cmp_tactile_driver.sources.tac3d import RunningTac3d
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.ros.base_nodes import StageNode
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.sensor.parameters import Parameters, parameter


@dataclass(frozen=True)
class Tac3dSourceParameters(Parameters):
    """Parameters of the node tac3d_source, beside those that say of which sensor it is."""

    port: int = parameter(
        9988, "UDP port to which the sensor's program sends frames", within=(1, 65535)
    )
    serial: str = parameter(
        "", "serial number of the sensor, if several send to that port; empty for any"
    )


class Tac3dSource(StageNode):
    """Publishes what the vendor's client, PyTac3D, receives: `surface` and `tac3d/wrench`.

    Stamps are those of arrival.  Raises FrameSourceError where PyTac3D is not installed.
    """

    default_name = "tac3d_source"

    def __init__(self, **node_kwargs: Any) -> None:
        # Frames come on a thread of the client's, which nothing ends.
        self._at_work, self._ended = threading.Lock(), False
        super().__init__(**node_kwargs)

    def _set_up(self) -> None:
        self._options = declare_parameters(self, Tac3dSourceParameters())
        shape = self.sensor.pattern.shape
        self._running = RunningTac3d(shape.corners)
        self._surface = self.add_result(SurfaceMsg, "surface", conversions.surface_to_msg)
        self._wrench = self.add_publisher(WrenchStamped, "tac3d/wrench")
        self._client = _client()(recvCallback=self._on_frame, port=self._options.port)

    def destroy_node(self) -> None:
        """Take no frame any more, then destroy the node."""
        with self._at_work:
            self._ended = True
        super().destroy_node()

    def _on_frame(self, frame: Mapping[str, Any], _: object = None) -> None:
        with self._at_work:
            if self._ended or self._options.serial not in ("", frame.get("SN")):
                return
            self.diagnostics.frames_in += 1
            self._run_guarded("PyTac3D", self._publish, frame)

    def _publish(self, frame: Mapping[str, Any]) -> None:
        reference, position, wrench = self._running.read(frame)
        stamp = self.get_clock().now().to_msg()
        header = conversions.header_at(stamp, gel_frame(self.sensor))
        surface = Surface.from_positions(self.sensor.pattern.shape, reference, position)
        self._surface.publish(surface, header)
        if np.isfinite(wrench).all():
            message = WrenchStamped(header=header, wrench=conversions.ROS_MESSAGES.wrench(wrench))
            self._wrench.publish(message)
        self.frame_out(header)


def _client() -> Any:
    """The class of PyTac3D that receives frames."""
    try:
        # Of all who use the driver only those with such a sensor want it: it brings a 3-D viewer.
        return import_module("PyTac3D").Sensor
    except ImportError as error:
        msg = f"PyTac3D: found none ({error}), expected the vendor's client: pip install PyTac3D"
        raise FrameSourceError(msg) from None


def main() -> int:
    """Run the node as a process."""
    return run_node(Tac3dSource)


if __name__ == "__main__":
    sys.exit(main())
