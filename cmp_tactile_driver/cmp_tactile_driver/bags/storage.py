"""The messages of a ROS 2 bag, as whoever wrote it left them: whole, without index, or damaged.

Files are taken as they are.  metadata.yaml only says which files belong to the bag, and how many
messages they should hold.
"""

from __future__ import annotations

import shlex
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import yaml
import zstandard

from cmp_tactile_driver.bags.files import (
    BagFile,
    McapBagFile,
    SqliteBagFile,
    StoredMessage,
    unpacked,
)
from cmp_tactile_driver.bags.timeline import run_on
from cmp_tactile_processing.errors import FrameError, FrameSourceError

FORMATS: dict[str, type[BagFile]] = {".mcap": McapBagFile, ".db3": SqliteBagFile}
STORAGE_SUFFIXES = tuple(FORMATS)
PACKED_SUFFIX = ".zstd"
GIT_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# Of pictures that telephones take.
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")


class BagStorage:
    """A bag to read.

    topics: message type by topic.  loss: what of the topics that were asked for cannot be read, or
    is not there though the bag states it; empty for a whole bag.
    """

    def __init__(self, path: Path) -> None:
        """path: a folder, or one .mcap or .db3 file.

        Raises FrameSourceError for a path that is absent or no bag, and for a bag of which nothing
        is left.
        """
        if not path.exists():
            msg = f"{path}: found no such file or folder, expected a ROS 2 bag"
            raise FrameSourceError(msg)
        if path.is_file() and not is_bag_file(path):
            kinds = f"a folder, {' or '.join(STORAGE_SUFFIXES)}"
            msg = f"{path}: found a {path.suffix or 'nameless'} file, expected {kinds}"
            raise FrameSourceError(msg)
        self._path = path
        self._listed, self._counts = _read_metadata(path)
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self.loss = ""
        self._faults: list[str] = []
        self._files = list(self._opened_files())
        if not self._files:
            raise FrameSourceError("; ".join(self._faults))
        self.topics: dict[str, str] = {}
        for file in self._files:
            self.topics = {**file.topics, **self.topics}

    def index(self, topics: Collection[str]) -> list[StoredMessage]:
        """The messages of some topics without their bytes, in the order they were received.

        That of each topic is the one in which they were written where the clock was set back.
        """
        found = [
            replace(message, file=number) if number else message
            for number, file in enumerate(self._files)
            for message in file.index(topics)
        ]
        received = [message.time_ns for message in found]
        for topic in topics:
            places = [place for place, message in enumerate(found) if message.topic == topic]
            times = run_on([received[place] for place in places])
            for place, time_ns in zip(places, times, strict=True):
                received[place] = time_ns
        self.loss = "; ".join(self._losses(topics, Counter(message.topic for message in found)))
        # Those of one moment stay in the order in which they were written.
        return [found[place] for place in sorted(range(len(found)), key=received.__getitem__)]

    def read(self, messages: Sequence[StoredMessage]) -> Iterator[StoredMessage]:
        """These messages with their bytes, without those that are damaged, see `loss`."""
        failed = 0
        with ExitStack() as stack:
            opened: list[Any] = [stack.enter_context(file.opened()) for file in self._files]
            for message in messages:
                try:
                    data = unpacked(opened[message.file](message.where))
                except Exception as error:  # noqa: BLE001  damaged bytes raise anything
                    failed += 1
                    count = len(messages) - failed
                    self.loss = _damage(self._path, error, count, len(messages))
                    continue
                yield replace(message, data=data)

    def messages(self, topics: Collection[str]) -> Iterator[StoredMessage]:
        """The messages of some topics in the order in which they were received."""
        return self.read(self.index(topics))

    def decoded(self, topics: Collection[str]) -> Iterator[Any]:
        """As `messages`, decoded, without those that are none of their type."""
        for stored in self.messages(topics):
            with suppress(FrameError):
                yield stored.decode()

    def _losses(self, topics: Collection[str], found: Counter[str]) -> Iterator[str]:
        yield from self._faults
        reason = next((file.damage for file in self._files if file.damage), "")
        stated = {topic: n for topic, n in self._counts.items() if topic in topics}
        if reason:
            yield _damage(self._path, reason, found.total(), sum(stated.values()))
            return
        for topic, count in stated.items():
            if found[topic] < count:
                counts = f"found {found[topic]} messages, expected {count} as metadata.yaml states"
                yield f"{self._path}: {topic}: {counts}"

    def _opened_files(self) -> Iterator[BagFile]:
        """The files that can be read; `_faults` gets a line for each other one."""
        for path in self._listed_files():
            if foreign := foreign_content(path):
                self._faults.append(f"{path}: {foreign}")
                continue
            try:
                yield self._open_file(path)
            except FrameSourceError as error:
                self._faults.append(f"{path}: damaged, no message can be read: {error}")

    def _listed_files(self) -> list[Path]:
        """The files of the bag that are there; FrameSourceError for none."""
        if self._path.is_file():
            return [self._path]
        listed = [self._path / name for name in self._listed]
        there = [path for path in listed if path.is_file()]
        if there:
            lost = "which metadata.yaml lists; its messages are missing"
            for path in (path for path in listed if not path.is_file()):
                self._faults.append(f"{self._path}: found no file {path.name}, {lost}")
            return there
        found = bag_files(self._path)
        if not found:
            kinds = " or ".join(STORAGE_SUFFIXES)
            msg = f"{self._path}: not a readable ROS 2 bag: found no {kinds} file"
            raise FrameSourceError(msg)
        return found

    def _open_file(self, path: Path) -> BagFile:
        unpacked = self._unpack(path) if path.suffix == PACKED_SUFFIX else path
        return FORMATS[unpacked.suffix.lower()](unpacked)

    def _unpack(self, path: Path) -> Path:
        """A file that rosbag2 compressed as a whole, unpacked for as long as the bag is read."""
        self._unpacked = self._unpacked or tempfile.TemporaryDirectory(prefix="cmp_tactile_bag_")
        target = Path(self._unpacked.name) / path.stem
        with path.open("rb") as source, target.open("wb") as out:
            try:
                zstandard.ZstdDecompressor().copy_stream(source, out)
            except zstandard.ZstdError as error:
                raise FrameSourceError(str(error)) from None
        return target


def foreign_content(path: Path) -> str:
    """What a file is in place of an image, video or bag, and the command that helps; or empty."""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(len(GIT_LFS_POINTER))
        if head == GIT_LFS_POINTER:
            return "found a pointer of git-lfs, expected the file itself; to get it: git lfs pull"
        if head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS:
            names = f"{shlex.quote(str(path))} {shlex.quote(str(path.with_suffix('.png')))}"
            return f"found a HEIC image, expected PNG or JPEG; to convert it: heif-convert {names}"
    return ""


def is_bag_file(path: Path) -> bool:
    """Whether a file is named as one of a bag is, also one that was compressed as a whole."""
    return Path(path.name.removesuffix(PACKED_SUFFIX)).suffix.lower() in STORAGE_SUFFIXES


def bag_files(folder: Path) -> list[Path]:
    """The storage files in a folder, in the order in which a recorder numbers them."""
    files = [
        file
        for file in folder.iterdir()
        if is_bag_file(file) and not file.name.startswith(".") and file.is_file()
    ]
    return sorted(files, key=lambda file: (len(file.name), file.name))


def _read_metadata(path: Path) -> tuple[list[str], dict[str, int]]:
    """Names of the files, and numbers of messages by topic, as metadata.yaml states them.

    Nothing where it is absent or makes no sense.
    """
    counts: Counter[str] = Counter()
    try:
        text = (path / "metadata.yaml").read_text(encoding="utf-8")
        top: Any = yaml.safe_load(text)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in top["relative_file_paths"]]
        for item in top["topics_with_message_count"]:
            counts[item["topic_metadata"]["name"]] += int(item["message_count"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return [], {}
    return names, counts


def _damage(path: Path, reason: object, count: int, expected: int) -> str:
    """expected: how many messages the bag states; 0 where it does not."""
    stated = f" of {expected}" if expected else ""
    return f"{path}: damaged ({reason}); {count}{stated} messages can be read; others are lost"
