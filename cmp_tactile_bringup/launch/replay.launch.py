"""Plays a recording into the processing of one sensor: the graph of config/replay.yaml.

ros2 launch cmp_tactile_bringup replay.launch.py input:=my_bag rate:=0.5 rviz:=true
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from cmp_tactile_bringup.launch_graph import argument_actions, graph_actions
from cmp_tactile_bringup.shared_files import find_config


def generate_launch_description() -> LaunchDescription:
    """The arguments that the graph declares, and the container with its components."""
    path = find_config("replay")
    return LaunchDescription(
        [*argument_actions(path), OpaqueFunction(function=graph_actions, args=[path])]
    )
