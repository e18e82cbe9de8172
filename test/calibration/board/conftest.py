"""Frames of boards in front of rigs that are not as described."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from calibration_rigs import Frames, photograph
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.practice import changed_rig
from cmp_tactile_processing.calibration.board import images
from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import ImageSize, Roi

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
def frames(built: SensorDescription, chessboard: BoardTarget) -> Frames:
    """12 frames of the chessboard in the rig that was built."""
    return photograph(built, chessboard, count=12)
