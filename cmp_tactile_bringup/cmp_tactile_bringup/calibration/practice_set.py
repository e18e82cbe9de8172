"""A set of simulated images to practise calibration on, of a rig that differs from its description.

The folder holds what somebody who builds a sensor has: the description that the rig was built by,
images of a board from before the gel was mounted, frames of the gel at rest, and a recording of a
contact.  What the rig really is like lies in truth/, for the end.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.practice_rig import (
    board_poses,
    changed_rig,
    photograph_board,
)
from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.recordings.library import DEFAULT_SCENE
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description
from cmp_tactile_simulation.recording.truth import RecordingWriter
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import SENSOR_FILE, load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

BOARD_FOLDER, REST_FOLDER, CONTACT_FOLDER, TRUTH_FOLDER = "board", "rest", "contact", "truth"
FOLDERS = (BOARD_FOLDER, REST_FOLDER, CONTACT_FOLDER, TRUTH_FOLDER)

# The board fills this share of the pattern's extent: it is seen whole in both views, tilted too.
BOARD_SHARE = 0.75
BOARD_COLS, BOARD_ROWS = 9, 6
SQUARE_STEP = 1e-4
FRAME_NOISE = 4.0
REST_FRAMES = 10

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class PracticeSet:
    """nominal: the description that the rig was built by.  seed: of how it really is, and of noise.

    board_images: number of images of the board.
    """

    nominal: SensorDescription
    seed: int
    board_images: int

    @cached_property
    def target(self) -> BoardTarget:
        """The board that is shown."""
        extent = self.nominal.pattern.pitch * (self.nominal.pattern.cols + 1)
        square = BOARD_SHARE * extent / (BOARD_COLS + 1)
        square = max(round(square / SQUARE_STEP), 1) * SQUARE_STEP
        return BoardTarget("chessboard", BOARD_COLS, BOARD_ROWS, square)


def make_practice_set(
    practice: PracticeSet, folder: Path, progress: Progress, *, overwrite: bool = False
) -> None:
    """Write the whole set into the folder.  progress: called with what is done and its share.

    Raises OutputError where the folder holds something, unless it is an earlier set that may be
    replaced; SimulationError for a sensor that cannot be simulated, CalibrationError for one whose
    views do not show a board.
    """
    _make_room(folder, overwrite=overwrite)
    true_rig = changed_rig(practice.nominal, practice.seed)
    write_sensor_description(folder / SENSOR_FILE, practice.nominal)
    _write_board(practice, true_rig, folder / BOARD_FOLDER, progress)
    _write_rest(practice, true_rig, folder / REST_FOLDER, progress)
    _write_contact(practice, true_rig, folder / CONTACT_FOLDER, progress)
    (folder / TRUTH_FOLDER).mkdir()
    write_sensor_description(folder / TRUTH_FOLDER / SENSOR_FILE, true_rig)


def _make_room(folder: Path, *, overwrite: bool) -> None:
    there = sorted(item.name for item in folder.iterdir()) if folder.is_dir() else []
    if folder.exists() and not folder.is_dir():
        msg = f"{folder}: found a file, expected a folder or a new name"
        raise OutputError(msg)
    strange = [name for name in there if name not in (*FOLDERS, SENSOR_FILE)]
    if strange:
        msg = f"{folder}: found {strange[0]}, expected a new folder or an earlier practice set"
        raise OutputError(msg)
    if there and not overwrite:
        msg = f"{folder}: exists already; --overwrite replaces it"
        raise OutputError(msg)
    for name in FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)


def _write_board(
    practice: PracticeSet, true_rig: SensorDescription, folder: Path, progress: Progress
) -> None:
    poses = board_poses(true_rig, practice.target, practice.board_images, practice.seed)
    folder.mkdir()
    for number, T_gel_board in enumerate(poses):
        progress("photographing the board", number / len(poses))
        image = photograph_board(
            true_rig,
            practice.target,
            T_gel_board,
            CameraSettings(read_noise=FRAME_NOISE),
            practice.seed + number,
        )
        _write_png(folder / f"{number:02d}.png", image)
    progress("photographing the board", 1.0)


def _write_rest(
    practice: PracticeSet, true_rig: SensorDescription, folder: Path, progress: Progress
) -> None:
    folder.mkdir()
    camera, pattern = CameraSettings(read_noise=FRAME_NOISE), true_rig.pattern
    rendered = Renderer(true_rig, Checkerboard(pattern)).render(DeformedSurface.rest(pattern))
    for number in range(REST_FRAMES):
        progress("photographing the gel at rest", number / REST_FRAMES)
        noise = random_stream(Purpose.FRAME_NOISE, practice.seed, number)
        _write_png(folder / f"{number:02d}.png", expose(rendered, camera, noise, practice.seed))
    progress("photographing the gel at rest", 1.0)


def _write_contact(
    practice: PracticeSet, true_rig: SensorDescription, folder: Path, progress: Progress
) -> None:
    """A bag as the rig's driver records it: its camera_info is that of the nominal description."""
    scene: Scene = load_scene(DEFAULT_SCENE)
    camera = replace(scene.camera, read_noise=FRAME_NOISE / 2)
    scene = replace(scene, sensor=true_rig, camera=camera, seed=practice.seed)
    simulation = Simulation(scene, progress=progress)
    writer = RecordingWriter(folder, practice.nominal)
    try:
        with closing(simulation.frames()) as frames:
            for frame in frames:
                writer.append(frame)
                progress("simulating a contact", (frame.index + 1) / scene.frame_count)
    finally:
        writer.close()
    write_sensor_description(folder / SENSOR_FILE, practice.nominal)


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), image):
        msg = f"{path}: cannot be written"
        raise OutputError(msg)
