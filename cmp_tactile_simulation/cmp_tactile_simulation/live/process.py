"""A live sensor in a process of its own, so that it does not share Python's lock with the nodes."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection, Pipe
from typing import Any

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.python_command import python_command
from cmp_tactile_simulation.live.motion import (
    Command,
    LiveFrame,
    LiveSettings,
    TruthWanted,
    check_command,
)
from cmp_tactile_simulation.live.sensor import LiveSensor
from cmp_tactile_simulation.scenes.description import Scene

# One lane asks for pictures and waits for them, the other takes commands meanwhile.
LANES = 2


class LiveProcess:
    """A `Live` that has another process compute contact and pictures.

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
        """Ask something of the indenter; CommandError for what cannot be."""
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


if __name__ == "__main__":
    main()
