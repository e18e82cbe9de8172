"""The driver's source `simulated`: a live sensor in place of a camera."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import NodeExtension, SourceHealth, SourceOptions
from cmp_tactile_simulation.live.motion import (
    Command,
    LiveFrame,
    LiveSettings,
    LiveStatus,
    TruthWanted,
)
from cmp_tactile_simulation.live.process import LiveProcess
from cmp_tactile_simulation.live.sensor import Live
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.library import load_scene

FRAME_RATE = 20.0
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
        make: Callable[[Scene, LiveSettings, float], Live] = LiveProcess,
    ) -> None:
        """frame_rate: Hz, 0 for FRAME_RATE or the scene's own if that is lower."""
        self.settings = LiveSettings()
        self.wanted = TruthWanted()
        self._scene = scene
        self._frame_rate = frame_rate or min(FRAME_RATE, scene.rate)
        self._make = make
        self._live: Live | None = None
        # Frames are read on one thread, commands come on another.
        self._making = threading.Lock()
        self._ended = False
        self._status = LiveStatus()

    @classmethod
    def from_options(cls, options: SourceOptions) -> SimulatedSource:
        """The source of the driver: its input is the scene's name or file.

        The sensor of the options takes the place of the scene's.  SceneError for a wrong scene.
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
        """Ask something of the indenter; CommandError for what cannot be."""
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

    def _started(self) -> Live:
        with self._making:
            if self._ended:
                msg = f"{self.name}: has ended"
                raise FrameSourceError(msg)
            if self._live is None:
                self._live = self._make(self._scene, self.settings, self._frame_rate)
            return self._live
