"""A simulated sensor in place of a camera, with its processing: the graph of config/live.yaml.

ros2 launch cmp_tactile_bringup live.launch.py scene:=slip rviz:=true
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from cmp_tactile_bringup.launch_graph import argument_actions, graph_actions
from cmp_tactile_bringup.shared_files import find_config


def generate_launch_description() -> LaunchDescription:
    """The arguments that the graph declares, and the container with its components."""
    path = find_config("live")
    return LaunchDescription(
        [*argument_actions(path), OpaqueFunction(function=graph_actions, args=[path])]
    )
