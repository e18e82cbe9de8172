"""`cmp_tactile calibrate board`, `gel`, `check`, `practice`: camera, mirrors, place of the gel."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.calibrate.sources import (
    IMAGE_TOPIC,
    LIVE,
    SENSOR,
    FrameInput,
    LiveInput,
    Output,
)
from cmp_tactile_bringup.commands.options import Command, Number, Pair, argument, misuse, option
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles
    from cmp_tactile_bringup.report.calibration import Report
    from cmp_tactile_bringup.report.evaluation import TruthErrors
    from cmp_tactile_bringup.report.results import TableRow
    from cmp_tactile_processing.calibration.board.target import BoardTarget
    from cmp_tactile_processing.calibration.check import CheckFigure, CheckReport
    from cmp_tactile_processing.calibration.outcome import CalibrationOutcome
    from cmp_tactile_processing.processes import OnProgress
    from cmp_tactile_processing.sensor.description import SensorDescription

BOARD_SIZE = Pair("the number of inner corners, as 9x6")
SPREAD = "95 % below {}, median {}, largest {}"
MAX_SEED = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class Board(Output, LiveInput):
    """Find focal lengths, principal point, distortion and the mirrors (or the pose of one camera
    relative to the other) from images of a flat board, before the gel is mounted. Take about 20
    images with the board in different places and tilts, where the gel will be.

    NEW.yaml (description of the sensor), NEW_left.yaml and NEW_right.yaml (camera_info of ROS) are
    written only if the result is accepted. NEW_calibration/index.html, with the residuals, is
    always written. For two cameras without a sensor description, give their images with --left
    and --right, and a folder as --output: left.yaml and right.yaml are written there.

    examples:
      cmp_tactile calibrate board images --sensor my_rig.yaml --board 9x6 --square 0.0015
          --output board.yaml
      cmp_tactile calibrate board --topic /my_rig/image_raw --sensor my_rig.yaml --board 9x6
          --square 0.0015 --images 20 --output board.yaml
      cmp_tactile calibrate board --left left*.jpg --right right*.jpg --board 9x6 --square 0.025
          --output cameras
    """

    input: Annotated[
        Path | None,
        argument("INPUT", "a folder of images, or a ROS 2 bag: whole camera frames"),
    ] = None
    topic: Annotated[str, option(LIVE, metavar=IMAGE_TOPIC)] = ""
    left: Annotated[list[Path] | None, option("images of the left camera", metavar="FILE...")] = (
        None
    )
    right: Annotated[list[Path] | None, option("images of the right camera", metavar="FILE...")] = (
        None
    )
    sensor: Annotated[
        str, option("description of the rig as designed: a file or a packaged name")
    ] = ""
    images: Annotated[
        int, option("number of images to take from a live topic", Number(3, 1000, kind=int))
    ] = 20
    board: Annotated[
        str,
        option(
            "inner corners: a board of 10 x 7 squares has 9x6",
            BOARD_SIZE.parse,
            metavar="COLSxROWS",
        ),
    ]
    square: Annotated[
        float, option("side of a square, in m; measure it on the print", Number(1e-4, 1, "m"))
    ]
    charuco: Annotated[str, option("ChArUco board with this OpenCV dictionary", metavar="DICT")] = (
        ""
    )
    marker: Annotated[
        float | None, option("side of a marker of a ChArUco board, in m", Number(1e-5, 1, "m"))
    ] = None

    def run(self) -> int:
        """Calibrate, report, and write what is accepted."""
        from cmp_tactile_processing.calibration.board.target import BoardTarget

        self._check_usage()
        cols, rows = map(int, self.board.split("x"))
        if self.marker is not None:
            target = BoardTarget("charuco", cols, rows, self.square, self.marker, self.charuco)
        else:
            target = BoardTarget("chessboard", cols, rows, self.square)
        if self.left:
            return _run_cameras(self, target)
        return _run_sensor(self, target)

    def _check_usage(self) -> None:
        """End with the usage where arguments do not go together."""
        sources = [self.input is not None, bool(self.left)]
        if sum(sources) > 1 or not (any(sources) or self.topic):
            misuse("give one of INPUT, --topic and --left")
        if self.right and not self.left:
            misuse("--right needs --left; give the images of a single camera with --left")
        if not self.left and not self.sensor:
            misuse("--sensor is required, except for cameras given with --left")
        if bool(self.charuco) != (self.marker is not None):
            misuse("--charuco and --marker need each other")


@dataclass(frozen=True, kw_only=True)
class Gel(Output, FrameInput):
    """Find the poses of mirrors and gel from frames of the gel at rest. The target is the gel's
    own pattern, with known pitch and surface. Nothing may touch the gel. Focal lengths are found
    too if the frames determine them. Other values keep those of the description and are listed.

    NEW.yaml (description of the sensor), NEW_left.yaml and NEW_right.yaml (camera_info of ROS) are
    written only if the result is accepted. NEW_calibration/index.html, with the residuals, is
    always written.

    examples:
      cmp_tactile calibrate gel rest --sensor board.yaml --output my_sensor.yaml
      cmp_tactile calibrate gel --topic /my_sensor/image_raw --sensor board.yaml
          --output my_sensor.yaml
    """

    sensor: Annotated[str, option(SENSOR)]
    frames: Annotated[int, option("use at most N frames", Number(1, 100_000, kind=int))] = 20

    def run(self) -> int:
        """Calibrate, report, and write what is accepted."""
        from cmp_tactile_bringup.commands.calibrate.outcome import (
            CalibrationFiles,
            view_pictures,
        )
        from cmp_tactile_bringup.commands.calibrate.sources import frames_of
        from cmp_tactile_bringup.terminal import print_findings, shown_stages
        from cmp_tactile_processing.calibration.gel.calibrate import calibrate_gel
        from cmp_tactile_processing.prepare import TRACKING, prepare
        from cmp_tactile_processing.sensor.description import load_sensor

        self.check_source()
        sensor = load_sensor(self.sensor)
        files = CalibrationFiles.of_sensor(self.output, tuple(sensor.views))
        files.check_free(overwrite=self.overwrite)
        with shown_stages() as on_stage:
            frames = frames_of(self, sensor, on_stage)
            prepare(sensor, TRACKING, on_stage)
            outcome = calibrate_gel(sensor, frames.images, on_progress=on_stage)
        print_findings(frames.findings)
        return _conclude(outcome, files, view_pictures(sensor, frames.images[0]), sensor.name)


def _conclude(
    outcome: CalibrationOutcome,
    files: CalibrationFiles,
    pictures: dict[str, NDArray[np.uint8]],
    name: str,
) -> int:
    from cmp_tactile_bringup.commands.calibrate.outcome import conclude
    from cmp_tactile_bringup.report.calibration import optics_report

    def write() -> Sequence[Path]:
        return files.write(outcome.sensor, outcome.cameras, name)

    return conclude(outcome, optics_report(outcome, pictures, name), files.report, write)


def _run_cameras(arguments: Board, target: BoardTarget) -> int:
    """Two cameras, or one, without a sensor."""
    from cmp_tactile_bringup.calibration.frames import read_images
    from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles
    from cmp_tactile_bringup.terminal import print_findings, shown_stages
    from cmp_tactile_driver.bags.pairs import pairs_by_number
    from cmp_tactile_processing.calibration.board.calibrate import calibrate_cameras
    from cmp_tactile_processing.errors import warnings_of

    views = ("left", "right") if arguments.right else ("left",)
    files = CalibrationFiles.of_cameras(arguments.output, views)
    files.check_free(overwrite=arguments.overwrite)
    chosen = {"left": arguments.left or []}
    if arguments.right:
        pairs, alone = pairs_by_number(chosen["left"], arguments.right)
        chosen = {view: [pair[side] for pair in pairs] for side, view in enumerate(views)}
        if alone:
            names = ", ".join(file.name for file in alone)
            text = f"{names}: found no image of the other camera with the same number; left out"
            print_findings(warnings_of(text))
    images = {view: read_images(files) for view, files in chosen.items()}
    with shown_stages() as on_stage:
        outcome = calibrate_cameras(
            images["left"], images.get("right"), target, on_progress=on_stage
        )
    pictures = {view: items[0] for view, items in images.items()}
    return _conclude(outcome, files, pictures, arguments.output.name)


def _run_sensor(arguments: Board, target: BoardTarget) -> int:
    """The rig of a description."""
    from cmp_tactile_bringup.calibration.frames import read_frames
    from cmp_tactile_bringup.commands.calibrate.outcome import (
        CalibrationFiles,
        view_pictures,
    )
    from cmp_tactile_bringup.terminal import print_findings, shown_stages
    from cmp_tactile_processing.sensor.description import load_sensor

    sensor = load_sensor(arguments.sensor)
    files = CalibrationFiles.of_sensor(arguments.output, tuple(sensor.views))
    files.check_free(overwrite=arguments.overwrite)
    if arguments.input is None:
        frames = _capture(arguments, sensor, target, files.report / "frames")
    else:
        found = read_frames(arguments.input, sensor, arguments.topic)
        print_findings(found.findings)
        frames = found.images
    with shown_stages() as on_stage:
        outcome = _calibrate(frames, target, sensor, on_stage)
    return _conclude(outcome, files, view_pictures(sensor, frames[0]), sensor.name)


def _calibrate(
    frames: list[NDArray[np.uint8]],
    target: BoardTarget,
    sensor: SensorDescription,
    on_stage: OnProgress,
) -> CalibrationOutcome:
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_processing.calibration.board.calibrate import (
        calibrate_cameras,
        calibrate_mirror_rig,
    )

    if sensor.optics.type == "mirror_stereo":
        return calibrate_mirror_rig(frames, target, sensor, on_progress=on_stage)
    views = [view_pictures(sensor, frame) for frame in frames]
    first, *others = sensor.views
    return calibrate_cameras(
        [item[first] for item in views],
        [item[others[0]] for item in views] if others else None,
        target,
        on_progress=on_stage,
        sensor=sensor,
    )


def _capture(
    arguments: Board, sensor: SensorDescription, target: BoardTarget, folder: Path
) -> list[NDArray[np.uint8]]:
    """Frames of a live topic in which the board is seen, still, and elsewhere than before.

    They are kept in the folder, so that the calibration can be repeated without taking them again.
    """
    import shutil

    import cv2
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from cmp_tactile_bringup.calibration.frames import BoardCapture, Choice
    from cmp_tactile_bringup.calibration.live import LiveFrames
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_bringup.terminal import output_console
    from cmp_tactile_processing.calibration.board.target import find_board

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    capture = BoardCapture(target)
    kept: list[NDArray[np.uint8]] = []
    columns = (TextColumn("images kept"), BarColumn(), MofNCompleteColumn())
    note = TextColumn("{task.description}", markup=False)
    with (
        LiveFrames(arguments.topic, sensor, arguments.timeout) as live,
        Progress(*columns, note, console=output_console(stderr=True)) as progress,
    ):
        task = progress.add_task("waiting for frames", total=arguments.images)
        for frame in live:
            views = view_pictures(sensor, frame)
            choice = capture.consider(
                {name: find_board(image, target, name) for name, image in views.items()}
            )
            if choice is Choice.KEPT:
                cv2.imwrite(str(folder / f"{len(kept):03d}.png"), frame)
                kept.append(frame)
            missing = f"; still missing: {capture.missing}" if capture.missing else ""
            progress.update(task, completed=len(kept), description=choice.value + missing)
            if len(kept) == arguments.images:
                break
    return kept


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
        Path | None,
        option("write a page with figures of the residuals to this folder", metavar="DIR"),
    ] = None

    def run(self) -> int:
        """Check and print the result; 1 where a limit is missed."""
        from cmp_tactile_bringup import terminal
        from cmp_tactile_bringup.commands.calibrate.outcome import print_verdict
        from cmp_tactile_bringup.commands.calibrate.sources import frames_of
        from cmp_tactile_bringup.recordings.library import required_sensor
        from cmp_tactile_bringup.report.evaluation import truth_errors, truth_of
        from cmp_tactile_processing.calibration.check import check_grids
        from cmp_tactile_processing.calibration.observation import track_frames
        from cmp_tactile_processing.prepare import TRACKING, prepare
        from cmp_tactile_processing.sensor.description import load_sensor

        self.check_source()
        if self.input is not None:
            sensor = load_sensor(required_sensor(self.input, self.sensor))
        elif self.sensor:
            sensor = load_sensor(self.sensor)
        else:
            misuse("--sensor is required with --topic")
        with terminal.shown_stages() as on_stage:
            frames = frames_of(self, sensor, on_stage)
            prepare(sensor, TRACKING, on_stage)
            grids = track_frames(sensor, frames.images, on_stage)
        report = check_grids(sensor, grids)
        # One view measures no places in 3-D.
        in_3d = len(sensor.views) > 1
        truth = truth_of(self.input) if self.input is not None and in_3d else None
        errors = None
        if truth is not None:
            errors = truth_errors(sensor, grids, frames.stamps_ns, truth)
        rows = [_row(figure) for figure in report.figures] + (errors.rows() if errors else [])
        console = terminal.output_console()
        title = f"{sensor.name}, {report.frames} frames, {len(report.rest_frames)} of them at rest"
        console.print(terminal.results_table(title, rows))
        terminal.print_findings(frames.findings)
        if errors is not None and not errors.kept:
            report = _with_truth_missed(report)
        print_verdict(console, report)
        if self.report is not None:
            page = _report(report, frames.images[0], errors, rows)
            print(f"Figures: {page.write(expanded_path(self.report), report)}")
        return int(not report.accepted)


def _with_truth_missed(report: CheckReport) -> CheckReport:
    from cmp_tactile_processing.errors import Finding, Severity

    text = "The markers differ from the recording's truth: see the errors above."
    advice = "Calibrate again; this is not the rig that was simulated."
    verdict = report.verdict if not report.accepted else f"Do not measure. {text}"
    finding = Finding(Severity.ERROR, text, advice)
    return replace(report, findings=(*report.findings, finding), verdict=verdict)


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


def _report(
    report: CheckReport,
    frame: NDArray[np.uint8],
    errors: TruthErrors | None,
    rows: Sequence[TableRow],
) -> Report:
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_bringup.report.calibration import (
        Report,
        ReportTable,
        residual_figure,
        truth_figure,
    )
    from cmp_tactile_bringup.terminal import RESULT_HEADINGS

    figures = {}
    if any(len(item.pixels) for item in report.residuals):
        pictures = view_pictures(report.sensor, frame)
        figures["residuals.png"] = residual_figure(report.residuals, pictures)
    if errors is not None:
        figures["truth.png"] = truth_figure(errors.position, report.sensor.pattern)
    table = ReportTable("Limits", RESULT_HEADINGS, [row.texts for row in rows])
    return Report(f"Check of {report.sensor.name}", figures, [table])


@dataclass(frozen=True, kw_only=True)
class Practice(Command):
    """Simulate images of a rig that differs a little from its description: gel and mirrors are
    turned by 1 degree and shifted by 0.5 mm, and the focal length is 1 % off, each in an unknown
    direction.

      DIR/sensor.yaml   the description to start from
      DIR/board/        images of a board, taken before the gel was mounted
      DIR/rest/         frames of the gel at rest
      DIR/contact/      a recording of a contact, with its truth
      DIR/truth/        the true rig: do not look at it until the end

    example:
      cmp_tactile calibrate practice --output practice
    """

    output: Annotated[Path, option("folder to write", metavar="DIR")]
    sensor: Annotated[
        str, option("description of the rig as designed: a file or a packaged name")
    ] = "sample_rig"
    seed: Annotated[
        int | None,
        option(
            "the same seed makes the same set (default: a new set each time)",
            Number(0, MAX_SEED, kind=int),
        ),
    ] = None
    images: Annotated[int, option("number of images of the board", Number(3, 200, kind=int))] = 20

    def run(self) -> int:
        """Make the set and say what is in it."""
        import secrets

        from cmp_tactile_bringup.calibration.practice import board_for, make_practice_set
        from cmp_tactile_bringup.terminal import shown_stages
        from cmp_tactile_processing.sensor.description import load_sensor

        seed = secrets.randbelow(MAX_SEED) if self.seed is None else self.seed
        sensor, folder = load_sensor(self.sensor), expanded_path(self.output)
        with shown_stages() as on_stage:
            make_practice_set(sensor, seed, self.images, folder, on_stage)
        target, quoted = board_for(sensor), shlex.quote(str(folder))
        board = f"--board {target.cols}x{target.rows} --square {target.square:g}"
        print(f"Practice set in {folder}: docs/tutorials/calibrate.md goes through it.")
        for words in (
            f"check {quoted}/contact --sensor {quoted}/sensor.yaml",
            f"board {quoted}/board --sensor {quoted}/sensor.yaml {board} --output board.yaml",
            f"gel {quoted}/rest --sensor board.yaml --output my_sensor.yaml",
            f"check {quoted}/contact --sensor my_sensor.yaml",
        ):
            print(f"  cmp_tactile calibrate {words}")
        return 0
