"""Flaws of simulated prints are found where the simulator printed them, and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import Status, SurfaceGrid
from cmp_tactile_processing.tracking.print_inspection.defects import DefectKind
from cmp_tactile_processing.tracking.print_inspection.inspector import PrintInspection
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.ink import PrintDefects as Flaws
from cmp_tactile_simulation.rendering.renderer import Renderer, true_grids
from cmp_tactile_simulation.rendering.surface import DeformedSurface

# Samples of the print to a checker, by which its true flaws are measured.
FINE = 24
# How far beyond the outermost corners they are looked for, checkers; the inspection goes to 0.6.
RIM = 0.55
SIDE_PX = 16.8
BLOBS = Flaws(missing_ink=30, splashes=30, blob_radius=1.1e-4)


def photograph(sensor, ink, settings, surface=None):
    """Prepared image and true grid of the left view."""
    surface = surface or DeformedSurface.rest(sensor.pattern)
    rendered = Renderer(sensor, ink, samples=2).render(surface)
    frame = expose(rendered, settings, np.random.default_rng(ink.seed), ink.seed)
    grey = split_frame(frame, build_views(sensor)["left"].placement)
    smooth = np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.2), dtype=np.float32)
    contrast = float(np.ptp(np.percentile(grey, [5, 95])))
    image = PreparedImage(grey, smooth, 1.2, settings.read_noise, contrast)
    return image, true_grids(sensor, surface)["left"]


def inspected(sensor, ink, settings, surface=None):
    return inspect_frame(*photograph(sensor, ink, settings, surface))


def inspect_frame(image, grid):
    inspection = PrintInspection(grid.shape)
    inspection.add(image, grid)
    return inspection.result()


def spots(found):
    return [spot for spot in found.defects if spot.kind is not DefectKind.RAGGED_EDGE]


def true_spots(ink):
    """Kind, row, column and radius, px, of the flaws that make a difference."""
    pattern = ink.pattern
    i, j = (np.arange(-RIM, count - 1 + RIM, 1 / FINE) for count in (pattern.rows, pattern.cols))
    xy = pattern.at(*np.meshgrid(i, j, indexing="ij"))[..., :2]
    sound = replace(ink, defects=replace(ink.defects, missing_ink=0, splashes=0))
    change = ink.grey(xy) - sound.grey(xy)
    found = []
    for kind, mask in ((DefectKind.MISSING_INK, change > 0), (DefectKind.DIRT, change < 0)):
        count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        for label in range(1, count):
            radius = np.sqrt(stats[label, cv2.CC_STAT_AREA] / np.pi) * SIDE_PX / FINE
            col, row = centres[label] / FINE - RIM
            found.append((kind, row, col, radius))
    return found


def matched(spot, kind, row, col):
    return spot.kind is kind and np.hypot(spot.row - row, spot.col - col) < 0.35


@pytest.mark.parametrize(
    ("settings", "flaws", "smallest_px"),
    [
        (CameraSettings(read_noise=2), BLOBS, 2.0),
        (CameraSettings(read_noise=8, blur=1.5, light_ratio=3), BLOBS, 2.0),
        (CameraSettings(read_noise=2), replace(BLOBS, ragged_edge=1.5e-5), 2.0),
        (CameraSettings(read_noise=2, blur=3), replace(BLOBS, blob_radius=1.6e-4), 3.0),
    ],
)
def test_blobs_are_found_and_nothing_else(sensor, settings, flaws, smallest_px):
    """At least 90 % of those with a visible part as large as a disc of that radius."""
    ink = Checkerboard(sensor.pattern, flaws, seed=4)
    found, truth = spots(inspected(sensor, ink, settings)), true_spots(ink)
    large = [item for item in truth if item[3] >= smallest_px]
    assert len(large) >= 10
    hit = sum(any(matched(spot, *item[:3]) for spot in found) for item in large)
    assert hit >= 0.9 * len(large)
    within = [
        spot
        for spot in found
        if -0.5 < spot.row < sensor.pattern.rows - 0.5
        and -0.5 < spot.col < sensor.pattern.cols - 0.5
    ]
    false = [spot for spot in within if not any(matched(spot, *item[:3]) for item in truth)]
    assert false == []


@pytest.mark.parametrize(
    "settings",
    [
        CameraSettings(read_noise=0, blur=0.3),
        CameraSettings(read_noise=8, blur=3),
        CameraSettings(read_noise=2, light_ratio=5, vignette=0.5),
        CameraSettings(read_noise=2, blur=1.5),
        CameraSettings(read_noise=2, glare_spots=12),
    ],
)
def test_a_sound_print_gives_no_alarm(sensor, settings):
    found = inspected(sensor, Checkerboard(sensor.pattern, seed=5), settings)
    assert found.defects == ()
    assert found.corner_weight.min() == 1
    assert not found.row_line_doubtful.any()
    assert not found.col_line_doubtful.any()


def sheared(sensor):
    """The gel, dragged by more than a checker in its middle."""
    size = sensor.elastomer.size
    grid = SurfaceGrid(56, 56, size[:2])
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    strength = np.exp(-(x**2 + y**2) / (2 * 0.005**2))
    displacement = strength[..., None] * [8e-4, -4e-4, -3e-4]
    return DeformedSurface(sensor.pattern, grid, displacement)


def test_flaws_stay_at_their_places_when_the_gel_is_dragged(sensor):
    """What was found at rest holds for the same numbers in every later frame."""
    flaws = replace(BLOBS, missing_ink=12, splashes=12, ragged_edge=1e-5)
    ink = Checkerboard(sensor.pattern, flaws, seed=6)
    settings = CameraSettings(read_noise=2)
    rest = inspected(sensor, ink, settings)
    dragged = inspected(sensor, ink, settings, sheared(sensor))
    assert dragged.judged == pytest.approx(rest.judged, abs=0.01)
    assert len(spots(rest)) >= 15
    bare = sum(spot.kind is DefectKind.MISSING_INK for spot in rest.defects)
    destroyed = rest.corner_weight == 0
    assert destroyed.any()
    for said in (f"{bare} spots without ink", f"{destroyed.sum()} corners are destroyed"):
        assert said in rest.report
    again = sum(
        any(matched(spot, other.kind, other.row, other.col) for spot in spots(dragged))
        for other in spots(rest)
    )
    assert again >= len(spots(rest)) - 1
    assert (dragged.corner_weight[destroyed] < 0.5).all()


def test_the_tracker_s_markers_show_how_ragged_the_print_is(sensor):
    """15 um are 0.36 px here; the lens takes away what changes over less than its blur."""
    ink = Checkerboard(sensor.pattern, Flaws(ragged_edge=1.5e-5), seed=2)
    image, _ = photograph(sensor, ink, CameraSettings(read_noise=1))
    grid = GridTracker(sensor, "left").track(image.grey)
    assert np.mean(grid.corner_status == Status.MEASURED) > 0.98
    found = inspect_frame(image, grid)
    assert 0.15 < found.raggedness_px < 0.37
    assert spots(found) == []


@pytest.fixture(scope="module")
def sound(sensor):
    """A frame of a print without flaws: what its image is made with."""
    return sensor, Checkerboard(sensor.pattern, seed=5), CameraSettings(read_noise=2)


def test_one_ragged_edge_is_named(sound):
    image, grid = photograph(*sound)
    for lines in (grid.row_lines, grid.col_lines):
        lines[:] += np.random.default_rng(1).normal(0, 0.1, lines.shape)
    grid.row_lines[3, 4, :, 1] += [0.45, -0.4, 0.45, -0.4, 0.4, -0.45]
    found = inspect_frame(image, grid)
    assert [(x.kind, x.row, x.col) for x in found.defects] == [(DefectKind.RAGGED_EDGE, 3, 4.5)]


def test_what_is_hidden_is_not_inspected(sound):
    """A finger is no flaw of the print."""
    image, grid = photograph(*sound)
    middle = int(grid.corners[..., 0].mean())
    image.grey[:, middle:] = image.smooth[:, middle:] = 120
    hidden = grid.corners[..., 0] > middle
    grid.corners[hidden], grid.corner_status[hidden] = np.nan, Status.MISSING
    found = inspect_frame(image, grid)
    assert found.defects == ()
    assert 0.3 < found.judged < 0.7
    assert (found.corner_weight[hidden] == 1).all()


def test_several_frames_show_what_one_cannot(sensor):
    """Small spots under strong noise."""
    ink = Checkerboard(sensor.pattern, replace(BLOBS, blob_radius=7e-5), seed=4)
    inspection = PrintInspection(sensor.pattern.shape)
    with pytest.raises(CalibrationError, match="no frames"):
        inspection.result()
    image, grid = photograph(sensor, ink, CameraSettings(read_noise=0, blur=1.5))
    found = []
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(0, 16, image.grey.shape)
        grey = np.clip(np.rint(image.grey + noise), 0, 255).astype(np.uint8)
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.2)
        inspection.add(replace(image, grey=grey, smooth=smooth, noise=16.0), grid)
        if seed in (0, 11):
            found.append(inspection.result())
    truth = true_spots(ink)
    one, all_of_them = (
        sum(any(matched(spot, *item[:3]) for spot in spots(state)) for item in truth)
        for state in found
    )
    assert [state.frames for state in found] == [1, 12]
    assert all_of_them > 1.5 * one


def test_frames_of_another_rest_or_size_are_refused(sound):
    image, grid = photograph(*sound)
    inspection = PrintInspection(grid.shape)
    inspection.add(image, grid)
    with pytest.raises(CalibrationError, match=r"the gel 2\.8\d px from"):
        inspection.add(image, replace(grid, corners=grid.corners + 2.0))
    with pytest.raises(InputError, match="found an image of"):
        inspection.add(replace(image, grey=image.grey[:40, :50]), grid)
    assert inspection.result().frames == 1


@pytest.mark.parametrize("grey", [0, 120])
def test_an_image_without_the_print_is_not_inspected(sound, grey):
    image, grid = photograph(*sound)
    image.grey[:] = image.smooth[:] = grey
    found = inspect_frame(image, grid)
    assert (found.judged, found.defects) == (0, ())
    assert found.corner_weight.min() == 1
