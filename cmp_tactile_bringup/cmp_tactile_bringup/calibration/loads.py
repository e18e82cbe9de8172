"""Known loads: their file, what a reference force sensor read, and the gel's motion beside both."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.calibration.gel_recording import (
    GelMotion,
    steady_stretches,
)
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.timeline import timeline
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.errors import FrameError, FrameSourceError, RefusedValueError
from cmp_tactile_processing.measured import NS_PER_S, Status
from cmp_tactile_processing.sensor.yaml_file import Check, Part, number, positive, read_yaml, text
from cmp_tactile_processing.surface.stillness import largest_motion, motion_limit

TF_STATIC = "/tf_static"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"

STANDARD_GRAVITY = 9.80665
LEAST_GRAVITY, MOST_GRAVITY = 9.7, 9.9
STRAIGHT_IN = (0.0, 0.0, -1.0)
MOST_KG, MOST_N, MOST_S = 100.0, 1000.0, 1e6
MOST_DIRECTION = 1e6
# Where the file does not say how well a load is known: relative, and by how much a weight may hang
# askew, degrees.
MASS_STD, FORCE_STD, TILT_STD_DEG = 0.002, 0.01, 1.0
# So many times what noise alone explains the gel moves where something rests on it.
TOUCHED = 3.0


@dataclass(frozen=True)
class WrenchSeries:
    """source: bag and topic.  stamp_ns (n,), rising; force (n, 3) N as recorded.

    frame_id: of the first message, empty where it names none.
    """

    source: str
    stamp_ns: NDArray[np.int64]
    force: NDArray[np.float64]
    frame_id: str = ""

    @classmethod
    def from_rows(
        cls, source: str, rows: Mapping[int, Sequence[float]], frame_id: str = ""
    ) -> WrenchSeries:
        """From forces by stamp, ns; FrameSourceError unless two or more of them are not NaN."""
        stamps = sorted(rows)
        force = np.array([rows[stamp] for stamp in stamps]).reshape(-1, 3)
        known = int(np.isfinite(force).all(axis=1).sum())
        if known < 2:
            nan = f" and {len(rows) - known} with NaN" if known < len(rows) else ""
            msg = f"{source}: found {known} messages{nan}, expected two or more"
            raise FrameSourceError(msg)
        return cls(source, np.array(stamps, np.int64), force, frame_id)


def read_wrench(bag: Path, topic: str) -> WrenchSeries:
    """The messages of a WrenchStamped topic, by their stamps, or log times where they have none.

    Times run on where a clock was set back, as those of camera frames do.

    Raises FrameSourceError for a bag that cannot be read, and where it has no such topic or fewer
    than two messages of it with a force that is not NaN.
    """
    storage, topic = BagStorage(bag), f"/{topic.strip('/')}"
    if storage.topics.get(topic) != WRENCH_STAMPED:
        there = sorted(name for name, kind in storage.topics.items() if kind == WRENCH_STAMPED)
        msg = (
            f"{bag}: found no {WRENCH_STAMPED} on {topic!r}, "
            f"expected one of: {', '.join(there) or 'there is none'}"
        )
        raise FrameSourceError(msg)
    rows: dict[int, list[float]] = {}
    frame_id = ""
    line = timeline(storage.index([topic]), topic)
    places = ((item.file, item.where) for item in line.messages)
    stamps = dict(zip(places, line.stamps_ns, strict=True))
    for stored in storage.read(line.messages):
        try:
            message = stored.decode()
        except FrameError as error:
            msg = f"{bag}: {topic} at {stored.time_ns} ns: {error}"
            raise FrameSourceError(msg) from None
        frame_id = frame_id or message.header.frame_id.lstrip("/")
        vector = message.wrench.force
        rows[stamps[stored.file, stored.where]] = [vector.x, vector.y, vector.z]
    return WrenchSeries.from_rows(f"{bag}: {topic}", rows, frame_id)


def at_frames(
    series: WrenchSeries, stamp_ns: NDArray[np.int64], ahead_s: float
) -> NDArray[np.float64]:
    """The force at camera frames (n,), (n, 3), interpolated linearly; NaN before and after it.

    ahead_s: what the reference sensor's clock is ahead of the camera's.  Raises FrameSourceError
    where no frame lies within its time.
    """
    force = interpolated(series, stamp_ns, ahead_s)
    if np.isnan(force[:, 0]).all():
        frames = f"{stamp_ns[0] / NS_PER_S:.3f} to {stamp_ns[-1] / NS_PER_S:.3f} s"
        msg = (
            f"{series.source}: found stamps from {series.stamp_ns[0] / NS_PER_S:.3f} to "
            f"{series.stamp_ns[-1] / NS_PER_S:.3f} s, expected some within those of the camera "
            f"frames, {frames}; if the clocks differ, give --time-offset"
        )
        raise FrameSourceError(msg)
    return force


def interpolated(
    series: WrenchSeries, stamp_ns: NDArray[np.int64], ahead_s: float
) -> NDArray[np.float64]:
    """As `at_frames`, but NaN everywhere if no frame lies within the time of the reference."""
    time_s, known_s = (
        (stamps - series.stamp_ns[0]) / NS_PER_S for stamps in (stamp_ns, series.stamp_ns)
    )
    columns = (
        np.interp(time_s + ahead_s, known_s, column, left=np.nan, right=np.nan)
        for column in series.force.T
    )
    return np.stack([*columns], axis=1)


def fixed_rotation(bag: Path, to: str, from_: str) -> Rotation | None:
    """From the axes of one frame to those of another; None where the bag has no transforms of it.

    Raises FrameSourceError for a bag that cannot be read.
    """
    edges = _fixed_rotations(bag)
    found = {to: Rotation.identity()}
    waiting = [to]
    while waiting:
        frame = waiting.pop()
        for next_frame, rotation in edges.get(frame, {}).items():
            if next_frame not in found:
                found[next_frame] = found[frame] * rotation
                waiting.append(next_frame)
    return found.get(from_)


def _fixed_rotations(bag: Path) -> dict[str, dict[str, Rotation]]:
    """R_ab by frames a and b, both ways, of all fixed transforms."""
    storage, edges = BagStorage(bag), defaultdict[str, dict[str, Rotation]](dict)
    if storage.topics.get(TF_STATIC) != TF_MESSAGE:
        return edges
    # Frames that a damaged message alone names are not known.
    for message in storage.decoded([TF_STATIC]):
        for item in message.transforms:
            parent = item.header.frame_id.lstrip("/")
            child = item.child_frame_id.lstrip("/")
            q = item.transform.rotation
            R_parent_child = Rotation.from_quat([q.x, q.y, q.z, q.w])
            edges[parent][child] = R_parent_child
            edges[child][parent] = R_parent_child.inv()
    return edges


def _interval(given: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= given[0] < given[1] <= MOST_S:
        raise RefusedValueError("seconds [from, to], from below to")
    return given


Interval = Annotated[tuple[float, float], Check(_interval)]


@dataclass(frozen=True)
class KnownLoad:
    """A load on the gel and the frames that show it.

    name: for people.  force, std (3,) N: on the gel, gel frame, with standard deviations.
    recording: None for the one that the command is given.  time_s: its part, in seconds from its
    first frame; None for where the gel is loaded and stands still.
    """

    name: str
    force: NDArray[np.float64]
    std: NDArray[np.float64]
    recording: Path | None = None
    time_s: tuple[float, float] | None = None


def weight_on_gel(
    mass: float,
    std: float | None = None,
    direction: tuple[float, ...] = STRAIGHT_IN,
    gravity: float = STANDARD_GRAVITY,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Force of a mass (kg) on the gel and its standard deviations, (3,) N each.

    std: of the mass, kg.  direction: in which it is pulled, gel frame, of any length above 0.
    """
    along = np.array(direction) / np.linalg.norm(direction)
    weight = mass * gravity
    sure = (MASS_STD * mass if std is None else std) * gravity
    aside = weight * math.tan(math.radians(TILT_STD_DEG))
    return weight * along, np.sqrt((along * sure) ** 2 + (1 - along**2) * aside**2)


@dataclass(frozen=True)
class _LoadKeys(Part):
    """A load as a file holds it."""

    mass: float | None = field(default=None, metadata=positive(MOST_KG, "kg"))
    force: tuple[float, float, float] | None = None
    std: float | None = field(default=None, metadata=positive(MOST_N))
    direction: tuple[float, float, float] | None = None
    name: str = field(default="", metadata=text())
    recording: str = field(default="", metadata=text())
    time: Interval | None = None

    def checked(self) -> _LoadKeys:
        """One of mass and force is there, and what belongs to it."""
        if (self.mass is None) == (self.force is None):
            found = "neither" if self.mass is None else "both"
            raise RefusedValueError("one of them", found=f"{found} of mass and force")
        if self.force is not None and not 0 < math.hypot(*self.force) <= MOST_N:
            raise RefusedValueError(f"a force above 0, at most {MOST_N:g} N", "force")
        if self.mass is not None and self.std is not None and self.std > self.mass:
            raise RefusedValueError(f"a number above 0, at most {self.mass:g} kg", "std")
        if self.direction is None:
            return self
        if self.force is not None:
            raise RefusedValueError("no such key beside force", "direction")
        if not 0 < math.hypot(*self.direction) <= MOST_DIRECTION:
            expected = f"a vector other than 0, of length {MOST_DIRECTION:g} at most"
            raise RefusedValueError(expected, "direction")
        return self

    def load(self, folder: Path, gravity: float) -> KnownLoad:
        """The load.  folder: of the file.  gravity: m/s^2."""
        if self.force is None:
            mass = self.mass or 0.0
            force, std = weight_on_gel(mass, self.std, self.direction or STRAIGHT_IN, gravity)
            name = _mass_text(mass)
        else:
            force, size = np.array(self.force), math.hypot(*self.force)
            std = np.full(3, FORCE_STD * size if self.std is None else self.std)
            name = f"{size:.3g} N"
        beside = folder / expanded_path(self.recording)
        recording = beside if beside.exists() else Path(self.recording)
        return KnownLoad(
            self.name or name, force, std, recording if self.recording else None, self.time
        )


@dataclass(frozen=True)
class _LoadsFile(Part):
    loads: tuple[_LoadKeys, ...] = ()
    gravity: float = field(
        default=STANDARD_GRAVITY, metadata=number(LEAST_GRAVITY, MOST_GRAVITY, "m/s^2")
    )
    rest: Interval | None = None

    def checked(self) -> _LoadsFile:
        """There are loads, none of them while nothing touches the gel."""
        if not self.loads:
            raise RefusedValueError("a list of known loads", "loads")
        for place, load in enumerate(self.loads):
            if not load.recording and _overlap(self.rest, load.time):
                expected = (
                    f"a time outside `rest`, {list(self.rest or ())}, in which nothing touches the "
                    "gel"
                )
                raise RefusedValueError(expected, "loads", place, "time")
        return self


def read_known_loads(path: Path) -> tuple[tuple[KnownLoad, ...], tuple[float, float] | None]:
    """The loads of a YAML file, and when nothing touches the gel (None where it does not say).

    Raises InputError naming file, key, what was found and what is expected.
    """
    path = expanded_path(path)
    found = read_yaml(path).read(_LoadsFile)
    loads = tuple(item.load(path.parent, found.gravity) for item in found.loads)
    return loads, found.rest


def _overlap(one: tuple[float, float] | None, other: tuple[float, float] | None) -> bool:
    return one is not None and other is not None and one[0] < other[1] and other[0] < one[1]


def _mass_text(mass: float) -> str:
    return f"{mass:.4g} kg" if mass >= 1 else f"{mass * 1e3:.4g} g"


def averaged(
    motion: GelMotion, frames: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Mean displacement (rows, cols, 3) m over frames and its status.

    A marker that is measured in fewer than half of them is missing.
    """
    chosen = list(frames)
    measured = motion.status[chosen] == Status.MEASURED
    count = measured.sum(axis=0)
    total = np.where(measured[..., None], motion.displacement[chosen], 0.0).sum(axis=0)
    known = 2 * count >= len(chosen)
    mean = np.where(known[..., None], total / np.maximum(count, 1)[..., None], np.nan)
    return mean, np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8)


def samples_of_weights(
    loads: Sequence[KnownLoad], motions: Mapping[Path | None, GelMotion], least_frames: int
) -> list[LoadSample]:
    """A sample for each load; motions: by recording.

    A load without a time is the longest still press of its recording; of several such loads of
    one recording, each is the next still press.  Raises FrameSourceError where a load's time holds
    no frame, or where the presses are none or not as many as the loads.
    """
    untimed: dict[Path | None, list[KnownLoad]] = {}
    for load in loads:
        if load.time_s is None:
            untimed.setdefault(load.recording, []).append(load)
    presses = {
        recording: iter(_presses(motions[recording], own, least_frames))
        for recording, own in untimed.items()
    }
    samples = []
    for load in loads:
        motion = motions[load.recording]
        frames = _timed(load, motion) if load.time_s else next(presses[load.recording])
        displacement, status = averaged(motion, frames)
        samples.append(LoadSample(displacement, status, load.force, load.std, name=load.name))
    return samples


def _timed(load: KnownLoad, motion: GelMotion) -> Sequence[int]:
    begin, end = load.time_s or (0.0, 0.0)
    chosen = np.flatnonzero((motion.time_s >= begin) & (motion.time_s <= end))
    if not chosen.size:
        msg = (
            f"{motion.source}: {load.name}: time: found no frame from {begin:g} to {end:g} s, "
            f"expected times from 0 to {motion.time_s[-1]:.2f} s"
        )
        raise FrameSourceError(msg)
    return [int(item) for item in chosen]


def _presses(motion: GelMotion, loads: Sequence[KnownLoad], least_frames: int) -> list[range]:
    """The still press of each of the loads, which have no times."""
    found = loaded_stretches(motion, steady_stretches(motion.displacement, least_frames))
    if len(loads) == 1 and found:
        return [max(found, key=len)]
    if len(found) == len(loads):
        return found
    names = ", ".join(load.name for load in loads)
    when = ", ".join(
        f"{motion.time_s[item[0]]:.2f} to {motion.time_s[item[-1]]:.2f} s" for item in found
    )
    msg = (
        f"{motion.source}: {names}: found {len(found)} times ({when or 'never'}) in which the gel "
        f"is pressed and still for {least_frames} frames or more, expected {len(loads)}; give "
        "`time` for each load"
    )
    raise FrameSourceError(msg)


def loaded_stretches(motion: GelMotion, stretches: Sequence[range]) -> list[range]:
    """Those in which something rests on the gel."""
    limit = TOUCHED * motion_limit(motion.displacement)
    rest = np.zeros(motion.displacement.shape[1:])
    return [item for item in stretches if largest_motion(rest, averaged(motion, item)[0]) > limit]
