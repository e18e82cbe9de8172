"""The recordings that a graph replays: made where they are packaged scenes, opened as a check."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graphs.description import Component, Graph
from cmp_tactile_bringup.recordings.library import MakingProgress, recorded_source
from cmp_tactile_driver.bags.recording import open_recording, split_inputs
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.parameters import ReplayParameters

__all__ = ["check_recordings", "with_recordings"]

REPLAY = "cmp_tactile_driver::Replay"
RECORDER = "cmp_tactile_driver::Recorder"


def with_recordings(graph: Graph, progress: MakingProgress | None = None) -> Graph:
    """The graph with the names of packaged scenes replaced by their recordings.

    One that was never asked for before is simulated first.  All replays begin together.  Raises
    CmpTactileError where a scene cannot be simulated.
    """
    together = {item.full_name for item in graph.components if item.plugin == REPLAY}
    components = (_recorded(item, progress) for item in graph.components)
    return replace(graph, components=tuple(_begins_with(item, together) for item in components))


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
            _open_inputs(component)
        except FrameSourceError as error:
            raise ComponentLoadError(f"{component.name} ({REPLAY}): {error}") from None


def _open_inputs(component: Component) -> None:
    for path in _inputs(component):
        open_recording(
            path,
            topic=str(component.parameters.get("topic", "")),
            frame_rate=ReplayParameters.frame_rate,
            frame_id="",
            expected_size=None,
        )


def _recorded(component: Component, progress: MakingProgress | None) -> Component:
    paths = [str(recorded_source(path, progress)) for path in _inputs(component)]
    return _with(component, {"input": os.pathsep.join(paths)}) if paths else component


def _begins_with(component: Component, together: set[str]) -> Component:
    """A replay told of the others; any other component as it is."""
    others = " ".join(sorted(together - {component.full_name}))
    if component.plugin != REPLAY or not others:
        return component
    given = str(component.parameters.get("begin_with", ""))
    return _with(component, {"begin_with": f"{given} {others}".strip()})


def _with(component: Component, parameters: dict[str, str]) -> Component:
    return replace(component, parameters={**component.parameters, **parameters})


def _inputs(component: Component) -> list[Path]:
    """What a replay component plays; empty for any other component."""
    if component.plugin != REPLAY:
        return []
    return split_inputs(str(component.parameters.get("input", "")))
