"""`cmp_tactile calibrate check`: does a sensor's description still fit what its camera sees?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.calibrate.sources import FrameInput
from cmp_tactile_bringup.commands.options import Number, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.report.results import TableRow
    from cmp_tactile_bringup.report.truth import TruthErrors
    from cmp_tactile_processing.calibration.check import CheckFigure, CheckReport

SPREAD = "95 % below {}, median {}, largest {}"


@dataclass(frozen=True, kw_only=True)
class Check(FrameInput):
    """Check a description with any recording of its sensor, at rest or in contact. Do both views
    place every marker at the same point? Is the gel at rest where the description says? For a
    simulated recording, the 3-D error is shown too. The exit code is 1 if a limit is missed.

    examples:
      cmp_tactile calibrate check my_bag --sensor my_sensor.yaml
      cmp_tactile calibrate check --topic /my_sensor/image_raw --sensor my_sensor.yaml
    """

    sensor: Annotated[str, option("description to check: a file or a packaged name")] = ""
    frames: Annotated[int, option("use at most N frames", Number(1, 100_000, kind=int))] = 200
    report: Annotated[
        Path | None, option("write figures of the residuals to this folder", metavar="DIR")
    ] = None

    def run(self) -> int:
        """Check and print the result; 1 where a limit is missed."""
        from cmp_tactile_bringup.commands.calibrate.outcome import (
            print_findings,
            print_verdict,
            warn,
        )
        from cmp_tactile_bringup.commands.calibrate.sources import frames_of, prepare_tracker
        from cmp_tactile_bringup.recordings.library import required_sensor
        from cmp_tactile_bringup.report.truth import truth_errors, truth_of
        from cmp_tactile_bringup.terminal import output
        from cmp_tactile_processing.calibration.check import check_grids
        from cmp_tactile_processing.calibration.observation import track_frames
        from cmp_tactile_processing.sensor.description import load_sensor

        self.check_source()
        if self.input is not None:
            sensor = load_sensor(required_sensor(self.input, self.sensor))
        elif self.sensor:
            sensor = load_sensor(self.sensor)
        else:
            misuse("--sensor is required with --topic")
        with output.shown_stages() as on_stage:
            frames = frames_of(self, sensor, on_stage)
            prepare_tracker(sensor, on_stage)
        errors = None
        with output.shown_count() as count:
            grids = track_frames(sensor, frames.images, count)
        report = check_grids(sensor, grids)
        # One view measures no places in 3-D.
        in_3d = len(sensor.views) > 1
        truth = truth_of(self.input) if self.input is not None and in_3d else None
        if truth is not None:
            errors = truth_errors(sensor, grids, frames.stamps_ns, truth)
        rows = [_row(figure) for figure in report.figures] + (errors.rows() if errors else [])
        console = output.output_console()
        title = f"{sensor.name}, {report.frames} frames, {len(report.rest_frames)} of them at rest"
        console.print(output.results_table(title, rows))
        warn(frames.problem)
        print_findings(console, report.findings)
        print_verdict(console, report.verdict, accepted=report.accepted)
        if errors is not None and not errors.kept:
            print_verdict(
                console,
                "The markers differ from the recording's truth: see the errors above.",
                accepted=False,
            )
        if self.report is not None:
            _write_figures(report, frames.images[0], errors, self.report.expanduser())
        return int(not report.accepted or (errors is not None and not errors.kept))


def _row(figure: CheckFigure) -> TableRow:
    from math import isfinite

    from cmp_tactile_bringup.report.results import TableRow
    from cmp_tactile_processing.calibration.outcome import value_text

    value = value_text(figure.value, figure.unit)
    if isfinite(figure.p95):
        spread = (figure.p95, figure.median, figure.maximum)
        value = SPREAD.format(*(value_text(item, figure.unit) for item in spread))
    sign = ">=" if figure.at_least else "<="
    limit = f"{sign} {value_text(figure.limit, figure.unit)}"
    return TableRow(figure.name, value, limit, figure.kept)


def _write_figures(
    report: CheckReport, frame: NDArray[np.uint8], errors: TruthErrors | None, folder: Path
) -> None:
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_bringup.report import style
    from cmp_tactile_bringup.report.calibration_figures import residual_figure, truth_figure

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    if any(len(item.pixels) for item in report.residuals):
        figure = residual_figure(report.residuals, view_pictures(report.sensor, frame))
        written.append(style.save_figure(figure, folder / "residuals.png"))
    if errors is not None:
        figure = truth_figure(errors.position, report.sensor.pattern)
        written.append(style.save_figure(figure, folder / "truth.png"))
    for path in written:
        print(f"Written: {path}")
