"""`cmp_tactile calibrate check`: does a sensor's description still fit what its camera sees?"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.calibrate.arguments import add_frames, check_source_given

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.report.calibration.truth_errors import TruthErrors
    from cmp_tactile_bringup.report.evaluation import TableRow
    from cmp_tactile_processing.calibration.check.recording import CheckFigure, CheckReport

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Hold a description against any recording of its sensor, at rest or in contact: do both views place
every marker at the same point, and is the gel at rest where the description has it? The exit code
is 1 where a limit is missed. Simulated recordings tell the truth, and the 3-D error is shown too.
"""
EPILOG = """\
examples:
  cmp_tactile calibrate check my_bag --sensor my_sensor.yaml
  cmp_tactile calibrate check --topic /my_sensor/image_raw --sensor my_sensor.yaml
"""
SPREAD = "95 % below {}, median {}, most {}"


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "check",
        parents=[common],
        help="does a description still fit a recording?",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_frames(parser, count=200, sensor_required=False)
    parser.add_argument(
        "--report", type=Path, metavar="DIR", help="write figures of the residuals to this folder"
    )
    parser.set_defaults(run=run, wrong_usage=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Check, tell; 1 where a limit is missed."""

    from cmp_tactile_bringup.commands.calibrate.outcome import tell_findings, tell_verdict, warn
    from cmp_tactile_bringup.commands.calibrate.source import frames_of, prepare_tracker
    from cmp_tactile_bringup.recordings.library import required_sensor
    from cmp_tactile_bringup.report.calibration.truth_errors import truth_errors, truth_of
    from cmp_tactile_bringup.terminal.stages import shown_count, shown_stages
    from cmp_tactile_bringup.terminal.tables import output_console, results_table
    from cmp_tactile_processing.calibration.check.recording import check_grids
    from cmp_tactile_processing.calibration.observation import track_frames
    from cmp_tactile_processing.sensor.library import load_sensor

    check_source_given(arguments)
    if arguments.input is None and not arguments.sensor:
        arguments.wrong_usage("--sensor is required with --topic")
    sensor = load_sensor(arguments.sensor or required_sensor(arguments.input, None))
    with shown_stages() as tell:
        frames = frames_of(arguments, sensor, tell)
        prepare_tracker(sensor, tell)
    errors = None
    with shown_count() as count:
        grids = track_frames(sensor, frames.images, count)
    report = check_grids(sensor, grids)
    truth = truth_of(arguments.input) if arguments.input is not None else None
    if truth is not None:
        errors = truth_errors(sensor, grids, frames.stamps_ns, truth)
    rows = [_row(figure) for figure in report.figures] + (errors.rows() if errors else [])
    console = output_console()
    title = f"{sensor.name}, {report.frames} frames, {len(report.rest_frames)} of them at rest"
    console.print(results_table(title, rows))
    warn(frames.problem)
    tell_findings(console, report.findings)
    tell_verdict(console, report.verdict, accepted=report.accepted)
    if errors is not None and not errors.kept:
        tell_verdict(console, "The recording knows better: see its truth above.", accepted=False)
    if arguments.report is not None:
        _write_figures(report, frames.images[0], errors, arguments.report.expanduser())
    return int(not report.accepted or (errors is not None and not errors.kept))


def _row(figure: CheckFigure) -> TableRow:
    from math import isfinite

    from cmp_tactile_bringup.report.evaluation import TableRow

    value = _text(figure.value, figure.unit)
    if isfinite(figure.p95):
        spread = (figure.p95, figure.median, figure.maximum)
        value = SPREAD.format(*(_text(item, figure.unit) for item in spread))
    sign = ">=" if figure.at_least else "<="
    limit = f"{sign} {_text(figure.limit, figure.unit)}"
    return TableRow(figure.name, value, limit, figure.kept)


def _text(value: float, unit: str) -> str:
    """A value as people read it; without a unit it is a share."""
    from math import degrees

    from cmp_tactile_bringup.report.calibration.truth_errors import length_text

    if unit == "m":
        return length_text(value)
    if unit == "rad":
        return f"{degrees(value):.2g} deg"
    return f"{value:.3g} {unit}" if unit else f"{value:.2%}"


def _write_figures(
    report: CheckReport, frame: NDArray[np.uint8], errors: TruthErrors | None, folder: Path
) -> None:
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_bringup.report import style
    from cmp_tactile_bringup.report.calibration.figures import residual_figure, truth_figure

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    if any(len(item.pixels) for item in report.residuals):
        figure = residual_figure(report.residuals, view_pictures(report.sensor, frame))
        written.append(style.save_figure(figure, folder / "residuals.png"))
    if errors is not None:
        maps = {"3-D error": errors.position}
        figure = truth_figure(maps, report.sensor.pattern)
        written.append(style.save_figure(figure, folder / "truth.png"))
    for path in written:
        print(f"Written: {path}")
