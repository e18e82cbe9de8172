"""What is tried out on one machine does not listen on the network, unless the user says so."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

import rclpy
from std_msgs.msg import String

from cmp_tactile_bringup.container.loopback import CHOICES, PROFILES, on_loopback

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Publishes, and prints the addresses that its sockets are bound to, as in /proc/net.
TALKER = """
import os, sys, time
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("talker", namespace=sys.argv[1])
publisher = node.create_publisher(String, "words", 10)
links = (f"/proc/self/fd/{name}" for name in os.listdir("/proc/self/fd"))
ours = {os.readlink(link) for link in links if os.path.islink(link)}
for kind in ("udp", "udp6", "tcp", "tcp6"):
    for row in [line.split() for line in open(f"/proc/self/net/{kind}")][1:]:
        if f"socket:[{row[9]}]" in ours:
            print(row[1].partition(":")[0])
print("end", flush=True)
while True:
    publisher.publish(String(data="hello"))
    time.sleep(0.05)
"""
LOOPBACK = "0100007F"


@pytest.fixture
def clean(monkeypatch) -> pytest.MonkeyPatch:
    for name in (*CHOICES, RANGE, "RMW_IMPLEMENTATION", "SKIP_DEFAULT_XML_FILE"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, "SYSTEM_DEFAULT"),
        ({RANGE: "SUBNET"}, "SUBNET"),
        ({"ROS_STATIC_PEERS": "192.0.2.1"}, None),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": "mine.xml", RANGE: "LOCALHOST"}, "LOCALHOST"),
        ({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", RANGE: "LOCALHOST"}, "SYSTEM_DEFAULT"),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "LOCALHOST"),
    ],
)
def test_what_the_user_chose_stays(clean, chosen, expected):
    for name, value in chosen.items():
        clean.setenv(name, value)
    before = dict(os.environ)
    with on_loopback():
        assert os.environ.get(RANGE) == expected
        added = {name: os.environ[name] for name in PROFILES if name in os.environ.keys() - before}
        is_ours = [value.endswith("/config/dds/loopback.xml") for value in added.values()]
        assert is_ours == ([True] if expected == "SYSTEM_DEFAULT" else [])
        assert before.items() - {(RANGE, chosen.get(RANGE))} <= os.environ.items()
    assert dict(os.environ) == before


@pytest.mark.ros
@pytest.mark.skipif(
    "fastrtps" not in rclpy.get_rmw_implementation_identifier(), reason="of Fast DDS"
)
def test_nothing_listens_on_the_network_and_others_of_this_machine_hear_it(ros, clean):
    heard = ros.listen(String, "words")
    with on_loopback():
        talker = subprocess.Popen(
            [sys.executable, "-c", TALKER, ros.namespace],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    try:
        assert talker.stdout is not None
        addresses = list(iter(talker.stdout.readline, "end\n"))
        assert len(addresses) >= 3
        assert {address.strip() for address in addresses} == {LOOPBACK}
        # The test's own node has ROS's defaults.
        ros.wait(lambda: heard, "a word", 60.0)
    finally:
        talker.kill()
        _, warnings = talker.communicate()
    assert warnings == ""
