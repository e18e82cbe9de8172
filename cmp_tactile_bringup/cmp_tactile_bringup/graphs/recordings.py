"""The recordings that a graph plays, and those that it makes: found, simulated, checked."""

from __future__ import annotations

import os
from pathlib import Path

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graphs.arguments import Value
from cmp_tactile_bringup.graphs.description import Component, Graph
from cmp_tactile_bringup.recordings.library import MakingProgress, recorded_source
from cmp_tactile_driver.bags.recording import open_recording, split_inputs
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_processing.sensor.description import load_sensor

REPLAY = "cmp_tactile_driver::Replay"
RECORDER = "cmp_tactile_driver::Recorder"


def with_recordings(graph: Graph, progress: MakingProgress = lambda *_: None) -> Graph:
    """The graph with the names of packaged scenes replaced by their recordings.

    One that was never asked for before is simulated first.  All replays begin together.  Raises
    CmpTactileError where a scene cannot be simulated.
    """
    replays = [item for item in graph.components if item.plugin == REPLAY]
    names = {item.full_name for item in replays}
    parameters: dict[str, dict[str, Value]] = {}
    for item in replays:
        paths = [_recorded(scene, progress) for scene in _inputs(item)]
        changed: dict[str, Value] = {"input": os.pathsep.join(paths)}
        if len(replays) > 1:
            changed["begin_with"] = " ".join(sorted(names - {item.full_name}))
        parameters[item.full_name] = changed
    return graph.with_parameters(parameters)


def _recorded(scene: Path, progress: MakingProgress) -> str:
    def show(what: str, share: float) -> None:
        progress(f"{scene}: {what}, the first time only", share)

    return str(recorded_source(scene, show))


def check_recordings(graph: Graph) -> None:
    """Open each recording that is to be replayed, before anything that takes long is built.

    Raises ComponentLoadError for the first that cannot be opened, or is to be made and is there.
    """
    for component in graph.components:
        output = component.parameters.get("output") if component.plugin == RECORDER else None
        if output and Path(str(output)).expanduser().exists():
            msg = f"{component.full_name} ({RECORDER}): {output}: found an existing folder or file"
            raise ComponentLoadError(f"{msg}, expected a new name")
        try:
            for path in _inputs(component):
                sensor = load_sensor(str(component.parameters["sensor_description"]))
                topic = str(component.parameters.get("topic", ""))
                open_recording(path, topic=topic, shape=sensor.pattern.shape)
        except FrameSourceError as error:
            raise ComponentLoadError(f"{component.label}: {error}") from None


def _inputs(component: Component) -> list[Path]:
    """What a replay component plays; empty for any other component."""
    if component.plugin != REPLAY:
        return []
    return split_inputs(str(component.parameters.get("input", "")))
