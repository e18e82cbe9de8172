"""`cmp_tactile live`, `sensor`, `gripper`, `replay`: a graph of nodes here, until Ctrl-C."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cmp_tactile_bringup.commands.options import (
    Command,
    Number,
    RecordingSensor,
    argument,
    misuse,
    option,
    parameter_option,
)
from cmp_tactile_driver.sources.parameters import ReplayParameters

_setting = partial(parameter_option, ReplayParameters)
# Options that are arguments of the launch file.
SAME_NAMES = ("start", "end", "paused", "rate", "loop", "topic", "namespace")
ASSIGNMENTS = (
    "NAME:=VALUE sets an argument of the launch file, such as record:=my_bag; see --show-args"
)


@dataclass(frozen=True, kw_only=True)
class _Graph(Command):
    words: Annotated[list[str] | None, argument("[NAME:=VALUE]", ASSIGNMENTS)] = None
    set_: Annotated[
        list[str] | None,
        option(
            "set a parameter of a component; may be repeated",
            metavar="COMPONENT.PARAMETER=VALUE",
        ),
    ] = None
    show_args: Annotated[bool, option("list all arguments and end")] = False

    def _inputs(self) -> list[str]:
        """The words that assign nothing."""
        return [word for word in self.words or [] if ":=" not in word]

    def _start(self, graph: str, values: Mapping[str, Any], **how: bool) -> int:
        """Start it as its launch file does; values: left out where empty."""
        from cmp_tactile_bringup.container import executables

        texts = {
            name: str(value).lower() if isinstance(value, bool) else value
            for name, value in values.items()
        }
        given = [f"{name}:={text}" for name, text in texts.items() if text not in {"", None}]
        assigned = [word for word in self.words or [] if ":=" in word]
        settings = [word for setting in self.set_ or [] for word in ("--set", setting)]
        show = ["--show-args"] if self.show_args else []
        watch = ["--watch"] if values else []
        return executables.standalone([graph, *given, *assigned, *watch, *settings, *show], **how)


@dataclass(frozen=True, kw_only=True)
class Sensor(_Graph):
    """Start a camera and the nodes of its sensor in a component container:

      cmp_tactile sensor sensor:=my_sensor.yaml device:=/dev/video0

    Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup sensor.launch.py`, without needing
    launch; --show-args lists the arguments.
    """

    def run(self) -> int:
        """Run the graph "sensor" in this process; another machine may want the results."""
        self._check_assignments()
        return self._start("sensor", {}, local=False)

    def _check_assignments(self) -> None:
        if other := self._inputs():
            misuse(f"found {other[0]!r}, expected NAME:=VALUE")


@dataclass(frozen=True, kw_only=True)
class Gripper(Sensor):
    """Start the sensors of a left and a right finger, each in a separate process. The source of
    each is simulated (the default), replay or v4l2 (a camera):

      cmp_tactile gripper left_source:=v4l2 left_device:=/dev/video0 left_sensor:=left.yaml
                          right_source:=v4l2 right_device:=/dev/video2 right_sensor:=right.yaml

    Two replays begin at the same time.

    Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup gripper.launch.py`, without needing
    launch; --show-args lists the arguments.
    """

    def run(self) -> int:
        """Run the graph "gripper" in this process; another machine may want the results."""
        self._check_assignments()
        return self._start("gripper", {}, local=False)


@dataclass(frozen=True, kw_only=True)
class Live(_Graph):
    """Start the nodes of one sensor in a component container, with a simulated sensor instead of a
    camera. Its indenter plays the scene until a target or a load comes:

      topic   NAMESPACE/indenter/target   geometry_msgs/PoseStamped, gel frame
      topic   NAMESPACE/indenter/load     geometry_msgs/WrenchStamped, gel frame, force.z < 0
      service NAMESPACE/indenter/reset    std_srvs/Trigger, back to the beginning

    The truth of each frame is published on NAMESPACE/truth/... . Keys on a terminal: z zeroes the
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
    sensor: Annotated[
        str | None,
        option("sensor description, a file or a packaged name, instead of the scene's"),
    ] = None
    frame_rate: Annotated[
        float | None,
        option(
            "frames per second to reach (default: 20, or the scene's if that is lower)",
            Number(0.1, 1000, "Hz"),
        ),
    ] = None
    max_speed: Annotated[
        float, option("highest speed of the indenter towards a target", Number(1e-5, 1.0, "m/s"))
    ] = 0.01
    no_autoplay: Annotated[
        bool, option("do not play the scene: hold still until a target or load comes")
    ] = False
    namespace: Annotated[str, option("namespace, instead of the sensor's name")] = ""

    def run(self) -> int:
        """Run the graph "simulate" in this process."""
        scenes = self._inputs()
        if len(scenes) > 1:
            misuse(f"found {scenes[1]!r} after the scene, expected NAME:=VALUE")
        values = {
            "scene": scenes[0] if scenes else "grasp",
            "sensor": self.sensor,
            "frame_rate": self.frame_rate,
            "max_speed": self.max_speed,
            "autoplay": not self.no_autoplay,
            "namespace": self.namespace,
        }
        return self._start("simulate", values)


@dataclass(frozen=True, kw_only=True)
class Replay(_Graph):
    """Start the nodes of one sensor in a component container and play bags, videos or folders of
    images into them. Keys on a terminal: space pauses, . shows the next frame, left and right go
    one second back or on, z zeroes the sensor, q or Ctrl-C ends. The same as `ros2 launch
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
    rate: Annotated[float, _setting("rate")] = ReplayParameters.rate
    start: Annotated[float, _setting("start")] = ReplayParameters.start
    end: Annotated[float, _setting("end")] = ReplayParameters.end
    loop: Annotated[bool, _setting("loop")] = ReplayParameters.loop
    paused: Annotated[bool, _setting("paused")] = ReplayParameters.paused
    topic: Annotated[str, _setting("topic")] = ReplayParameters.topic
    namespace: Annotated[str, option("namespace, instead of the sensor's name", metavar="NAME")] = (
        ""
    )
    no_clock: Annotated[bool, option("do not publish /clock, because another replay does")] = False

    def run(self) -> int:
        """Run the graph "replay" in this process."""
        from cmp_tactile_bringup.recordings.library import (
            RecordingError,
            check_source,
            required_sensor,
        )

        sources = [Path(word) for word in self._inputs()]
        if not sources:
            misuse("INPUT: found nothing, expected a recording")
        for source in sources:
            check_source(source)
            if os.pathsep in str(source):
                msg = f"{source}: found {os.pathsep!r} in the path, expected a path without it"
                raise RecordingError(msg)
        values = {
            "input": os.pathsep.join(str(source.expanduser()) for source in sources),
            "sensor": required_sensor(sources[0], self.sensor, *sources[1:]),
            **{name: getattr(self, name) for name in SAME_NAMES},
            "publish_clock": not self.no_clock,
        }
        return self._start("replay", values)
