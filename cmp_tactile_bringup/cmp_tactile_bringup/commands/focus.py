"""`cmp_tactile focus`: what a camera's picture of checkers is worth, live."""

from __future__ import annotations

import sys
import time
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.looking import Looking
from cmp_tactile_bringup.commands.options import argument

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import RenderableType

    from cmp_tactile_processing.calibration.counting import Worth

# What is worth a hint, of a marker's standard deviation.
LEAST_GAIN = 0.15
# Between lines where they stay.
LINE_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Focus(Looking):
    """Show live how good a camera's picture of the pattern is, while you set focus and light: size
    of the checkers, blur, contrast, noise, and the resulting error of a marker in um. The number
    in brackets after a value is the error that would remain if only this value were improved:
    improve the value with the smallest number first. Ctrl-C ends it.

    examples:
      cmp_tactile focus /dev/video0 --pitch 0.69
      cmp_tactile focus /dev/video0 --size 1280x720 --pitch 0.69 --views mirrors
    """

    source: Annotated[
        str,
        argument(
            "SOURCE",
            "camera, as /dev/video0 (two with a comma between). To try it without a camera: a "
            "video, an image, a folder of images, a bag, or a scene",
        ),
    ]

    def run(self) -> int:
        """Show until a signal comes, or the recording ends."""
        from rich.live import Live

        from cmp_tactile_bringup.terminal.output import output_console, print_line
        from cmp_tactile_processing.stop_signal import StopSignal

        meter = _Meter(self.views or "", self.pitch_m())
        console, shown = output_console(), -LINE_S
        stop = StopSignal()
        with (
            closing(self.frames(self.source)) as frames,
            Live(console=console, auto_refresh=False) as live,
        ):
            for image in frames:
                if stop.wait(0.0):
                    break
                if image is None:
                    continue
                if console.is_terminal:
                    live.update(meter.table(image), refresh=True)
                elif time.monotonic() - shown >= LINE_S:
                    shown = time.monotonic()
                    print_line(console, meter.line(image))
                    sys.stdout.flush()
        return 0


class _Meter:
    """Figures of one picture after another, with the least blur so far."""

    def __init__(self, layout: str, pitch: float) -> None:
        self._layout, self._pitch = layout, pitch
        self._best: dict[str, float] = {}

    def table(self, image: NDArray[np.uint8]) -> RenderableType:
        """For a terminal."""
        from rich.table import Table

        rows = self._rows(image)
        if isinstance(rows, str):
            return rows
        table = Table("", *rows, caption="(um): error of a marker if only this were improved")
        for heading in next(iter(rows.values())):
            table.add_row(heading, *(cells[heading] for cells in rows.values()))
        return table

    def line(self, image: NDArray[np.uint8]) -> str:
        """For a file."""
        rows = self._rows(image)
        if isinstance(rows, str):
            return rows
        return "; ".join(
            f"{view}: " + ", ".join(f"{heading} {text}" for heading, text in cells.items())
            for view, cells in rows.items()
        )

    def _rows(self, image: NDArray[np.uint8]) -> dict[str, dict[str, str]] | str:
        """Cells by view and heading; a text where no checkers are seen."""
        from cmp_tactile_processing.calibration.proposal import find_views
        from cmp_tactile_processing.errors import FrameError
        from cmp_tactile_processing.sensor.description import VIEW_NAMES

        try:
            views = find_views(image, self._layout)
        except FrameError as error:
            return str(error)
        names = VIEW_NAMES if len(views) > 1 else ("view",)
        return {
            name: self._cells(name, view.seen.worth)
            for name, view in zip(names, views, strict=True)
        }

    def _cells(self, name: str, worth: Worth) -> dict[str, str]:
        best = self._best[name] = min(worth.blur_px, self._best.get(name, worth.blur_px))
        um = 1e6 * self._pitch
        values = {
            "px per checker": ("side_px", f"{worth.side_px:.1f}"),
            "blur": ("blur_px", f"{worth.blur_px:.2f} px, best {best:.2f}"),
            "contrast": ("contrast", f"{worth.contrast:.0f}"),
            "noise": ("noise", f"{worth.noise:.1f}"),
        }
        cells = {
            heading: f"{text} ({um * worth.std_if(key):.2f} um)"
            for heading, (key, text) in values.items()
        }
        advice = [*worth.advice(LEAST_GAIN), "nothing: a good picture"]
        return {
            **cells,
            "overexposed": f"{worth.saturated:.0%}",
            "marker": f"{um * worth.std_pitch:.2f} um",
            "next": advice[0],
        }
