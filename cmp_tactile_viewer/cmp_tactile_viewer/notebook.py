"""`show`: a page that a notebook or a script feeds with results of its own."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.pipeline import PipelineResult
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_viewer.page.page import Page
from cmp_tactile_viewer.page.server import Access
from cmp_tactile_viewer.snapshot import PassiveSource, ShownSensor, Snapshot


class NotebookViewer:
    """A page on this machine; `update` shows a result, `url` is where."""

    def __init__(self, sensor: SensorDescription, access: Access) -> None:
        """Raises CmpTactileError where the address cannot be listened on."""
        self._name = sensor.ros_name
        self._page = Page(PassiveSource((ShownSensor(self._name, sensor),)), access)
        self.url = self._page.url

    def update(
        self,
        result: PipelineResult,
        frame: NDArray[np.uint8] | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """Show the result of a frame, and the frame, (H, W) grey or (H, W, 3) BGR, if given.

        stamp_ns: when it was taken; without it, now.
        """
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        self._page.show(
            self._name,
            Snapshot(stamp_ns, frame, result.left, result.right, result.surface, result.force),
        )

    def close(self) -> None:
        """End the page."""
        self._page.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="640" style="border:0"></iframe>'


def show(
    sensor: SensorDescription, *, host: str = "127.0.0.1", port: int | None = None, token: str = ""
) -> NotebookViewer:
    """Serve a page for a sensor and print its address; in Jupyter it appears below the cell.

    host: address to listen on; by default only this machine can connect.  port: None for the first
    that is free from 8080 on.  token: that the address must then have.
    Raises CmpTactileError where the address cannot be listened on.

    >>> viewer = show(sensor)
    >>> for frame in frames:
    ...     viewer.update(pipeline.process(frame), frame)
    """
    viewer = NotebookViewer(sensor, Access(host, port, token))
    print(viewer.url)  # noqa: T201
    return viewer
