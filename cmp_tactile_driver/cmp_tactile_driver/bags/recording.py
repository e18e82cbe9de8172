"""What can be replayed: a bag, a video, an image, or a folder of them with stamps made up."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

from cmp_tactile_driver.bags.images import (
    HEIF_SUFFIXES,
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    ImageFolder,
    VideoFile,
    image_files,
    natural_key,
)
from cmp_tactile_driver.bags.pairs import PairedRecording, pairs_by_number
from cmp_tactile_driver.bags.reader import BagReader, RecordedFrame, image_topics
from cmp_tactile_driver.bags.storage import (
    STORAGE_SUFFIXES,
    BagStorage,
    bag_files,
    foreign_content,
    is_bag_file,
)
from cmp_tactile_driver.bags.timeline import DEFAULT_FRAME_RATE, TimeSpan
from cmp_tactile_driver.sources import frames
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.image.encodings import COMPRESSED
from cmp_tactile_processing.measured import GridShape
from cmp_tactile_processing.sensor.description import SensorDescription

SHOWN_NAMES = 6
# Between what two cameras recorded.
SEPARATOR = ","


Recording = BagReader | ImageFolder | VideoFile | PairedRecording


def open_recording(  # noqa: PLR0913  what files do not say, and what is expected
    path: Path,
    *,
    topic: str = "",
    frame_rate: float = DEFAULT_FRAME_RATE,
    frame_id: str = "",
    expected_size: frames.ImageSize | None = None,
    shape: GridShape | None = None,
    namespace: str = "",
) -> Recording:
    """A bag (folder or file), a video, an image or, where the folder is not a bag, its images.

    topic: of the bag's images, empty for the only one.  shape: of the surfaces that are read of a
    bag without images; absent where only frames are of use.  frame_rate (Hz): of an image folder.
    frame_id: of images and videos.  expected_size: absent for the size of the first image.
    namespace: of the sensor, in a bag with frames of several.
    Raises FrameSourceError where there is nothing to replay.
    """
    if not (path.is_file() or path.is_dir()):
        kinds = "a ROS 2 bag, a folder of images, an image or a video"
        msg = f"{path}: found no such file or folder, expected {kinds}"
        raise FrameSourceError(msg)
    check_folder(path)
    if is_bag(path):
        return BagReader(path, topic, expected_size, shape, namespace)
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageFolder(path, frame_rate, expected_size=expected_size, frame_id=frame_id)
    return _video(path, expected_size, frame_id)


def frames_within(recording: Recording, span: TimeSpan) -> Iterator[RecordedFrame]:
    """The frames of a part of a recording; FrameSourceError where there is none."""
    frame = None
    for frame in recording.frames(span):
        yield frame
    if frame is None:
        msg = (
            f"{recording.name}: found no frame from {span.start:g} to {span.end:g} s, expected "
            f"times from 0 to {recording.duration:.3f} s"
        )
        raise FrameSourceError(msg)


def _video(path: Path, expected_size: frames.ImageSize | None, frame_id: str) -> VideoFile:
    suffix = path.suffix.lower()
    if suffix == ".bag":
        msg = (
            f"{path}: found a bag of ROS 1, expected one of ROS 2; to convert it: "
            f"rosbags-convert --src {shlex.quote(str(path))} --dst NEW_FOLDER"
        )
        raise FrameSourceError(msg)
    if foreign := foreign_content(path):
        msg = f"{path}: {foreign}"
        raise FrameSourceError(msg)
    try:
        return VideoFile(path, expected_size=expected_size, frame_id=frame_id)
    except FrameSourceError as error:
        if suffix in VIDEO_SUFFIXES:
            raise
        kinds = ", ".join([*STORAGE_SUFFIXES, *IMAGE_SUFFIXES])
        msg = f"{error}, or a file named {kinds}"
        raise FrameSourceError(msg) from None


def open_recording_of(  # noqa: PLR0913  as open_recording
    sensor: SensorDescription,
    path: Path,
    *,
    topic: str = "",
    frame_rate: float = DEFAULT_FRAME_RATE,
    frame_id: str = "",
    any_size: bool = False,
    surfaces: bool = True,
) -> Recording:
    """What a sensor recorded: frames of its camera's size or, from a bag, its surfaces.

    topic: "LEFT,RIGHT" names what its two cameras recorded: topics of a bag; folders, videos or
    bags in a folder.  Without it, those of a sensor with two cameras are paired if they are named
    left and right.  any_size: of the frames of one camera.  surfaces: whether they are of use.
    Otherwise as `open_recording`.
    """
    if set(sensor.views) == set(frames.VIEWS):
        sides = _sides(sensor, path, topic)
        if sides:
            sides, alone = _with_partners(sides)
            opened = _opened_sides(sensor, sides, frame_rate, frame_id)
            return PairedRecording(str(path), sensor, opened, alone)
    return open_recording(
        path,
        topic=topic,
        frame_rate=frame_rate,
        frame_id=frame_id,
        expected_size=sensor.frame_size if sensor.views and not any_size else None,
        shape=sensor.pattern.shape if surfaces else None,
        namespace="" if topic else sensor.ros_name,
    )


Side = tuple[Path, str] | list[Path]
"""What one camera recorded: a recording and its topic, or images."""


def _sides(sensor: SensorDescription, path: Path, topic: str) -> list[Side]:
    """What the left and the right camera recorded; empty where there is one camera."""
    names = [name.strip() for name in topic.split(SEPARATOR)] if SEPARATOR in topic else []
    if names and len(names) != len(frames.VIEWS):
        msg = f"{path}: topic: found {topic!r}, expected one name, or LEFT,RIGHT"
        raise FrameSourceError(msg)
    if not names and (topic or sensor.optics.type != "two_view"):
        return []
    if is_bag(path):
        return [(path, name) for name in names or _pair_of_topics(path)]
    if not path.is_dir():
        return []
    if not names:
        images = {view: _images_named(path, view) for view in frames.VIEWS}
        if all(images.values()):
            return list(images.values())
        there = {item.stem.lower(): item.name for item in path.iterdir()}
        names = [there[view] for view in frames.VIEWS if view in there]
    return [(path / name, "") for name in names] if len(names) == len(frames.VIEWS) else []


def _pair_of_topics(path: Path) -> list[str]:
    """The two image topics of a bag if they differ by left and right, and there is no other."""
    bases = {name.removesuffix(COMPRESSED) for name in image_topics(BagStorage(path).topics)}
    left = next((base for base in sorted(bases) if "left" in base), "")
    pair = [left, left.replace("left", "right")]
    return pair if left and bases == set(pair) else []


def _images_named(folder: Path, view: str) -> list[Path]:
    named = [path for path in folder.iterdir() if view in path.stem.lower()]
    images = (path for path in named if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted(images, key=natural_key)


def _with_partners(sides: list[Side]) -> tuple[list[Side], list[Path]]:
    """Images by the numbers in their names, and those without a partner; else as it is."""
    images = [side if isinstance(side, list) else _images_of(side[0]) for side in sides]
    if not all(images):
        return sides, []
    if all(len(side) == 1 for side in images):
        return [*images], []
    pairs, alone = pairs_by_number(*images)
    return [list(side) for side in zip(*pairs, strict=True)], alone


def _images_of(path: Path) -> list[Path]:
    return image_files(path) if path.is_dir() and not is_bag(path) else []


def _opened_sides(
    sensor: SensorDescription, sides: list[Side], frame_rate: float, frame_id: str
) -> dict[str, Recording]:
    opened: dict[str, Recording] = {}
    for view, side in zip(frames.VIEWS, sides, strict=True):
        size = sensor.views[view].roi.width, sensor.views[view].roi.height
        if isinstance(side, list):
            place = side[0].parent
            opened[view] = ImageFolder(
                place, frame_rate, expected_size=size, frame_id=frame_id, chosen=side
            )
            continue
        path, topic = side
        opened[view] = open_recording(
            path, topic=topic, frame_rate=frame_rate, frame_id=frame_id, expected_size=size
        )
    return opened


def check_folder(path: Path) -> None:
    """Raise FrameSourceError for a folder without a recording, which says what is there instead."""
    if not path.is_dir() or is_bag(path):
        return
    there = [item for item in path.iterdir() if not item.name.startswith(".")]
    names = sorted(f"{item.name}/" if item.is_dir() else item.name for item in there)
    images = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)
    if any(Path(name).suffix.lower() in images for name in names):
        return
    bags = [name for name in names if name.endswith("/") and is_bag(path / name)]
    found = ", ".join([*names[:SHOWN_NAMES], *(["..."] if len(names) > SHOWN_NAMES else [])])
    hint = f"; the folder contains bags, such as {path / bags[0]}" if bags else ""
    msg = f"{path}: found {found or 'nothing'}, expected the files of a bag, or images{hint}"
    raise FrameSourceError(msg)


def is_bag(path: Path) -> bool:
    """Whether it is a file of a bag, or a folder of them, perhaps without the bag's metadata."""
    if path.is_file():
        return is_bag_file(path)
    return path.is_dir() and ((path / "metadata.yaml").exists() or bool(bag_files(path)))


class RecordedSource:
    """A FrameSource of the frames of a recording; their stamps are forgotten.

    frame_rate: what is asked for, or as recorded.
    """

    def __init__(self, recording: Recording, options: frames.SourceOptions) -> None:
        """Raises FrameSourceError for a recording that another camera made."""
        self._recording, self.name = recording, recording.name
        self._loop = options.loop
        self._past_bad_frames = 0
        mismatch = recording.calibration_mismatch(options.sensor)
        if mismatch:
            msg = f"{self.name}: {mismatch}"
            raise FrameSourceError(msg)
        self.frame_rate = options.frame_rate or recording.frame_rate
        self._frames = recording.frames()

    @property
    def health(self) -> frames.SourceHealth:
        """Frames that could not be used, in all passes."""
        return frames.SourceHealth(self._past_bad_frames) + self._recording.health

    def read(self) -> frames.Frame | None:
        """The next good frame, or None at the end; FrameSourceError where none is good."""
        frame = next(self._frames, None)
        if frame is None and self._loop:
            self._past_bad_frames += self._recording.health.bad_frames
            self._frames = self._recording.frames()
            frame = next(self._frames, None)
        if frame is None:
            return None
        return frames.Frame(frame.image, f"{self.name} at {frame.time_s:.3f} s")

    def close(self) -> None:
        """Forget where it was; files are open only while they are read."""
        self._frames = iter(())


def recorded_source(options: frames.SourceOptions) -> RecordedSource:
    """The sources `bag`, `images` and `video` of the driver, which take any recording.

    Raises FrameSourceError for what is none, or is of another camera.
    """
    path = expanded_path(options.input)
    recording = open_recording_of(options.sensor, path, surfaces=False)
    return RecordedSource(recording, options)
