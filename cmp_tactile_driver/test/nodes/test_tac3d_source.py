"""What a Tac3D sensor sends is published as surfaces, through real ROS.

The vendor's client needs the vendor's program; a stand-in with its interface sends the frames.
"""

import sys
from types import ModuleType

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

from geometry_msgs.msg import WrenchStamped

from cmp_tactile_driver.nodes.tac3d_source import Tac3dSource
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.ros.messages.reading import surface_from_msg
from cmp_tactile_processing.sensor.description import load_sensor

PRESSED_MM = np.array([0.0, 0.1, -0.3])


class Client:
    """As PyTac3D.Sensor: calls back with each frame, on a thread of its own."""

    def __init__(self, recvCallback, port):
        self.callback, self.port = recvCallback, port
        MADE.append(self)


# Clients that were made, the newest last.
MADE: list[Client] = []


@pytest.fixture
def client(monkeypatch):
    """Stands for the vendor's module."""
    module = ModuleType("PyTac3D")
    module.Sensor = Client
    monkeypatch.setitem(sys.modules, "PyTac3D", module)
    MADE.clear()
    return Client


def frame(pressed, serial="AD2-0001L"):
    """As the sensor sends it: mm, marker 0 at the largest y and x."""
    rest = 1e3 * load_sensor("tac3d_ad2").pattern.corners()[::-1, ::-1].reshape(400, 3)
    moved = np.zeros((400, 3))
    moved[0] = PRESSED_MM if pressed else 0.0
    return {
        "SN": serial,
        "index": 1,
        "sendTimestamp": 1.0,
        "3D_Positions": rest + [0.0, 0.0, 11.4] + moved,
        "3D_Displacements": moved,
        "3D_ResultantForce": np.array([[0.0, 0.0, -2.0]]),
        "3D_ResultantMoment": np.array([[0.0, 10.0, 0.0]]),
    }


def test_frames_become_surfaces_in_the_gel_frame(ros, client):
    surfaces, wrenches = (
        ros.listen(SurfaceMsg, "surface"),
        ros.listen(WrenchStamped, "tac3d/wrench"),
    )
    node = ros.start(Tac3dSource, sensor_description="tac3d_ad2", serial="AD2-0001L")
    ros.wait_subscribed(node, "surface", "tac3d/wrench")
    send = MADE[0].callback
    for sent in (
        frame(pressed=False),
        {"SN": "AD2-0001L"},
        frame(pressed=False, serial="another"),
        frame(pressed=True),
    ):
        send(sent, None)
    ros.wait(lambda: len(surfaces) == len(wrenches) == 2, "two frames")
    pattern = load_sensor("tac3d_ad2").pattern
    surface = surface_from_msg(surfaces[-1], pattern.shape)
    assert surface.displacement[-1, -1] == pytest.approx(1e-3 * PRESSED_MM, abs=1e-8)
    assert np.abs(surface.displacement[:-1]).max() < 1e-8
    assert surface.reference[..., :2] == pytest.approx(pattern.corners()[..., :2], abs=1e-6)
    wrench = wrenches[-1].wrench
    assert (wrench.force.z, wrench.torque.y) == pytest.approx((-2.0, 0.01), abs=1e-3)
    assert MADE[0].port == 9988
    assert node.diagnostics.bad_frames == 1


def test_a_first_frame_that_lacks_markers_says_nothing_of_where_the_gel_is(ros, client):
    surfaces = ros.listen(SurfaceMsg, "surface")
    node = ros.start(Tac3dSource, sensor_description="tac3d_ad2")
    ros.wait_subscribed(node, "surface")
    torn = frame(pressed=False)
    torn["3D_Positions"] = torn["3D_Positions"].copy()
    torn["3D_Positions"][7] = np.nan
    MADE[0].callback(torn, None)
    MADE[0].callback(frame(pressed=False) | {"3D_ResultantForce": None}, None)
    ros.wait(lambda: len(surfaces) == 1, "a surface")
    assert np.isfinite(surfaces[0].position).all()
    assert node.diagnostics.bad_frames == 1


def test_a_description_that_is_not_there_is_named(ros, client):
    with pytest.raises(InputError, match="nowhere"):
        ros.start(Tac3dSource, sensor_description="/nowhere.yaml")


def test_without_the_vendors_client_the_error_says_how_to_get_it(ros, monkeypatch):
    monkeypatch.setitem(sys.modules, "PyTac3D", None)
    with pytest.raises(FrameSourceError, match="pip install PyTac3D"):
        ros.start(Tac3dSource, sensor_description="tac3d_ad2")


def test_frames_that_come_after_the_end_are_passed_over(ros, client):
    node = ros.start(Tac3dSource, sensor_description="tac3d_ad2")
    node.destroy_node()
    MADE[0].callback(frame(pressed=True))
    assert not node.diagnostics.bad_frames
