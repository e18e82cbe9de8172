"""Recordings to play: bags and images, or a packaged scene, which is simulated when first named.

The simulator is imported only for names without such a path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cmp_tactile_driver.bags.recording import check_folder, is_bag
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.writer import SENSOR_FILE
from cmp_tactile_processing.cache.files import atomic_path, default_cache_dir, digest, expanded_path
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import packaged_sensors
from cmp_tactile_processing.sensor.yaml_file import did_you_mean, read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

DEFAULT_SCENE = "grasp"

SOURCES = "a ROS 2 bag, a folder of images, an image, a video"
"""What is replayed and processed, beside packaged scenes."""

"""Called with what is done and its share, 0 to 1, while a recording is made."""


def is_packaged(source: Path) -> bool:
    """Whether it names a packaged scene (or a variant of one), and no path that is there."""
    if source.exists():
        return False
    from cmp_tactile_simulation.scenes.file import VARIANT_MARK, packaged_scenes

    return str(source).partition(VARIANT_MARK)[0] in packaged_scenes()


def recorded_source(source: Path, progress: OnProgress | None = None) -> Path:
    """The path; for a packaged scene, its recording, which is made where there is none yet."""
    if not is_packaged(source):
        return expanded_path(source)
    # The simulator's own libraries take a second to load.
    from cmp_tactile_simulation.recording.run import recording_of

    return recording_of(str(source), progress)


def check_source(source: Path, kinds: str = SOURCES) -> None:
    """Raise FrameSourceError without such a path or scene; kinds: what may be there."""
    if not expanded_path(source).exists() and not is_packaged(source):
        from cmp_tactile_simulation.scenes.file import packaged_scenes

        scenes = ", ".join(packaged_scenes())
        msg = (
            f"{source}: found no such file or folder, expected {kinds}, "
            f"or the name of a scene: {scenes}"
        )
        raise FrameSourceError(msg + did_you_mean(str(source), packaged_scenes()))


def required_sensor(source: Path, given: str | None, *more: Path) -> str:
    """The sensor that was given, or the recordings' own.

    Raises FrameSourceError where there is neither, where theirs differ, and for a folder without
    a recording.
    """
    sensor = given or sensor_of_recordings([source, *more])
    if sensor:
        return sensor
    check_folder(expanded_path(source))
    packaged = ", ".join(packaged_sensors())
    msg = f"{source}: found no --sensor, expected the file of a description or one of {packaged}"
    raise FrameSourceError(msg)


def required_sensors(source: Path) -> list[str]:
    """The recording's own sensor; of a bag of several, NAME.yaml of each namespace in its folder.

    Raises FrameSourceError where there is none.
    """
    path = expanded_path(source)
    if sensor_of_recording(str(source)) or not (path.is_dir() and is_bag(path)):
        return [required_sensor(source, None)]
    names = sorted({topic.strip("/").partition("/")[0] for topic in BagStorage(path).topics})
    beside = [path / f"{name}.yaml" for name in names]
    return [str(file) for file in beside if file.is_file()] or [required_sensor(source, None)]


def sensor_of_recordings(sources: Sequence[Path]) -> str:
    """The file of the description that lies beside the first that has one; empty for none.

    Raises FrameSourceError where another has another description.
    """
    found = {str(source): sensor_of_recording(str(source)) for source in sources}
    found = {source: sensor for source, sensor in found.items() if sensor}
    first = next(iter(found), "")
    for source, sensor in found.items():
        if read_yaml(Path(sensor)).content != read_yaml(Path(found[first])).content:
            expected = f"that of {first}; give one description for all (--sensor or sensor:=)"
            msg = f"{source}: found another sensor description, expected {expected}"
            raise FrameSourceError(msg)
    return found.get(first, "")


def sensor_of_recording(source: str) -> str:
    """The file of the description in a bag's folder, or beside a file; empty for none.

    Beside NAME.mcap, as `process` writes it, NAME.yaml comes before sensor.yaml.

    The sensor of a packaged scene is known without simulating it.
    """
    if is_packaged(Path(source)):
        return sensor_of_scene(source)
    path = expanded_path(source)
    places = [(path.parent if path.is_file() else path) / SENSOR_FILE]
    if path.suffix == ".mcap":
        places.insert(0, path.with_suffix(".yaml"))
    return next((str(place) for place in places if place.is_file()), "")


def sensor_of_scene(name_or_path: str) -> str:
    """A file with the sensor description of a scene; InputError where the scene cannot be used."""
    from cmp_tactile_simulation.scenes.file import load_scene

    mapping = dict(load_scene(name_or_path).sensor_mapping)
    for path in packaged_sensors().values():
        if read_yaml(path).content == mapping:
            return str(path)
    return _kept(dump_yaml(mapping))


def _kept(text: str) -> str:
    """A file in the cache with the text of a sensor description."""
    path = default_cache_dir() / "sensors" / f"{digest(text)[:16]}.yaml"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as beside:
            beside.write_text(text, encoding="utf-8")
    return str(path)
