"""A simulated sensor in place of a camera, with its processing: the graph `simulate`.

ros2 launch cmp_tactile_bringup simulate.launch.py scene:=slip rviz:=true
"""

from launch import LaunchDescription

from cmp_tactile_bringup.graphs.launch import launch_description


def generate_launch_description() -> LaunchDescription:
    """The arguments of the graph, the container with its components, and RViz if asked for."""
    return launch_description("simulate")
