"""A set of simulated images to practise calibration on, of a rig that differs from its description.

The folder holds what somebody who builds a sensor has: the description that the rig was built by,
images of a board from before the gel was mounted, frames of the gel at rest, and a recording of a
contact.  What the rig really is like lies in truth/, for the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.recordings.library import DEFAULT_SCENE
from cmp_tactile_processing.cache.files import write_whole
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.errors import CalibrationError, ContactError, InputError, OutputError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.rig_parameters import RigParameter, RigParameters, RigPrior
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.recording.truth import RecordingWriter
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import SENSOR_FILE, load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

# Directions of the changes are drawn so often until the pattern lies in all views.
MOST_DRAWS = 200
# The pattern keeps this distance from the sides of its view, in checkers.
MARGIN_CHECKERS = 1.5
# How far boards lean, rad, and lie off the gel's middle, in sides of the pattern.
LEAN, OFF_CENTRE, OFF_HEIGHT = 0.7, 0.25, 0.35
# Corners nearer than this to a view's border, px, are not counted on.
MARGIN_PX = 8.0
TRIES = 2000
# Squares of white paper around the board's squares.
PAPER = 1
# The board fills this share of the pattern's extent: it is seen whole in both views, tilted too.
BOARD_SHARE = 0.75
BOARD_COLS, BOARD_ROWS = 9, 6
SQUARE_STEP = 1e-4
FRAME_NOISE = 4.0
REST_FRAMES = 10


def changed_rig(
    sensor: SensorDescription,
    seed: int,
    turn: float = math.radians(1.0),
    shift: float = 0.5e-3,
    focal: float = 0.01,
) -> SensorDescription:
    """The sensor with gel, mirrors and camera changed by that much in random directions.

    turn: rad, of the gel about any axis and, to within a tenth, of each mirror's plane.  shift: m,
    of the gel along any direction and of each mirror along its normal.  focal: relative, of fx and
    fy alike.  Of a two_view sensor, each view's pose and camera.  The whole pattern at rest stays
    in all views.
    Raises ContactError where no direction leaves it there.
    """
    rng = random_stream(Purpose.CHANGED_RIG, seed)
    rig = RigParameters(sensor, RigPrior(turn, shift, focal, principal_point=0.0))
    for _ in range(MOST_DRAWS):
        changed = rig.sensor(rig.prior_std * _directions(rig.free, rng))
        if _shows_all(changed):
            return replace(changed, calibration=None)
    msg = (
        f"{sensor.name}: found no change by {math.degrees(turn):g} degrees, {shift * 1e3:g} mm and "
        f"{focal:.3g} in focal length that leaves the pattern in all views"
    )
    raise ContactError(msg)


def _directions(free: Sequence[RigParameter], rng: np.random.Generator) -> NDArray[np.float64]:
    """A random unit vector for each turn and shift of a rig, in the order of its values."""
    vectors = np.array([item.vector or item.name for item in free])
    drawn = rng.standard_normal(len(free))
    lengths = [np.linalg.norm(drawn[vectors == vector]) for vector in vectors]
    return np.asarray(drawn / lengths)


def _shows_all(sensor: SensorDescription) -> bool:
    try:
        views = build_views(sensor).values()
    except InputError:
        return False
    for view in views:
        q = view.project(sensor.pattern.corners())
        side = max(float(np.abs(np.diff(q, axis=axis)).max()) for axis in (0, 1))
        if not _within(view, q, MARGIN_CHECKERS * side):
            return False
    return True


def _within(view: ViewGeometry, q: NDArray[np.float64], margin: float) -> bool:
    """Whether all pixels keep a distance from the borders of their view, px."""
    last = np.array([view.placement.width, view.placement.height]) - 1.0
    return bool(((q > margin) & (q < last - margin)).all())


def bare_views(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    """The sensor's views without gel and plate: straight rays."""
    return build_views(replace(sensor, optics=replace(sensor.optics, layers=())))


def photograph_board(
    sensor: SensorDescription,
    target: BoardTarget,
    T_gel_board: NDArray[np.float64],
    camera: CameraSettings,
    seed: int,
) -> NDArray[np.uint8]:
    """The frame (height, width) uint8 of a chessboard in all views; the gel is not mounted.

    T_gel_board (4, 4): board frame (BoardTarget) -> gel frame; the board's front must face the
    cameras.  seed: of noise and dirt.  It is rendered as the flat pattern of a gel that lies where
    the board is, on white paper that reaches a square beyond it.
    """
    rig = _board_as_sensor(sensor, target, T_gel_board)
    rendered = Renderer(rig, Checkerboard(rig.pattern)).render(DeformedSurface.rest(rig.pattern))
    return expose(rendered, camera, random_stream(Purpose.FRAME_NOISE, seed), seed)


def _board_as_sensor(
    sensor: SensorDescription, target: BoardTarget, T_gel_board: NDArray[np.float64]
) -> SensorDescription:
    """The sensor with the board in place of its gel."""
    T_board_middle = np.eye(4)
    T_board_middle[:3, 3] = target.points.mean(axis=0)
    moved = T_gel_board @ T_board_middle
    squares = np.array([target.cols, target.rows]) + 1 + 2 * PAPER
    width, height = (squares * target.square).tolist()
    optics = replace(sensor.optics, layers=())
    if optics.T_camera_gel is not None:
        optics = replace(optics, T_camera_gel=optics.T_camera_gel @ moved)
    views = {
        name: view if view.T_view_gel is None else replace(view, T_view_gel=view.T_view_gel @ moved)
        for name, view in sensor.views.items()
    }
    return replace(
        sensor,
        optics=optics,
        views=views,
        pattern=Pattern(
            target.rows, target.cols, target.square, "dark", 0, PatternSurface("plane")
        ),
        elastomer=replace(sensor.elastomer, size=(width, height, sensor.elastomer.size[2])),
    )


def board_poses(
    sensor: SensorDescription, target: BoardTarget, count: int, seed: int = 0
) -> list[NDArray[np.float64]]:
    """Poses T_gel_board (4, 4) that show the whole board in all views, leaning to all sides.

    Raises CalibrationError where the board is too large for the views.
    """
    rng, views = np.random.default_rng(seed), list(bare_views(sensor).values())
    pattern = sensor.pattern
    reach = pattern.pitch * (max(pattern.rows, pattern.cols) - 1)
    poses: list[NDArray[np.float64]] = []
    for _ in range(TRIES):
        T_gel_board = _random_pose(target, reach, rng)
        points = target.points @ T_gel_board[:3, :3].T + T_gel_board[:3, 3]
        if all(_shows(view, points, T_gel_board[:3, 2]) for view in views):
            poses.append(T_gel_board)
            if len(poses) == count:
                return poses
    msg = (
        f"{target}: found {len(poses)} of {count} poses with the whole board in all views, "
        "expected all; make the squares smaller"
    )
    raise CalibrationError(msg)


def _random_pose(
    target: BoardTarget, reach: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A board about the gel's middle, its front towards the cameras below."""
    towards = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    lean = Rotation.from_rotvec(axis * LEAN * np.sqrt(rng.uniform()))
    turn = Rotation.from_euler("z", rng.uniform(-0.3, 0.3) + np.pi * rng.integers(2))
    T = np.eye(4)
    T[:3, :3] = (lean * turn).as_matrix()
    offset = rng.uniform(-1, 1, 3) * reach * (OFF_CENTRE, OFF_CENTRE, OFF_HEIGHT)
    T[:3, 3] = offset - T[:3, :3] @ target.points.mean(axis=0)
    return T


def _shows(view: ViewGeometry, points: NDArray[np.float64], inwards: NDArray[np.float64]) -> bool:
    """Whether a view sees all points on the front of a board, well within its borders."""
    if ((points - view.centre) @ inwards <= 0).any():
        return False
    return _within(view, view.project(points), MARGIN_PX)


def board_for(sensor: SensorDescription) -> BoardTarget:
    """A board that fits into the views of a sensor."""
    extent = sensor.pattern.pitch * (sensor.pattern.cols + 1)
    square = BOARD_SHARE * extent / (BOARD_COLS + 1)
    square = max(round(square / SQUARE_STEP), 1) * SQUARE_STEP
    return BoardTarget("chessboard", BOARD_COLS, BOARD_ROWS, square)


def make_practice_set(
    nominal: SensorDescription, seed: int, board_images: int, folder: Path, progress: OnProgress
) -> None:
    """Write the whole set into a new folder.  progress: called with what is done and its share.

    nominal: the description that the rig was built by.  seed: of how it really is, and of noise.
    Raises OutputError where the folder holds something; ContactError for a sensor that cannot be
    simulated, CalibrationError for one whose views do not show a board.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        msg = f"{folder}: exists already, expected a new folder"
        raise OutputError(msg)
    true_rig = changed_rig(nominal, seed)
    camera, target, surface = (
        CameraSettings(read_noise=FRAME_NOISE),
        board_for(nominal),
        DeformedSurface.rest(true_rig.pattern),
    )
    boards = (
        photograph_board(true_rig, target, T_gel_board, camera, seed + number)
        for number, T_gel_board in enumerate(board_poses(true_rig, target, board_images, seed))
    )
    rendered = Renderer(true_rig, Checkerboard(true_rig.pattern)).render(surface)
    noises = (random_stream(Purpose.FRAME_NOISE, seed, number) for number in range(REST_FRAMES))
    rest = (expose(rendered, camera, noise, seed) for noise in noises)
    folder.mkdir(parents=True, exist_ok=True)
    write_sensor_description(folder / SENSOR_FILE, nominal)
    for name, frames, count in (("board", boards, board_images), ("rest", rest, REST_FRAMES)):
        (folder / name).mkdir()
        for number, image in enumerate(frames):
            progress(f"photographing: {name}", (number + 1) / count)
            write_whole(
                folder / name / f"{number:02d}.png", cv2.imencode(".png", image)[1].tobytes()
            )
    _write_contact(nominal, true_rig, seed, folder / "contact", progress)
    (folder / "truth").mkdir()
    write_sensor_description(folder / "truth" / SENSOR_FILE, true_rig)


def _write_contact(
    nominal: SensorDescription,
    true_rig: SensorDescription,
    seed: int,
    folder: Path,
    progress: OnProgress,
) -> None:
    """A bag as the rig's driver records it: its camera_info is that of the nominal description."""
    scene = load_scene(DEFAULT_SCENE)
    camera = replace(scene.camera, read_noise=FRAME_NOISE / 2)
    scene = replace(scene, sensor=true_rig, camera=camera, seed=seed)
    with (
        closing(RecordingWriter(folder, nominal)) as writer,
        closing(Simulation(scene, progress=progress).frames()) as frames,
    ):
        for frame in frames:
            writer.append(frame)
            progress("simulating a contact", (frame.index + 1) / scene.frame_count)
    write_sensor_description(folder / SENSOR_FILE, nominal)
