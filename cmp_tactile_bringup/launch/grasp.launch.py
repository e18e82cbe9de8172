"""A gripper with two sensors that holds an object in MuJoCo: the graph `grasp`.

ros2 launch cmp_tactile_bringup grasp.launch.py scene:=cup drive:=command rviz:=true view:=true
"""

from launch import LaunchDescription

from cmp_tactile_bringup.graphs.launch import launch_description


def generate_launch_description() -> LaunchDescription:
    """The arguments of the graph, the containers with their components, page and RViz."""
    return launch_description("grasp")
