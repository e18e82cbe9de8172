"""A camera and the processing of its sensor: the graph `sensor`.

ros2 launch cmp_tactile_bringup sensor.launch.py sensor:=my_sensor.yaml device:=/dev/video0
"""

from launch import LaunchDescription

from cmp_tactile_bringup.graphs.launch import launch_description


def generate_launch_description() -> LaunchDescription:
    """The arguments of the graph, the container with its components, and RViz if asked for."""
    return launch_description("sensor")
