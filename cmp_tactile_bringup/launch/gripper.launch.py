"""The sensors of a left and a right finger: the graph `gripper`.

ros2 launch cmp_tactile_bringup gripper.launch.py left_source:=replay left_input:=my_bag rviz:=true
"""

from launch import LaunchDescription

from cmp_tactile_bringup.graphs.launch import launch_description


def generate_launch_description() -> LaunchDescription:
    """The arguments of the graph, the container with its components, and RViz if asked for."""
    return launch_description("gripper")
