"""The recordings that a graph replays: made where they are packaged scenes, opened as a check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graph import Component, Graph
from cmp_tactile_bringup.recording import MakingProgress, recorded_source
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.parameters import ReplayParameters
from cmp_tactile_driver.recording import open_recording

__all__ = ["check_recordings", "with_recordings"]

REPLAY = "cmp_tactile_driver::Replay"
RECORDER = "cmp_tactile_driver::Recorder"


def with_recordings(graph: Graph, progress: MakingProgress | None = None) -> Graph:
    """The graph with the names of packaged scenes replaced by their recordings.

    One that was never asked for before is simulated first.  Raises CmpTactileError where that
    fails.
    """
    return replace(graph, components=tuple(_recorded(c, progress) for c in graph.components))


def check_recordings(graph: Graph) -> None:
    """Open each recording that is to be replayed, before anything that takes long is built.

    Raises ComponentLoadError for the first that cannot be opened, or is to be made and is there.
    """
    for component in graph.components:
        output = component.parameters.get("output") if component.plugin == RECORDER else None
        if output and Path(str(output)).exists():
            msg = f"{component.full_name} ({RECORDER}): {output}: found a recording already"
            raise ComponentLoadError(f"{msg}, expected a folder that is not there yet")
        if not _input(component):
            continue
        try:
            open_recording(
                Path(_input(component)).expanduser(),
                topic=str(component.parameters.get("topic", "")),
                frame_rate=ReplayParameters.frame_rate,
                frame_id="",
                expected_size=None,
            )
        except FrameSourceError as error:
            raise ComponentLoadError(f"{component.name} ({REPLAY}): {error}") from None


def _recorded(component: Component, progress: MakingProgress | None) -> Component:
    if not _input(component):
        return component
    source = recorded_source(Path(_input(component)), progress)
    return replace(component, parameters={**component.parameters, "input": str(source)})


def _input(component: Component) -> str:
    """What a replay component plays; empty for any other component."""
    return str(component.parameters.get("input", "")) if component.plugin == REPLAY else ""
