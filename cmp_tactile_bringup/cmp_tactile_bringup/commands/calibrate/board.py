"""`cmp_tactile calibrate board`: camera and mirrors, or two cameras, from images of a board."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between
from cmp_tactile_bringup.commands.calibrate.arguments import LIVE, add_output, add_timeout

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.terminal.stages import CountingBar
    from cmp_tactile_processing.calibration.board.target import BoardTarget
    from cmp_tactile_processing.calibration.outcome import CalibrationOutcome
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Find focal lengths, principal point, distortion and the mirrors (or the place of one camera to the
other) from images of a flat board, before the gel is mounted. About 20 images with the board in
different places and tilts, where the gel will be.

Writes NEW.yaml (description of the sensor), NEW_left.yaml and NEW_right.yaml (camera_info of ROS)
only where the result is accepted; NEW_calibration/index.html shows the residuals either way.
For two cameras without a sensor description, give their images with --left and --right, and a
folder as --output, which gets left.yaml and right.yaml.
"""
EPILOG = """\
examples:
  cmp_tactile calibrate board images --sensor my_rig.yaml --board 9x6 --square 0.0015 \\
      --output board.yaml
  cmp_tactile calibrate board --topic /my_rig/image_raw --sensor my_rig.yaml --board 9x6 \\
      --square 0.0015 --images 20 --output board.yaml
  cmp_tactile calibrate board --left left*.jpg --right right*.jpg --board 9x6 --square 0.025 \\
      --output cameras
"""
IMAGES = 20


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "board",
        parents=[common],
        help="camera and mirrors from images of a board",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_images(parser)
    _add_board(parser)
    add_output(parser, "description to write, with the camera_info files beside it")
    parser.set_defaults(run=run, wrong_usage=parser.error)


def _add_images(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input",
        nargs="?",
        type=Path,
        metavar="INPUT",
        help="a folder of images, or a ROS 2 bag: whole camera frames",
    )
    parser.add_argument("--topic", default="", metavar="/NS/image_raw", help=LIVE)
    parser.add_argument("--left", nargs="+", type=Path, metavar="FILE", help="of the left camera")
    parser.add_argument("--right", nargs="+", type=Path, metavar="FILE", help="of the right camera")
    parser.add_argument(
        "--sensor", help="description of the rig as designed: its file, or a packaged name"
    )
    parser.add_argument(
        "--images",
        type=whole_between(3, 1000),
        default=IMAGES,
        metavar="N",
        help="how many to take of a live topic (default: %(default)s)",
    )
    add_timeout(parser)


def _add_board(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--board",
        required=True,
        type=_board_size,
        metavar="COLSxROWS",
        help="inner corners: a board of 10 x 7 squares has 9x6",
    )
    parser.add_argument(
        "--square",
        required=True,
        type=number_between(1e-4, 1, "m"),
        metavar="M",
        help="side of a square, in m: measure it",
    )
    parser.add_argument(
        "--charuco", default="", metavar="DICT", help="ChArUco board with this OpenCV dictionary"
    )
    parser.add_argument(
        "--marker",
        type=number_between(1e-5, 1, "m"),
        metavar="M",
        help="side of a marker of a ChArUco board, in m",
    )


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, report, and write what is accepted."""
    from cmp_tactile_processing.calibration.board.target import BoardTarget

    _check_usage(arguments)
    cols, rows = arguments.board
    if arguments.charuco:
        target = BoardTarget(
            "charuco", cols, rows, arguments.square, arguments.marker, arguments.charuco
        )
    else:
        target = BoardTarget("chessboard", cols, rows, arguments.square)
    if arguments.left:
        return _run_cameras(arguments, target)
    return _run_sensor(arguments, target)


def _check_usage(arguments: argparse.Namespace) -> None:
    """End with the usage where arguments do not go together."""
    sources = [arguments.input is not None, bool(arguments.left)]
    if sum(sources) > 1 or not (any(sources) or arguments.topic):
        arguments.wrong_usage("one of INPUT, --topic and --left is required")
    if arguments.right and not arguments.left:
        arguments.wrong_usage("--right needs --left; one camera alone is --left")
    if not arguments.left and not arguments.sensor:
        arguments.wrong_usage("--sensor is required, except for cameras given with --left")
    if bool(arguments.charuco) != (arguments.marker is not None):
        arguments.wrong_usage("--charuco and --marker belong together")


def _run_cameras(arguments: argparse.Namespace, target: BoardTarget) -> int:
    """Two cameras, or one, without a sensor."""
    from cmp_tactile_bringup.calibration.files import CalibrationFiles
    from cmp_tactile_bringup.calibration.frames import read_images
    from cmp_tactile_bringup.commands.calibrate.outcome import conclude
    from cmp_tactile_bringup.terminal.stages import shown_count
    from cmp_tactile_processing.calibration.board.calibrate import calibrate_cameras

    views = ("left", "right") if arguments.right else ("left",)
    files = CalibrationFiles.of_cameras(arguments.output, views)
    files.check_free(overwrite=arguments.overwrite)
    images = {view: read_images(getattr(arguments, view)) for view in views}
    with shown_count() as count:
        outcome = calibrate_cameras(images["left"], images.get("right"), target, on_progress=count)
    pictures = {view: items[0] for view, items in images.items()}
    return conclude(outcome, files, pictures, arguments.output.name)


def _run_sensor(arguments: argparse.Namespace, target: BoardTarget) -> int:
    """The rig of a description."""
    from cmp_tactile_bringup.calibration.files import CalibrationFiles
    from cmp_tactile_bringup.calibration.frames import FrameSelection, read_frames
    from cmp_tactile_bringup.commands.calibrate.outcome import conclude, view_pictures, warn
    from cmp_tactile_bringup.terminal.stages import shown_count
    from cmp_tactile_processing.sensor.library import load_sensor

    sensor = load_sensor(arguments.sensor)
    files = CalibrationFiles.of_sensor(arguments.output, tuple(sensor.views))
    files.check_free(overwrite=arguments.overwrite)
    if arguments.input is None:
        frames = _capture(arguments, sensor, target, files.report / "frames")
    else:
        size = (sensor.image.width, sensor.image.height)
        found = read_frames(arguments.input, FrameSelection(topic=arguments.topic), size)
        warn(found.problem)
        frames = found.images
    with shown_count() as count:
        outcome = _calibrate(frames, target, sensor, count)
    return conclude(outcome, files, view_pictures(sensor, frames[0]), sensor.name)


def _calibrate(
    frames: list[NDArray[np.uint8]],
    target: BoardTarget,
    sensor: SensorDescription,
    count: CountingBar,
) -> CalibrationOutcome:
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_processing.calibration.board.calibrate import (
        calibrate_cameras,
        calibrate_mirror_rig,
    )

    if sensor.optics.type == "mirror_stereo":
        return calibrate_mirror_rig(frames, target, sensor, on_progress=count)
    views = [view_pictures(sensor, frame) for frame in frames]
    first, *others = sensor.views
    return calibrate_cameras(
        [item[first] for item in views],
        [item[others[0]] for item in views] if others else None,
        target,
        on_progress=count,
        sensor=sensor,
    )


def _capture(
    arguments: argparse.Namespace, sensor: SensorDescription, target: BoardTarget, folder: Path
) -> list[NDArray[np.uint8]]:
    """Frames of a live topic in which the board is seen, still, and elsewhere than before.

    They are kept in the folder, so that the calibration can be repeated without taking them anew.
    """
    import shutil

    import cv2
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from cmp_tactile_bringup.calibration.board_capture import BoardCapture, Choice
    from cmp_tactile_bringup.calibration.live import LiveFrames
    from cmp_tactile_bringup.commands.calibrate.outcome import view_pictures
    from cmp_tactile_bringup.terminal.tables import output_console
    from cmp_tactile_processing.calibration.board.target import find_board

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    size = (sensor.image.width, sensor.image.height)
    capture = BoardCapture(target)
    kept: list[NDArray[np.uint8]] = []
    columns = (TextColumn("images kept"), BarColumn(), MofNCompleteColumn())
    note = TextColumn("{task.description}", markup=False)
    weights = sensor.tracking.grey_weights
    with (
        LiveFrames(arguments.topic, size, arguments.timeout, weights) as live,
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


def _board_size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) == 2 and all(part.isdigit() for part in parts):
        return int(parts[0]), int(parts[1])
    msg = f"found {text!r}, expected inner corners as 9x6"
    raise argparse.ArgumentTypeError(msg)
