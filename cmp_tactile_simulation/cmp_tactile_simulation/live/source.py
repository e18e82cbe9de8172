"""The driver's source `simulated`: a live sensor in place of a camera.

It runs in a process of its own, so that it does not share Python's lock with the nodes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, Pipe
from typing import Any

from cmp_tactile_driver.sources.frames import NodeExtension, SourceHealth, SourceOptions
from cmp_tactile_processing.errors import CmpTactileError, FrameSourceError
from cmp_tactile_processing.processes import python_command
from cmp_tactile_simulation.live.mechanics import Command, LiveSettings, LiveStatus, check_command
from cmp_tactile_simulation.live.sensor import LiveFrame, LiveSensor, TruthWanted
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene

# One lane asks for pictures and waits for them, the other takes commands meanwhile.
LANES = 2

FRAME_RATE = 20.0


class LiveProcess:
    """A LiveSensor in another process, which computes contact and pictures.

    That process ends with this one, however it ends.  `picture` is for one thread.
    """

    def __init__(self, scene: Scene, settings: LiveSettings, rate: float) -> None:
        """rate: contact steps per second that are aimed at, Hz."""
        self._scene = scene
        pairs = [Pipe() for _ in range(LANES)]
        theirs = [str(there.fileno()) for _, there in pairs]
        self._process = subprocess.Popen(
            python_command(__name__, *theirs),
            stdin=subprocess.DEVNULL,
            pass_fds=[there.fileno() for _, there in pairs],
            # Ctrl-C is for this process, which then ends that one.
            start_new_session=True,
        )
        for _, there in pairs:
            there.close()
        self._pictures, self._commands = (here for here, _ in pairs)
        self._sending, self._drawing = threading.Lock(), threading.Lock()
        self._pictures.send((scene, settings, rate))

    def picture(self, wanted: TruthWanted = TruthWanted()) -> LiveFrame:  # noqa: B008  frozen
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        try:
            with self._drawing:
                self._pictures.send(wanted)
                answer: LiveFrame | str = self._pictures.recv()
        except (EOFError, OSError):
            msg = f"scene {self._scene.name}: its process ended with code {self._process.wait()}"
            raise FrameSourceError(msg) from None
        if isinstance(answer, str):
            raise FrameSourceError(answer)
        return answer

    def command(self, command: Command) -> None:
        """Ask something of the indenter; InputError for what cannot be."""
        check_command(command, self._scene.sensor)
        # Where the process has ended, the next picture shows it.
        with self._sending, suppress(OSError):
            self._commands.send(command)

    def close(self) -> None:
        """End the process; a `picture` that another thread waits for then raises."""
        # It has nothing to clean up, and may be at work for a long time.
        self._process.kill()
        self._process.wait()
        with self._drawing:
            self._pictures.close()
        with self._sending:
            self._commands.close()


def _serve(pictures: Connection[Any, Any], commands: Connection[Any, Any]) -> None:
    """Answer until the other side is gone."""
    made: Future[LiveSensor] = Future()
    threading.Thread(target=_obey, args=(made, commands), daemon=True).start()
    sensor = LiveSensor(*pictures.recv())
    made.set_result(sensor)
    while True:
        wanted = pictures.recv()
        try:
            answer: LiveFrame | str = sensor.picture(wanted)
        except CmpTactileError as error:
            answer = str(error)
        pictures.send(answer)


def _command(command: Command, made: Future[LiveSensor]) -> None:
    made.result().command(command)


def _obey(made: Future[LiveSensor], commands: Connection[Any, Any]) -> None:
    with suppress(EOFError, OSError):
        while True:
            made.add_done_callback(partial(_command, commands.recv()))
    # At once, also while the sensor is being made or a picture is drawn.
    os._exit(0)


def main() -> None:
    """Serve on the two connections with these file descriptors."""
    with suppress(EOFError, OSError):
        _serve(*(Connection(int(number)) for number in sys.argv[1:]))
    # Nothing is left to clean up, and a model that is being built would keep the process.
    os._exit(0)


"""Unless the driver asks for another, Hz: what two cores keep up with beside the whole graph."""


class SimulatedSource:
    """A FrameSource that renders a scene while its indenter is moved.

    settings: how it is simulated; may be set until the first frame is read or command given.
    wanted: what of the truth the frames are to bring.
    """

    def __init__(
        self,
        scene: Scene,
        frame_rate: float = 0.0,
        make: Callable[[Scene, LiveSettings, float], LiveSensor | LiveProcess] = LiveProcess,
    ) -> None:
        """frame_rate: Hz, 0 for FRAME_RATE or the scene's own if that is lower."""
        self.settings = LiveSettings()
        self.wanted = TruthWanted()
        self._scene = scene
        self._frame_rate = frame_rate or min(FRAME_RATE, scene.rate)
        self._make = make
        self._live: LiveSensor | LiveProcess | None = None
        # Frames are read on one thread, commands come on another.
        self._making = threading.Lock()
        self._ended = False
        self._status = LiveStatus()

    @classmethod
    def from_options(cls, options: SourceOptions) -> SimulatedSource:
        """The source of the driver: its input is the scene's name or file.

        The sensor of the options takes the place of the scene's.  InputError for a wrong scene.
        """
        scene = load_scene(options.input)
        return cls(replace(scene, sensor=options.sensor), options.frame_rate)

    @property
    def name(self) -> str:
        """The scene."""
        return f"scene {self._scene.name}"

    @property
    def scene(self) -> Scene:
        """What is simulated."""
        return self._scene

    @property
    def frame_rate(self) -> float:
        """Frames per second that are aimed at."""
        return self._frame_rate

    @property
    def health(self) -> SourceHealth:
        """Why the contact stays as it is, where it cannot be solved."""
        return SourceHealth(problem=self._status.problem)

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """What it does and what that costs, by name."""
        return {
            "indenter": self._status.mode.value,
            "elastic model": self._status.note or "from the cache",
            "contact step (ms)": f"{self._status.step_s * 1e3:.1f}",
            "samples of a pixel": self.settings.samples**2,
        }

    def read(self) -> LiveFrame:
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        frame = self._started().picture(self.wanted)
        self._status = frame.status
        return frame

    def command(self, command: Command) -> None:
        """Ask something of the indenter; InputError for what cannot be."""
        self._started().command(command)

    def interrupt(self) -> None:
        """End the simulation for good, also while another thread waits for a frame."""
        self._ended = True
        self.close()

    def close(self) -> None:
        """End the simulation."""
        with self._making:
            live, self._live = self._live, None
        if live is not None:
            live.close()

    def extend(self, node: Any) -> NodeExtension:
        """Topics and services to move the indenter and to publish what is true."""
        from cmp_tactile_simulation.live.topics import LiveSource

        return LiveSource(node, self)

    def _started(self) -> LiveSensor | LiveProcess:
        with self._making:
            if self._ended:
                msg = f"{self.name}: has ended"
                raise FrameSourceError(msg)
            if self._live is None:
                self._live = self._make(self._scene, self.settings, self._frame_rate)
            return self._live


if __name__ == "__main__":
    main()
