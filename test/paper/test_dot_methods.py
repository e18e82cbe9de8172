"""The dot methods number and measure what is rendered, and leave out what is hidden."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Status, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Method, score_markers
from paper.dot_trackers import DMP_ASSIGNMENT, DMP_FLOW, DMP_GRID, DMP_NEAREST
from paper.sequence import PrintedGel

METHODS = (DMP_NEAREST, DMP_ASSIGNMENT, DMP_GRID, DMP_FLOW)
VIEW = "left"
# Rendered without noise: what 4 x 4 samples and 256 greys of a pixel leave, 3 times.
RMS_PX, MOST_PX = 0.015, 0.05
# Of 14 x 16 dots that are found independently, the RMS is known to 5 %; the model of the standard
# deviation is one number for large and small dots, which differ by a third.
STD_RATIO = (0.6, 1.5)


@dataclass(frozen=True)
class Shot:
    """A rendered frame and the true grid of the view."""

    rendered: RenderedFrame
    truth: Grid


@dataclass(frozen=True)
class Stage:
    """A sensor with dots, at rest, pressed, and with its middle moved by nearly a pitch."""

    sensor: SensorDescription
    gel: PrintedGel
    rest: Shot
    pressed: Shot
    jumped: Shot

    def image(self, shot: Shot, number: int = 0, **camera: float) -> NDArray[np.uint8]:
        """The view image."""
        settings = replace(CameraSettings(read_noise=0.0), **camera)  # type: ignore[arg-type]
        frame = self.gel.exposed(shot.rendered, number, settings)
        assert shot.truth.placement is not None
        return split_frame(frame, shot.truth.placement)


@pytest.fixture(scope="module")
def stage() -> Stage:
    sensor = load_scene("contact_sphere").sensor
    # Not square, so that rows and columns cannot be taken for each other.
    pattern = replace(sensor.pattern, rows=14, cols=16)
    sensor = replace(sensor, pattern=pattern)
    gel = PrintedGel(sensor, "dmp")
    grid = SurfaceGrid(41, 41, (0.02, 0.02))
    y, x = np.mgrid[-0.01:0.01:41j, -0.01:0.01:41j]
    bump = np.exp(-(x**2 + y**2) / (2 * 0.0025**2))[..., None]

    def shot(move: tuple[float, float, float]) -> Shot:
        surface = DeformedSurface(pattern, grid, bump * np.array(move))
        return Shot(gel.rendered(surface), gel.truth(surface).grids[VIEW])

    pitch = pattern.pitch
    return Stage(
        sensor,
        gel,
        rest=shot((0.0, 0.0, 0.0)),
        pressed=shot((0.2 * pitch, -0.2 * pitch, -0.5e-3)),
        jumped=shot((0.9 * pitch, 0.0, 0.0)),
    )


def _track(stage: Stage, method: Method, *images: NDArray[np.uint8]) -> Grid:
    """The grid of the last image of a sequence that begins at rest."""
    tracker = method.tracker(stage.sensor, VIEW)
    tracker.learn([images[0]])
    for image in images:
        grid = tracker.track(image)
    return grid


def _painted(
    stage: Stage, shot: Shot, hide: Callable[[NDArray[np.uint8], int, int], None]
) -> NDArray[np.uint8]:
    """The image of a shot with something on the dot (6, 7)."""
    image = stage.image(shot)
    x, y = np.rint(shot.truth.corners[6, 7]).astype(int)
    hide(image, x, y)
    return image


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.key)
def test_every_method_numbers_all_dots_of_a_moderate_deformation(
    stage: Stage, method: Method
) -> None:
    grid = _track(stage, method, stage.image(stage.rest), stage.image(stage.pressed))
    score = score_markers({VIEW: grid}, {VIEW: stage.pressed.truth})
    assert score.visible == grid.shape.rows * grid.shape.cols
    assert score.complete == 1


def test_the_nearest_dot_is_another_one_after_a_jump_of_most_of_a_pitch(stage: Stage) -> None:
    images = stage.image(stage.rest), stage.image(stage.jumped)
    truth = {VIEW: stage.jumped.truth}
    assert score_markers({VIEW: _track(stage, DMP_NEAREST, *images)}, truth).wrong > 5
    for method in (DMP_GRID, DMP_ASSIGNMENT):
        assert score_markers({VIEW: _track(stage, method, *images)}, truth).complete == 1


def test_centres_are_exact_to_the_pixels_noise(stage: Stage) -> None:
    grid = _track(stage, DMP_GRID, stage.image(stage.rest))
    error = np.linalg.norm(grid.corners - stage.rest.truth.corners, axis=-1)
    assert np.sqrt(np.mean(error**2)) < RMS_PX
    assert error.max() < MOST_PX


def test_a_fading_light_does_not_draw_the_centres(stage: Stage) -> None:
    grid = _track(stage, DMP_GRID, stage.image(stage.rest, light_ratio=4.0))
    error = grid.corners - stage.rest.truth.corners
    assert np.abs(error.mean(axis=(0, 1))).max() < RMS_PX / 3


@pytest.mark.parametrize("noise", [4.0, 16.0])
def test_the_standard_deviation_is_what_the_errors_show(stage: Stage, noise: float) -> None:
    grid = _track(stage, DMP_GRID, stage.image(stage.rest, read_noise=noise))
    error = grid.corners - stage.rest.truth.corners
    assert np.isfinite(error).all()
    assert grid.corner_std is not None
    ratio = np.sqrt(np.mean(error**2)) / grid.corner_std.mean()
    assert STD_RATIO[0] < ratio < STD_RATIO[1]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.key)
def test_a_hidden_dot_is_missing_and_not_guessed(stage: Stage, method: Method) -> None:
    def hide(image: NDArray[np.uint8], x: int, y: int) -> None:
        image[y - 8 : y + 9, x - 8 : x + 9] = image[y - 9, x - 9]

    grid = _track(stage, method, stage.image(stage.rest), _painted(stage, stage.pressed, hide))
    _assert_only_one_missing(grid, stage.pressed.truth)


@pytest.mark.parametrize("grey", [255, 0])
def test_a_dot_that_is_hidden_in_part_is_missing(stage: Stage, grey: int) -> None:
    def hide(image: NDArray[np.uint8], x: int, y: int) -> None:
        image[y - 8 : y + 9, x : x + 6] = grey

    _assert_only_one_missing(
        _track(stage, DMP_GRID, _painted(stage, stage.pressed, hide)), stage.pressed.truth
    )


def _assert_only_one_missing(grid: Grid, truth: Grid) -> None:
    missing = np.argwhere(grid.corner_status == Status.MISSING)
    assert missing.tolist() == [[6, 7]]
    assert np.isnan(grid.corners[6, 7]).all()
    assert score_markers({VIEW: grid}, {VIEW: truth}).wrong == 0


def test_numbers_are_right_where_the_border_is_hidden(stage: Stage) -> None:
    image = stage.image(stage.pressed)
    x = stage.pressed.truth.corners[:, 0, 0]
    edge = round(float(x.max() if x.mean() < 256 else x.min()))
    if x.mean() < 256:
        image[:, : edge + 6] = 205
    else:
        image[:, edge - 6 :] = 205
    grid = _track(stage, DMP_GRID, image)
    score = score_markers({VIEW: grid}, {VIEW: stage.pressed.truth})
    assert score.wrong == 0
    assert score.found_visible > 0.7 * score.visible


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.key)
def test_nothing_is_found_in_nothing_and_the_next_frame_is_right(
    stage: Stage, method: Method
) -> None:
    rest = stage.image(stage.rest)
    tracker = method.tracker(stage.sensor, VIEW)
    tracker.learn([rest])
    for grey in (0, 120, 255):
        grid = tracker.track(np.full_like(rest, grey))
        assert grid.found_fraction == 0
        assert grid.reason
    grid = tracker.track(rest)
    assert score_markers({VIEW: grid}, {VIEW: stage.rest.truth}).complete == 1
