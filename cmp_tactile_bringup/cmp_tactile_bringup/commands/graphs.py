"""`cmp_tactile live`, `sensor`, `gripper`, `replay`: a graph of nodes here, until Ctrl-C."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cmp_tactile_bringup.commands.options import (
    Command,
    RecordingSensor,
    argument,
    misuse,
    option,
)
from cmp_tactile_processing.cache.files import expanded_path, split_paths

ASSIGNMENTS = (
    "NAME:=VALUE sets an argument of the launch file, such as record:=my_bag; see --show-args"
)


@dataclass(frozen=True, kw_only=True)
class GraphCommand(Command):
    """A graph of nodes, started here."""

    words: Annotated[list[str] | None, argument("[NAME:=VALUE]", ASSIGNMENTS)] = None
    show_args: Annotated[bool, option("list all arguments and end")] = False

    def _inputs(self) -> list[str]:
        """The words that assign nothing."""
        return [word for word in self.words or [] if ":=" not in word]

    def _start(self, graph: str, *more: str) -> int:
        """Start it as its launch file does."""
        from cmp_tactile_bringup.container import executables

        assigned = [word for word in self.words or [] if ":=" in word]
        show = ["--show-args"] if self.show_args else []
        return executables.standalone([graph, *more, *assigned, *show])


@dataclass(frozen=True, kw_only=True)
class Sensor(GraphCommand):
    """Start a camera and the nodes of its sensor in a component container:

      cmp_tactile sensor sensor:=my_sensor.yaml device:=/dev/video0

    Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup sensor.launch.py`, without needing
    launch; --show-args lists the arguments.
    """

    def run(self) -> int:
        """Run the graph "sensor" in this process."""
        return self._start_assigned("sensor")

    def _start_assigned(self, graph: str) -> int:
        if other := self._inputs():
            misuse(f"found {other[0]!r}, expected NAME:=VALUE")
        return self._start(graph)


@dataclass(frozen=True, kw_only=True)
class Gripper(Sensor):
    """Start the sensors of a left and a right finger, each in a separate process. The source of
    each is simulated (the default), replay, v4l2 (a camera) or topic:

      cmp_tactile gripper left_source:=v4l2 left_device:=/dev/video0 left_sensor:=left.yaml
                          right_source:=v4l2 right_device:=/dev/video2 right_sensor:=right.yaml

    Two replays begin at the same time.

    Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup gripper.launch.py`, without needing
    launch; --show-args lists the arguments.
    """

    def run(self) -> int:
        """Run the graph "gripper" in this process."""
        return self._start_assigned("gripper")


@dataclass(frozen=True, kw_only=True)
class Live(GraphCommand):
    """Start the nodes of one sensor in a component container, with a simulated sensor instead of a
    camera. Its indenter plays the scene until a target or a load comes:

      topic   NAMESPACE/indenter/target   geometry_msgs/PoseStamped, gel frame
      topic   NAMESPACE/indenter/load     geometry_msgs/WrenchStamped, gel frame, force.z < 0
      service NAMESPACE/indenter/reset    std_srvs/Trigger, back to the beginning

    Topics below NAMESPACE/truth/ have the truth of each frame. Keys on a terminal: z zeroes the
    sensor, r plays the scene from its beginning, q or Ctrl-C ends. The same as `ros2 launch
    cmp_tactile_bringup simulate.launch.py`, without needing launch.
    """

    words: Annotated[
        list[str] | None,
        argument(
            "[SCENE] [NAME:=VALUE]",
            "scene file or name of a packaged scene (default: grasp). " + ASSIGNMENTS,
        ),
    ] = None

    def run(self) -> int:
        """Run the graph "simulate" in this process."""
        scenes = self._inputs() or ["grasp"]
        if len(scenes) > 1:
            misuse(f"found {scenes[1]!r} after the scene, expected NAME:=VALUE")
        return self._start("simulate", f"scene:={scenes[0]}", "--watch")


@dataclass(frozen=True, kw_only=True)
class Replay(GraphCommand):
    """Start the nodes of one sensor in a component container and play bags, videos or folders of
    images into them. Keys on a terminal: space pauses, . shows the next frame, left and right go
    one second back or forward, z zeroes the sensor, q or Ctrl-C ends. The same as `ros2 launch
    cmp_tactile_bringup replay.launch.py`, without needing launch. To replay two fingers together,
    use `cmp_tactile gripper left_source:=replay right_source:=replay ...`.
    """

    words: Annotated[
        list[str],
        argument(
            "INPUT [NAME:=VALUE]",
            "bag, folder of images, image, video, or name of a packaged scene, such as grasp; "
            "several are played one after the other. " + ASSIGNMENTS,
        ),
    ]
    sensor: RecordingSensor = None

    def run(self) -> int:
        """Run the graph "replay" in this process."""
        from cmp_tactile_bringup.recordings.library import check_source, required_sensor
        from cmp_tactile_processing.errors import FrameSourceError

        if self.show_args:
            return self._start("replay")
        sources = [Path(word) for word in self._inputs()]
        if not sources:
            misuse("INPUT: found nothing, expected a recording")
        for source in sources:
            check_source(source)
        sensor = required_sensor(sources[0], self.sensor, *sources[1:])
        paths = [expanded_path(source) for source in sources]
        inputs = os.pathsep.join(map(str, paths))
        if split_paths(inputs) != paths:
            msg = f"{inputs}: found {os.pathsep!r} in a path, expected paths without it"
            raise FrameSourceError(msg)
        return self._start("replay", f"input:={inputs}", f"sensor:={sensor}", "--watch")
