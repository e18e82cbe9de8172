"""Plays a recording into the processing of one sensor: the graph `replay`.

ros2 launch cmp_tactile_bringup replay.launch.py input:=my_bag rate:=0.5 rviz:=true
"""

from launch import LaunchDescription

from cmp_tactile_bringup.graphs.launch import launch_description


def generate_launch_description() -> LaunchDescription:
    """The arguments of the graph, the container with its components, and RViz if asked for."""
    return launch_description("replay")
