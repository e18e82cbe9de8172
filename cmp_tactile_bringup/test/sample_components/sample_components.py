"""Components for the tests of the container, good and bad."""

import sys
import threading
import time

from rclpy.node import Node
from std_msgs.msg import String

from cmp_tactile_processing.ros.wiring import WiredNode


class Echo(Node):
    """Sends back what it hears, after its prefix."""

    def __init__(self, **node_kwargs):
        super().__init__("echo", **node_kwargs)
        self._prefix = self.declare_parameter("prefix", "").value
        self.declare_parameter("numbers", [0.0])
        self._publisher = self.create_publisher(String, "out", 10)
        self.create_subscription(String, "in", self._on_text, 10)

    def _on_text(self, message):
        self._publisher.publish(String(data=self._prefix + message.data))


class Slow(Node):
    """Takes its time to be built."""

    def __init__(self, **node_kwargs):
        super().__init__("slow", **node_kwargs)
        time.sleep(self.declare_parameter("seconds", 1.0).value)


class FailsHalfWay(Node):
    """Raises once its node exists."""

    def __init__(self, **node_kwargs):
        super().__init__("fails_half_way", **node_kwargs)
        raise ValueError("no gel on this sensor")


class Exits(Node):
    """Asks for the end of the process."""

    def __init__(self, **node_kwargs):
        super().__init__("exits", **node_kwargs)
        sys.exit("not here")


class Raises(Echo):
    """Raises at every message that starts with `bad`, asks for the end at `quit`, echoes others."""

    def _on_text(self, message):
        if message.data == "quit":
            sys.exit("enough")
        if message.data.startswith("bad"):
            raise RuntimeError(f"cannot bear {message.data}")
        super()._on_text(message)


class Ticker(Node):
    """Publishes at 200 Hz."""

    def __init__(self, **node_kwargs):
        super().__init__("ticker", **node_kwargs)
        self._publisher = self.create_publisher(String, "ticks", 10)
        self.create_timer(0.005, lambda: self._publisher.publish(String(data="tick")))


class Sticks(Node):
    """Its callback takes its time."""

    began = threading.Event()

    def __init__(self, **node_kwargs):
        super().__init__("sticks", **node_kwargs)
        self.began.clear()
        self._seconds = self.declare_parameter("seconds", 1.0).value
        self.create_timer(0.01, self._stick)

    def _stick(self):
        self.began.set()
        time.sleep(self._seconds)


class EndsRos(Node):
    """Ends the ROS context of the process, as a node that is done may do."""

    def __init__(self, **node_kwargs):
        super().__init__("ends_ros", **node_kwargs)
        self.create_timer(0.1, self.context.shutdown)


class NoNode:
    """Not a node."""


class Wired(WiredNode):
    """One of a sensor's nodes, which does nothing."""

    def __init__(self, **node_kwargs):
        super().__init__("wired", **node_kwargs)
