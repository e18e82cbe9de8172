"""`cmp_tactile record`: topics of a sensor that runs into a bag, until Ctrl-C."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cmp_tactile_bringup.commands.options import (
    Command,
    Number,
    argument,
    option,
    parameter_option,
)
from cmp_tactile_driver.sources.parameters import MEGABYTE, RecorderParameters

if TYPE_CHECKING:
    from cmp_tactile_driver.bags.recorder import RecordingProgress

PERIOD_S = 0.2
# Options that are parameters of the node.
SAME_NAMES = ("output", "compression", "jpeg_quality")
_setting = partial(parameter_option, RecorderParameters)


@dataclass(frozen=True, kw_only=True)
class Record(Command):
    """Record topics of a running sensor, on this or another machine, until Ctrl-C. The bag is a
    folder with an MCAP file, metadata.yaml and sensor.yaml, the sensor description. `cmp_tactile
    replay`, `cmp_tactile process`, `ros2 bag` and others read it. To keep frames off the network,
    record in the sensor's own container: give record:=FOLDER to a launch file or to a command
    that starts nodes.
    """

    topics: Annotated[
        list[str] | None,
        argument(
            "TOPIC",
            "topics below the sensor's namespace, or from / on; * stands for any text (default: "
            f"{RecorderParameters.topics})",
        ),
    ] = None
    output: Annotated[
        str,
        option(
            "folder of the bag; it must not exist yet (default: the sensor's name and the time)",
            metavar="FOLDER",
            short="-o",
        ),
    ] = ""
    namespace: Annotated[str, option("namespace of the sensor; needed if several sensors run")] = ""
    sensor: Annotated[
        str | None,
        option("sensor description, instead of the one that the sensor's nodes report"),
    ] = None
    duration: Annotated[float | None, option("end after this time", Number(0.1, 1e6, "s"))] = None
    compression: Annotated[str, _setting("compression")] = RecorderParameters.compression
    jpeg_quality: Annotated[int, _setting("jpeg_quality")] = RecorderParameters.jpeg_quality
    use_sim_time: Annotated[bool, option("log the time of /clock, for example of a replay")] = False

    def run(self) -> int:
        """Record until a signal comes; 0 where all is in the bag."""
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rich.live import Live

        from cmp_tactile_bringup.terminal.output import output_console
        from cmp_tactile_processing.processes import StopSignal
        from cmp_tactile_processing.ros.process import init_beside, joining_ros

        stop = StopSignal()
        context = Context()
        try:
            with joining_ros():
                init_beside(context)
                recorder = _recorder(self, context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(recorder)
            thread = threading.Thread(target=executor.spin, name="record", daemon=True)
            thread.start()
            console = output_console(stderr=True)
            try:
                with Live(console=console, auto_refresh=False, transient=True) as live:
                    while not stop.wait(PERIOD_S):
                        if _is_over(recorder.progress, self.duration):
                            break
                        if console.is_terminal:
                            live.update(_progress_line(recorder.progress), refresh=True)
            finally:
                missing = recorder.missing_topics
                executor.shutdown()
                thread.join()
                recorder.destroy_node()
            return _summary(recorder.bag, recorder.progress, missing)
        finally:
            context.try_shutdown()


def _recorder(arguments: Record, context: Any) -> Any:
    """The node, in the namespace of the sensor."""
    from rclpy.parameter import Parameter

    from cmp_tactile_bringup.commands.running_sensor import RunningSensorError, find_sensor
    from cmp_tactile_driver.nodes.recorder import Recorder
    from cmp_tactile_processing.ros.process import Listener

    with Listener("record_search") as search:
        sensor = find_sensor(search.node, arguments.namespace)
    description = arguments.sensor or sensor.description
    if not description:
        msg = f"{sensor.namespace}: found no description reported by the nodes, expected --sensor"
        raise RunningSensorError(msg)
    values = {
        **{name: getattr(arguments, name) for name in SAME_NAMES},
        "topics": " ".join(arguments.topics or [RecorderParameters.topics]),
        "sensor_description": description,
        "sensor_name": "" if arguments.sensor else sensor.name,
    }
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    overrides.append(Parameter("use_sim_time", value=arguments.use_sim_time))
    return Recorder(
        context=context,
        namespace=sensor.namespace,
        use_global_arguments=False,
        parameter_overrides=overrides,
    )


def _is_over(progress: RecordingProgress | None, duration: float | None) -> bool:
    if progress is None or progress.is_over:
        return True
    return duration is not None and progress.duration_s >= duration


def _progress_line(progress: RecordingProgress | None) -> str:
    if progress is None:
        return ""
    return (
        f"{progress.duration_s:8.1f} s  {sum(progress.messages.values())} messages  "
        f"{progress.size / MEGABYTE:.1f} MB  {sum(progress.dropped.values())} dropped"
    )


def _summary(bag: Path, progress: RecordingProgress, missing: list[str]) -> int:
    for topic, count in sorted(progress.messages.items()):
        print(f"{count:8d}  {topic}")
    for topic in missing:
        print(f"       0  {topic}: no node published it")
    for topic, count in sorted(progress.dropped.items()):
        print(f"warning: {count} messages of {topic} dropped: {progress.problem}", file=sys.stderr)
    size = f"{progress.duration_s:.1f} s, {progress.size / MEGABYTE:.1f} MB"
    print(f"{bag}: {sum(progress.messages.values())} messages, {size}")
    if progress.has_failed:
        print(f"error: {progress.problem}", file=sys.stderr)
        return 1
    return 0
