"""A node in a process of its own is killed and started again: the chain goes on.

These processes take UDP alone, as docs/network.md advises for nodes that may be killed: what
Fast DDS 3.2 has sent to a reader that was killed can stay in the shared memory of the sending
process (512 kB) and keep its other readers from getting anything (eProsima/Fast-DDS 5469).
"""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

import cv2
from ros_graph import header_at, stamps_of
from sensor_msgs.msg import Image
from waiting import wait_until

from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.nodes.gridline_tracker import GridlineTracker
from cmp_tactile_processing.ros.messages.conversions import image_to_msg
from cmp_tactile_processing.ros.messages.reading import stamp_ns

pytestmark = pytest.mark.ros

REST = Path(__file__).parents[1] / "cmp_tactile_processing" / "test" / "data" / "rest.png"
REST_FRAMES = 4


class Chain:
    """Splitter and triangulator in processes of their own, the trackers in this one."""

    def __init__(self, ros):
        self._ros = ros
        self._processes = {}
        for view in ("left", "right"):
            ros.start(GridlineTracker, name=f"{view}_tracker", view=view)
        self._image = cv2.imread(str(REST), cv2.IMREAD_GRAYSCALE)
        self.camera = ros.node.create_publisher(Image, "image_raw", 10)
        self.surfaces = ros.listen(Surface, "surface")
        self.references = ros.listen(Surface, "reference", latched=True)
        self._number = 0

    def start(self, node, **parameters):
        """Start a node."""
        arguments = ["-r", f"__ns:={self._ros.namespace}"]
        for name, value in {"sensor_description": "sample_rig", **parameters}.items():
            arguments += ["-p", f"{name}:={value}"]
        module = f"cmp_tactile_processing.nodes.{node}"
        self._processes[node] = subprocess.Popen(
            [sys.executable, "-m", module, "--ros-args", *arguments],
            env={**os.environ, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
        )

    def send_until_seen(self, what):
        """Send frames until the last one comes out: then all nodes have found one another.

        Returns their stamps.  One that is sent while they do may be lost.
        """
        begin, sent = len(self.surfaces), []
        wait_until(
            lambda: len(self.surfaces) > begin and self.seen()[-1] == sent[-1],
            what,
            step=lambda: sent.extend(self.send(1, 0.4)),
        )
        return sent

    def kill(self, node):
        """As if it had crashed: it says goodbye to nobody."""
        process = self._processes.pop(node)
        process.kill()
        process.wait()

    def send(self, count, interval_s=0.05):
        """Send frames; their stamps in s."""
        sent = []
        for _ in range(count):
            self._number += 1
            stamp = self._number * 10**9
            self.camera.publish(image_to_msg(self._image, "mono8", header_at(stamp)))
            sent.append(self._number)
            self._ros.run(interval_s)
        return sent

    def seen(self):
        """Stamps of the surfaces, s."""
        return [stamp // 10**9 for stamp in stamps_of(self.surfaces)]

    def close(self):
        for node in list(self._processes):
            self.kill(node)


@pytest.fixture
def chain(ros):
    chain = Chain(ros)
    yield chain
    chain.close()


def test_killed_nodes_come_back_and_report_their_reference(ros, chain):
    options = {"rest_frames": REST_FRAMES, "reference_frames": REST_FRAMES}
    chain.start("view_splitter")
    chain.start("stereo_triangulator", **options)
    chain.send_until_seen("surfaces")
    sent = chain.send(REST_FRAMES + 2)
    ros.wait(lambda: chain.seen()[-1] == sent[-1], "the reference")
    assert chain.surfaces[-1].reference_id == 1
    ros.wait(lambda: chain.references[-1].reference_id == 1, "the reference")

    chain.kill("view_splitter")
    chain.send(2)
    chain.start("view_splitter")
    chain.send_until_seen("surfaces after the splitter's end")
    sent = chain.send(3)
    ros.wait(lambda: chain.seen()[-1] == sent[-1], "surfaces of all frames")
    assert chain.seen()[-3:] == sent
    # The reference is the triangulator's.
    assert {surface.reference_id for surface in chain.surfaces[-3:]} == {1}

    before, begin = len(chain.references), len(chain.surfaces)
    chain.kill("stereo_triangulator")
    chain.send(2)
    chain.start("stereo_triangulator", **options)
    ros.wait(lambda: len(chain.references) > before, "the report of the reference that is lost")
    assert chain.references[before].reference_id == 0
    first = chain.send_until_seen("surfaces after the triangulator's end")
    sent = chain.send(REST_FRAMES + 2)
    ros.wait(lambda: chain.seen()[-1] == sent[-1], "surfaces of all frames")
    assert chain.seen()[-len(sent) :] == sent
    ids = [surface.reference_id for surface in chain.surfaces[begin:]]
    assert ids[0] == 0
    assert ids[-1] == 1
    ros.wait(lambda: chain.references[-1].reference_id == 1, "the new reference")
    assert stamp_ns(chain.references[-1].header.stamp) // 10**9 in first + sent
    assert max(Counter(chain.seen()).values()) == 1
