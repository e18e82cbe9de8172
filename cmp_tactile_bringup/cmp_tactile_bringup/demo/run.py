"""Plays a recording through the nodes, in a process of their own, over real topics."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool

from cmp_tactile_bringup.demo.collector import RESULTS, Collector, ReplayFacts, gather
from cmp_tactile_bringup.recordings.simulated import Recording
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.python_command import python_command
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "ContainerError",
    "ContainerProcess",
    "PlayOptions",
    "PlayProgress",
    "play",
    "run_replay",
]

EXECUTABLES = "cmp_tactile_bringup.container.executables"
STOP_TIMEOUT_S = 15.0
LAST_LINES = 3
POLL_S = 0.02
# The first start after an update compiles the trackers.
START_TIMEOUT_S = 400.0
# Both sides of a DDS connection learn of it one after the other.
SETTLE_S = 0.5
# After the last frame was sent, nothing more is expected once no message came for so long.
QUIET_S = 1.5
FINAL_STATES = ("finished", "failed", "stopped")


class ContainerError(CmpTactileError):
    """The container ended early, or did not do what was waited for."""


class ContainerProcess:
    """`standalone GRAPH NAME:=VALUE ...`; a context manager that ends it with SIGTERM.

    Its output goes to a log file.
    """

    def __init__(self, graph: str, arguments: dict[str, str], log: Path) -> None:
        given = [f"{name}:={value}" for name, value in arguments.items()]
        self._command = python_command(EXECUTABLES, "standalone", graph, *given)
        self._log = log
        self.exit_code: int | None = None

    def __enter__(self) -> ContainerProcess:
        with self._log.open("a") as log:
            # A session of its own: Ctrl-C reaches the command, which then ends the container.
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self.exit_code = self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.exit_code = self._process.wait()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until the condition holds.

        Raises ContainerError when the process ends before, or after `timeout_s` seconds.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._process.poll() is not None:
                msg = f"the container ended with code {self._process.returncode}: {self._tail()}"
                raise ContainerError(msg)
            if time.monotonic() > deadline:
                msg = f"{what}: not within {timeout_s:g} s; see {self._log}: {self._tail()}"
                raise ContainerError(msg)
            time.sleep(POLL_S)

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        errors = [line for line in lines if "error" in line.lower()]
        return " | ".join((errors or lines)[-LAST_LINES:])


@dataclass(frozen=True)
class PlayOptions:
    """rate_hz: frames per second.  log: file for what the container prints."""

    rate_hz: float
    log: Path


@dataclass(frozen=True)
class PlayProgress:
    """Called when the nodes are ready, and with the number of wrenches that have come so far."""

    on_ready: Callable[[], None] = lambda: None
    on_frames: Callable[[int], None] = lambda _: None


def play(
    recording: Recording,
    sensor: SensorDescription,
    options: PlayOptions,
    progress: PlayProgress | None = None,
) -> DemoResults:
    """Start the container, play the recording once, end the container.

    Raises ContainerError where the container does not start, finish or end cleanly.
    """
    with Collector(f"/{sensor.ros_name}") as collector:
        facts = run_replay(collector, recording, options, progress or PlayProgress())
        return gather(collector, recording, sensor, facts)


def run_replay(
    collector: Collector, recording: Recording, options: PlayOptions, progress: PlayProgress
) -> ReplayFacts:
    """Play the recording once into the collector.

    Raises ContainerError as `play` does.
    """
    stamps = recording.truth.stamp_ns
    recorded_hz = 1e9 / float(np.median(np.diff(stamps)))
    arguments = {
        "input": str(recording.bag.resolve()),
        "sensor": recording.sensor,
        "rate": f"{options.rate_hz / recorded_hz:.6f}",
        "paused": "true",
    }
    began = time.monotonic()
    with ContainerProcess("replay", arguments, options.log) as container:
        remote = _ReplayRemote(collector)
        container.wait_for(
            lambda: collector.connected() and remote.ready(), START_TIMEOUT_S, "start of the nodes"
        )
        time.sleep(SETTLE_S)
        ready_s = time.monotonic() - began
        progress.on_ready()
        remote.resume()
        ending = _Ending(collector, remote, len(stamps), progress.on_frames)
        limit_s = START_TIMEOUT_S + 5 * len(stamps) / options.rate_hz
        container.wait_for(ending, limit_s, "end of the replay")
    if container.exit_code != 0:
        msg = f"the container ended with code {container.exit_code}, expected 0; see {options.log}"
        raise ContainerError(msg)
    return ReplayFacts(options.rate_hz, ready_s, remote.frames_sent)


class _ReplayRemote:
    """Talks to the replay node of the container."""

    def __init__(self, collector: Collector) -> None:
        self._client = collector.node.create_client(SetBool, "replay/pause")
        self.state = ""
        self.frames_sent = 0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        collector.node.create_subscription(
            DiagnosticStatus, "replay/status", self._on_status, latched
        )

    def ready(self) -> bool:
        """Whether the replay node answers."""
        return bool(self._client.service_is_ready())

    def resume(self) -> None:
        """Let it play."""
        self._client.call_async(SetBool.Request(data=False))

    def _on_status(self, status: DiagnosticStatus) -> None:
        values = {item.key: item.value for item in status.values}
        self.state, self.frames_sent = values["state"], int(values["frames out"])


class _Ending:
    """True once the replay has ended and all has come, or nothing more comes."""

    def __init__(
        self,
        collector: Collector,
        remote: _ReplayRemote,
        expected: int,
        on_frames: Callable[[int], None],
    ) -> None:
        self._collector = collector
        self._remote = remote
        self._expected = expected * len(RESULTS)
        self._on_frames = on_frames
        self._count = 0
        self._last_change = time.monotonic()

    def __call__(self) -> bool:
        self._on_frames(self._collector.count("wrench"))
        count = sum(self._collector.count(topic) for topic in RESULTS)
        if count != self._count:
            self._count, self._last_change = count, time.monotonic()
        quiet = time.monotonic() - self._last_change > QUIET_S
        return self._remote.state in FINAL_STATES and (count >= self._expected or quiet)
