"""What a source gives to the page and what the page asks of it: `Snapshot`, `Source`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import Finding
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.ros.messages import reading
from cmp_tactile_processing.sensor.description import SensorDescription


@dataclass(frozen=True)
class Pose:
    """position (x, y, z) m; orientation, a quaternion (w, x, y, z)."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ShownSensor:
    """A sensor on the page.  mount: the gel frame in the scene, as long as no snapshot has it."""

    name: str
    description: SensorDescription
    mount: Pose = Pose()


@dataclass(frozen=True)
class Body:
    """What the sensors hold.  triangles (n, 3, 3) m, in the frame that has this pose in the scene.

    The same array means the same mesh.
    """

    triangles: NDArray[np.float64]
    pose: Pose


@dataclass(frozen=True)
class Snapshot:
    """What one sensor showed at one moment; None for what is not known.

    stamp_ns: of the frame.  frame: the camera image, (H, W) grey or (H, W, 3) BGR uint8; with left
    and right it may be of a frame shortly before.
    latency_s: from the frame's stamp until its force was there; NaN where that means nothing.
    rate_hz: of the sensor's frames, not all of which are shown; NaN where all are.
    mount: the gel frame in the scene; None where it stays.  body: None where nothing is held.
    """

    stamp_ns: int
    frame: NDArray[np.uint8] | None = None
    left: Grid | None = None
    right: Grid | None = None
    surface: Surface | None = None
    force: ForceField | None = None
    latency_s: float = float("nan")
    rate_hz: float = float("nan")
    mount: Pose | None = None
    body: Body | None = None

    @property
    def has_image(self) -> bool:
        """Whether there is something of the camera image; the last one stays on show where not."""
        return self.frame is not None or self.left is not None or self.right is not None


@dataclass(frozen=True)
class Action:
    """A button: `run` does it and returns what to say; it raises CmpTactileError in plain words.

    state: of what goes on until the button is pressed again, what the button says meanwhile; ""
    while nothing does.  None for what is done at once.
    """

    label: str
    hint: str
    run: Callable[[], str]
    state: Callable[[], str] | None = None


@dataclass(frozen=True)
class Setting:
    """A parameter that may be changed on the page.

    owner: the node that has it.
    change: takes the new value and returns what to say; raises CmpTactileError where it is refused.
    """

    owner: str
    name: str
    value: bool | float | str
    description: str
    change: Callable[[bool | float | str], str]
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()


@dataclass
class Touch:
    """A simulated indenter.  pose: where it is in the gel frame, None until that is known.

    move: asks it to go to a pose; None in a recording.
    """

    move: Callable[[Pose], None] | None = None
    pose: Pose | None = None


@dataclass
class Playback:
    """Where a recording is, and what was asked of it; the page writes, the source obeys.

    length_s: 0 until it is known.  position_s: of the frame on show.  seek_s: where to go, None
    when there.  steps: frames to go on while it is paused.  loop: begin again at the end.
    preparing: nothing can be shown yet.
    """

    length_s: float
    position_s: float = 0.0
    playing: bool = True
    speed: float = 1.0
    seek_s: float | None = None
    steps: int = 0
    ended: bool = False
    loop: bool = False
    preparing: bool = False

    @property
    def is_sought(self) -> bool:
        """Whether another place is asked for."""
        return self.seek_s is not None


class Audience(Protocol):
    """What a source needs of the page."""

    def show(self, sensor: str, snapshot: Snapshot) -> None:
        """Show it as soon as there is time; a newer one takes its place."""

    def show_health(self, lines: list[Finding]) -> None:
        """Replace the list of what is the matter."""


class Source(Protocol):
    """Where snapshots come from.  sensors: what is shown."""

    sensors: tuple[ShownSensor, ...]

    @property
    def playback(self) -> Playback | None:
        """Of a recording; None for what is live."""

    def actions(self) -> Mapping[str, tuple[Action, ...]]:
        """The buttons of each sensor."""

    def settings(self, sensor: str) -> tuple[Setting, ...]:
        """The parameters of a sensor, looked up now; CmpTactileError where they are not known."""

    def touches(self) -> Mapping[str, Touch]:
        """The simulated indenter of each sensor that has one."""

    def start(self, audience: Audience) -> None:
        """Begin to give snapshots: somebody looks."""

    def pause(self) -> None:
        """Nobody looks any more: cost nothing until `start`."""

    def close(self) -> None:
        """End; nothing comes afterwards."""


@dataclass
class PassiveSource:
    """A source that has no buttons and no parameters, and costs nothing while nobody looks."""

    sensors: tuple[ShownSensor, ...]
    playback: Playback | None = None
    audience: Audience | None = field(default=None, init=False)

    def actions(self) -> Mapping[str, tuple[Action, ...]]:
        """None."""
        return {}

    def settings(self, sensor: str) -> tuple[Setting, ...]:
        """None."""
        del sensor
        return ()

    def touches(self) -> Mapping[str, Touch]:
        """None."""
        return {}

    def start(self, audience: Audience) -> None:
        """Remember who looks."""
        self.audience = audience

    def pause(self) -> None:
        """Nothing is to be done."""

    def close(self) -> None:
        """Nothing is to be done."""


class ResultReader:
    """Reads messages, of ROS or of `rosbags`, by the field of a `Snapshot` that they fill.

    placements: of the sensor's views, by name.
    """

    def __init__(self, sensor: SensorDescription, depth: BitDepth) -> None:
        """depth: of the camera's frames."""
        self._shape, self._depth = sensor.pattern.shape, depth
        self.placements = {name: view.placement for name, view in build_views(sensor).items()}

    def value(self, field: str, message: Any) -> Any:
        """Raises CmpTactileError where the message cannot be used."""
        if field == "frame":
            return reading.image_from_msg(message, depth=self._depth)
        if field == "surface":
            return reading.surface_from_msg(message, self._shape)
        if field == "force":
            return reading.force_field_from_msg(message)
        return reading.grid_from_msg(message, self._shape, self.placements.get(field))
