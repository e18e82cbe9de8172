"""What a graph needs as it starts: recordings, settings of RViz, a network of this machine."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from cmp_tactile_bringup.errors import ComponentLoadError, GraphError
from cmp_tactile_bringup.graphs.description import Component, Graph
from cmp_tactile_bringup.recordings.library import MakingProgress, recorded_source
from cmp_tactile_driver.bags.recording import open_recording, split_inputs
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.parameters import ReplayParameters
from cmp_tactile_processing.cache.files import atomic_path, config_dir, folder_without_home

PACKAGE = "cmp_tactile_bringup"
VIEWER_PACKAGE = "cmp_tactile_viewer"
REPLAY = "cmp_tactile_driver::Replay"
RECORDER = "cmp_tactile_driver::Recorder"

# Files by the number of sensors, with the names in whose place the graph's are put: the packaged
# settings can be opened as they are, but RViz takes absolute topics only.
RVIZ_SETTINGS = {
    1: ("cmp_tactile.rviz", ("sample_rig",)),
    2: ("gripper.rviz", ("left_finger", "right_finger")),
}
# The tf frame that gripper.rviz shows them in.
PARENT_FRAME = "gripper"

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Fast DDS 2 of ROS 2 Jazzy reads the second alone; Fast DDS 3 warns where that is set.
PROFILES = "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"
RCLPY_OF_KILTED = 9
# By each of these the user says how nodes are to find one another.
CHOICES = (
    *PROFILES,
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
)
FAST_DDS = ("", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


def with_recordings(graph: Graph, progress: MakingProgress | None = None) -> Graph:
    """The graph with the names of packaged scenes replaced by their recordings.

    One that was never asked for before is simulated first.  All replays begin together.  Raises
    CmpTactileError where a scene cannot be simulated.
    """
    together = {item.full_name for item in graph.components if item.plugin == REPLAY}
    parameters = {}
    for item in graph.components:
        if item.plugin != REPLAY:
            continue
        paths = [str(recorded_source(path, _of_scene(path, progress))) for path in _inputs(item)]
        given = str(item.parameters.get("begin_with", ""))
        others = " ".join(sorted(together - {item.full_name}))
        changed = {"input": os.pathsep.join(paths), "begin_with": f"{given} {others}".strip()}
        parameters[item.full_name] = {name: text for name, text in changed.items() if text}
    return graph.with_parameters(parameters)


def _of_scene(scene: Path, progress: MakingProgress | None) -> MakingProgress | None:
    """The progress with the scene's name, and that it is not always so long."""
    if progress is None:
        return None
    return lambda what, share: progress(f"{scene}: {what}, the first time only", share)


def check_recordings(graph: Graph) -> None:
    """Open each recording that is to be replayed, before anything that takes long is built.

    Raises ComponentLoadError for the first that cannot be opened, or is to be made and is there.
    """
    for component in graph.components:
        output = component.parameters.get("output") if component.plugin == RECORDER else None
        if output and Path(str(output)).expanduser().exists():
            msg = f"{component.full_name} ({RECORDER}): {output}: found a recording already"
            raise ComponentLoadError(f"{msg}, expected a folder that is not there yet")
        try:
            for path in _inputs(component):
                open_recording(
                    path,
                    topic=str(component.parameters.get("topic", "")),
                    frame_rate=ReplayParameters.frame_rate,
                    frame_id="",
                    expected_size=None,
                )
        except FrameSourceError as error:
            raise ComponentLoadError(f"{component.label}: {error}") from None


def _inputs(component: Component) -> list[Path]:
    """What a replay component plays; empty for any other component."""
    if component.plugin != REPLAY:
        return []
    return split_inputs(str(component.parameters.get("input", "")))


def share_folder() -> Path:
    """share/cmp_tactile_bringup, or the source tree where the package is not installed."""
    try:
        return Path(get_package_share_directory(PACKAGE))
    except (LookupError, OSError):
        return Path(__file__).resolve().parents[2]


def rviz_settings(graph: Graph) -> str:
    """The text of a settings file with the namespaces and frames of the graph's sensors.

    Raises GraphError where there are none for so many sensors.
    """
    number = len(graph.sensors)
    if number not in RVIZ_SETTINGS:
        msg = f"rviz: found {number} sensors, expected 1 or 2"
        raise GraphError(msg)
    file, names = RVIZ_SETTINGS[number]
    text = (share_folder() / "rviz" / file).read_text(encoding="utf-8")
    places = {}
    for name, sensor in zip(names, graph.sensors, strict=True):
        places[f"/{name}/"] = f"{sensor.namespace}/"
        places[f"{name}_"] = f"{sensor.name}_"
    # At once, so that nothing is put in the place of what was put there.
    either = "|".join(rf"(?<!\w){re.escape(place)}" for place in places)
    text = re.sub(either, lambda match: places[match[0]], text)
    # What the first sensor is mounted on; its gel frame where it is on nothing.
    first = graph.sensors[0]
    mounts = (
        item.parameters.get("parent_frame") for item in graph.components if item.sensor is first
    )
    parent = next((frame for frame in mounts if frame), f"{first.name}_gel_frame")
    return re.sub(rf"(Frame: ){PARENT_FRAME}$", rf"\g<1>{parent}", text, flags=re.MULTILINE)


def rviz_settings_file(graph: Graph) -> Path:
    """The file with these settings, one for the graph's sensors, in the user's configuration.

    RViz asks to save into it what was changed, a view that was turned included, and what was saved
    is kept.  Raises GraphError where there are no settings, or no place for them.
    """
    text = rviz_settings(graph)
    words = [item.namespace.strip("/") for item in graph.sensors]
    words += [item.name for item in graph.sensors]
    words += re.findall(r"Fixed Frame: (.*)", text)
    name = "-".join(re.sub(r"\W", "_", word) for word in dict.fromkeys(words))
    failed = ""
    for folder in (config_dir(), folder_without_home()):
        path = folder / "rviz" / f"{name}.rviz"
        try:
            if not is_saved_by_rviz(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                with atomic_path(path) as part:
                    part.write_text(text, encoding="utf-8")
        except OSError as error:
            failed = f"{path}: {error.strerror}"
        else:
            return path
    msg = f"rviz: settings cannot be written: {failed}"
    raise GraphError(msg)


def is_saved_by_rviz(path: Path) -> bool:
    """Whether somebody saved there from RViz, which writes no comments; ours begin with one."""
    try:
        with path.open("rb") as file:
            return file.read(1) not in (b"#", b"")
    except FileNotFoundError:
        return False


@contextmanager
def on_loopback() -> Iterator[None]:
    """What joins ROS in here, processes included, uses the loopback interface and shared memory.

    Where ROS_AUTOMATIC_DISCOVERY_RANGE is LOCALHOST, ROS looks for other nodes on this machine
    alone, but its sockets listen on all interfaces.  Not where the user chose something else by the
    environment; with another middleware than Fast DDS only others are looked for on this machine
    alone.
    """
    settings = _local_settings()
    earlier = {name: os.environ[name] for name in settings if name in os.environ}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name in settings:
            del os.environ[name]
        os.environ.update(earlier)


def _local_settings() -> dict[str, str]:
    if os.environ.get(RANGE, "") not in ("", "LOCALHOST"):
        return {}
    if any(os.environ.get(name) for name in CHOICES):
        return {}
    if os.environ.get("RMW_IMPLEMENTATION", "") not in FAST_DDS:
        return {RANGE: "LOCALHOST"}
    is_fast_dds_3 = int(version("rclpy").partition(".")[0]) >= RCLPY_OF_KILTED
    return {
        PROFILES[not is_fast_dds_3]: str(share_folder() / "config" / "dds" / "loopback.xml"),
        # What the profile says; for LOCALHOST rmw would add a transport of its own.
        RANGE: "SYSTEM_DEFAULT",
        # Fast DDS would take a profile from the current folder, too.
        "SKIP_DEFAULT_XML_FILE": "1",
    }
