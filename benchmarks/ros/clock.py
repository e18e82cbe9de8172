#!/usr/bin/env python3
"""What simulated time costs a container: processor time beside that of plain rclpy nodes.

    setup/run python3 benchmarks/ros/clock.py

The nodes of one sensor wait for frames that never come, while /clock has 0, 100 and 1000 messages a
second; beside them as many empty nodes of rclpy in its own executor.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

sys.path.insert(0, str(Path(__file__).parents[1]))
from real_time import busy_s
from tables import CommandLine, head, line

RATES_HZ = (0, 100, 1000)
NODES = 7
SENSOR = "sample_rig"
MEASURED_S = 10.0
STARTING_S = 120.0
OURS = [
    *(sys.executable, "-m", "cmp_tactile_bringup.container.executables", "standalone", "sensor"),
    *(f"sensor:={SENSOR}", "source:=topic", "use_sim_time:=true"),
]
EMPTY_NODES = f"""
import rclpy
from rclpy.executors import SingleThreadedExecutor

rclpy.init()
executor = SingleThreadedExecutor()
for number in range({NODES}):
    executor.add_node(rclpy.create_node(f"empty_{{number}}"))
executor.spin()
"""
PLAIN = [sys.executable, "-c", EMPTY_NODES, "--ros-args", "-p", "use_sim_time:=true"]


def publish(node: Node, publisher: Publisher[Clock], rate: int, duration_s: float) -> None:
    """Simulated time at this rate, or none at 0."""
    begin = time.monotonic()
    number = 0
    while (passed := time.monotonic() - begin) < duration_s:
        if rate:
            publisher.publish(Clock(clock=node.get_clock().now().to_msg()))
        number += 1
        time.sleep(max(0.0, number / (rate or 10) - passed))


def shares(command: list[str], nodes: int) -> list[float]:
    """Share of a processor at each rate."""
    node = rclpy.create_node("clock_of_benchmark")
    publisher = node.create_publisher(Clock, "/clock", 10)
    found = []
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
        end = time.monotonic() + STARTING_S
        while len(node.get_node_names()) < nodes:
            if time.monotonic() > end:
                sys.exit(f"found no {nodes - 1} nodes within {STARTING_S:g} s")
            time.sleep(0.5)
        # So that work done once at the start is not measured.
        publish(node, publisher, RATES_HZ[1], MEASURED_S / 2)
        for rate in RATES_HZ:
            before = busy_s(running.pid)
            publish(node, publisher, rate, MEASURED_S)
            found.append((busy_s(running.pid) - before) / MEASURED_S)
        running.terminate()
    node.destroy_node()
    return found


def main() -> None:
    """Print the table."""
    CommandLine(__doc__).parse_args()
    rclpy.init()
    print(head("share of a processor", *(f"{rate} Hz" for rate in RATES_HZ)))
    for name, command in ((f"{NODES} nodes of rclpy, empty", PLAIN), ("nodes of a sensor", OURS)):
        print(line(name, *(f"{share:.2f}" for share in shares(command, NODES + 1))), flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
