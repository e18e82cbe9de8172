"""Frames of boards in front of rigs that are not as described."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from board_photographs import photograph_board
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.practice import board_poses, changed_rig
from cmp_tactile_processing.calibration.board import images
from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome, Severity
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import ImageSize, Roi
from cmp_tactile_simulation.rendering.camera import CameraSettings

Frames = list[NDArray[np.uint8]]
NOISE = 4.0
DISTORTION = (-0.1, 0.02, 1e-3, -5e-4, 0.0)


@pytest.fixture(autouse=True)
def found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board is looked for once in each image: most tests are of what follows from that."""
    monkeypatch.setattr(images, "find_board", _find_board)


_sightings: dict[object, object] = {}


def _find_board(image: NDArray[np.uint8], target: BoardTarget, view: str = "") -> object:
    key = image.tobytes(), image.shape, str(image.dtype), target, view
    if key not in _sightings:
        _sightings[key] = find_board(image, target, view)
    return copy.deepcopy(_sightings[key])


@pytest.fixture(scope="session")
def full_described() -> SensorDescription:
    """The sample rig: what the description says."""
    return load_sensor("sample_rig")


@pytest.fixture(scope="session")
def full_built(full_described: SensorDescription) -> SensorDescription:
    """What was built: mirrors 1 degree and 0.5 mm off, focal length 1 %, and a lens that bends."""
    return _as_built(full_described)


@pytest.fixture(scope="session")
def described(full_described: SensorDescription) -> SensorDescription:
    """The sample rig with half the resolution, which is quicker."""
    return _halved(full_described)


@pytest.fixture(scope="session")
def built(described: SensorDescription) -> SensorDescription:
    """What was built with half the resolution."""
    return _as_built(described)


def _as_built(sensor: SensorDescription) -> SensorDescription:
    rig = changed_rig(sensor, seed=4)
    assert rig.camera is not None
    return replace(rig, camera=replace(rig.camera, distortion=DISTORTION))


def _halved(sensor: SensorDescription) -> SensorDescription:
    camera, views = sensor.camera, {}
    assert camera is not None
    for name, view in sensor.views.items():
        roi = view.roi
        views[name] = replace(
            view, roi=Roi(roi.x // 2, roi.y // 2, roi.width // 2, roi.height // 2)
        )
    # The middle of the first pixel lies half a pixel from the image's border in both.
    half = {"cx": camera.cx / 2 - 0.25, "cy": camera.cy / 2 - 0.25}
    camera = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, **half)
    image = ImageSize(sensor.image.width // 2, sensor.image.height // 2)
    return replace(sensor, image=image, camera=camera, views=views)


@pytest.fixture(scope="session")
def full_chessboard() -> BoardTarget:
    """9 x 6 corners, 1.2 mm apart, for the full resolution."""
    return BoardTarget("chessboard", 9, 6, 1.2e-3)


@pytest.fixture(scope="session")
def chessboard() -> BoardTarget:
    """7 x 4 corners, 1.6 mm apart."""
    return BoardTarget("chessboard", 7, 4, 1.6e-3)


@pytest.fixture(scope="session")
def charuco() -> BoardTarget:
    """9 x 7 corners, 1.2 mm apart, with markers, for the full resolution."""
    return BoardTarget("charuco", 9, 7, 1.2e-3, 0.9e-3, "DICT_4X4_50")


@pytest.fixture(scope="session")
def photograph() -> Callable[..., Frames]:
    """Frames of a board in a rig: at given poses or `count` random ones."""

    def take(
        sensor: SensorDescription,
        target: BoardTarget,
        count: int = 15,
        poses: list[NDArray[np.float64]] | None = None,
        seed: int = 1,
    ) -> Frames:
        if poses is None:
            poses = board_poses(sensor, target, count, seed)
        camera = CameraSettings(read_noise=NOISE)
        return [photograph_board(sensor, target, T, camera, k) for k, T in enumerate(poses)]

    return take


@pytest.fixture(scope="session")
def frames(
    built: SensorDescription, chessboard: BoardTarget, photograph: Callable[..., Frames]
) -> Frames:
    """12 frames of the chessboard in the rig that was built."""
    return photograph(built, chessboard, count=12)


@pytest.fixture(scope="session")
def cut() -> Callable[[SensorDescription, Frames, str], Frames]:
    """Un-mirrored images of one view: those of the plain camera that the mirror makes."""

    def of_view(sensor: SensorDescription, frames: Frames, view: str) -> Frames:
        placement = build_views(sensor)[view].placement
        return [split_frame(frame, placement) for frame in frames]

    return of_view


@pytest.fixture(scope="session")
def length_errors() -> Callable[[dict[str, ViewGeometry], dict[str, ViewGeometry]], float]:
    """RMS of the relative error of lengths above 3 mm, seen by one rig and measured by another."""

    def measure(true: dict[str, ViewGeometry], found: dict[str, ViewGeometry]) -> float:
        rng = np.random.default_rng(5)
        p = rng.uniform(-5e-3, 5e-3, (1000, 3)) * (1, 1, 0.3)
        rays = [found[view].rays(true[view].project(p)) for view in ("left", "right")]
        measured = _midpoints(*rays[0], *rays[1])
        other = np.roll(np.arange(len(p)), 1)
        length = np.linalg.norm(p - p[other], axis=1)
        ratio = np.linalg.norm(measured - measured[other], axis=1) / length - 1
        return float(np.sqrt((ratio[length > 3e-3] ** 2).mean()))

    return measure


def _midpoints(
    o1: NDArray[np.float64],
    v1: NDArray[np.float64],
    o2: NDArray[np.float64],
    v2: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Midpoints of the common normals of rays, written out apart from the package's own."""
    way, cosine = o2 - o1, (v1 * v2).sum(axis=1)
    along1, along2 = (way * v1).sum(axis=1), (way * v2).sum(axis=1)
    t1 = (along1 - cosine * along2) / (1 - cosine**2)
    t2 = (cosine * along1 - along2) / (1 - cosine**2)
    return np.asarray((o1 + t1[:, None] * v1 + o2 + t2[:, None] * v2) / 2)


@pytest.fixture(scope="session")
def said() -> Callable[[CalibrationOutcome, Severity], str]:
    """All findings of a severity, text and advice, as one string."""

    def join(outcome: CalibrationOutcome, severity: Severity) -> str:
        chosen = [item for item in outcome.findings if item.severity is severity]
        assert all(item.text and item.advice for item in chosen)
        return " ".join(f"{item.text} {item.advice}" for item in chosen)

    return join
