"""What came of a material calibration: told, drawn, and written where it is accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.table import Table

from cmp_tactile_bringup.calibration.files import CalibrationFiles
from cmp_tactile_bringup.commands.calibrate.outcome import estimates_table, line, tell_end
from cmp_tactile_bringup.report.calibration.load_rows import LOAD_HEADINGS, load_rows
from cmp_tactile_bringup.report.calibration.material_page import write_material_report
from cmp_tactile_bringup.terminal.tables import cell, output_console
from cmp_tactile_processing.calibration.material.loads import LoadResult, MaterialOutcome

__all__ = ["conclude_material"]

WORDY_COLUMNS = 2


def conclude_material(outcome: MaterialOutcome, files: CalibrationFiles, name: str) -> int:
    """Draw the report, tell what was found, write what is accepted; returns the exit code."""
    page = write_material_report(outcome, files.report, name)
    console = output_console()
    console.print(_loads_table(outcome.loads))
    if np.isfinite(outcome.offset[:3]).all():
        zero = ", ".join(
            f"{value:+.3f} +- {std:.3f}"
            for value, std in zip(outcome.offset[:3], outcome.offset_std[:3], strict=True)
        )
        line(console, f"The reference sensor reads too much by {zero} N (x, y, z of the gel frame)")
    if outcome.estimates:
        # A terminal is narrow; the page has the keys in full.
        short = [replace(item, name=_short(item.name)) for item in outcome.estimates]
        console.print(estimates_table(short))
    return tell_end(console, outcome, page, lambda: files.write_sensor(outcome.sensor))


def _short(key: str) -> str:
    return key.removeprefix("elastomer.").replace("shading_layer.", "layer.")


def _loads_table(loads: Sequence[LoadResult]) -> Table:
    table = Table(
        title="Loads, N", title_justify="left", title_style="bold", box=None, pad_edge=False
    )
    last = len(LOAD_HEADINGS) - 1
    for number, heading in enumerate(LOAD_HEADINGS):
        words = number < WORDY_COLUMNS or number == last
        table.add_column(heading, justify="left" if words else "right", no_wrap=number != last)
    for row in load_rows(loads):
        table.add_row(*map(cell, row.texts), style="dim" if row.remark else "")
    return table
