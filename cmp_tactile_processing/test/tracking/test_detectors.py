"""The detectors: which corners of a known grid they see, and what joins them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.image.prepared import Prefilter
from cmp_tactile_processing.tracking.contour_stitching.stitcher import ContourStitching, largest_set
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import NominalGrid
from cmp_tactile_processing.tracking.numbering.components import traverse

# Within this a corner is none of its neighbours, and a saddle-point fit finds it.
CAPTURE = 0.3


def rig_of(sensor, view, name="contour_stitching"):
    """Nominal grid in view pixels, the detector as the tracker calls it, whether dark is first."""
    geometry = build_views(sensor)[view]
    place = geometry.placement
    nominal = NominalGrid.of_view(sensor.pattern, geometry)
    dark_first = sensor.pattern.corner_checker == "dark"
    shape = place.height, place.width
    stitching = name == "contour_stitching"
    detector = ContourStitching(nominal, dark_first) if stitching else SaddleLattice(nominal, shape)
    prefilter = Prefilter(shape, nominal.side_px)
    return nominal, lambda image: detector.corner_graph(prefilter.prepare(image)), dark_first


def seen(graph, truth, dark_first):
    """Which corners (rows, cols) the largest set holds; asserts that nothing in it is false."""
    rows, cols = truth.shape[:2]
    found = np.zeros((rows, cols), dtype=bool)
    components = traverse(graph)
    if not components:
        return found
    component = components[0]
    distance, nearest = cKDTree(truth.reshape(-1, 2)).query(component.position)
    number = np.stack(np.unravel_index(nearest, (rows, cols)), axis=1)
    side = np.linalg.norm(np.gradient(truth, axis=1), axis=-1)[number[:, 0], number[:, 1]]
    assert (distance < CAPTURE * side).all()
    assert len(np.unique(number - component.number, axis=0)) == 1
    np.testing.assert_array_equal(component.even, (number.sum(axis=1) % 2 == 0) == dark_first)
    found[number[:, 0], number[:, 1]] = True
    return found


@pytest.mark.parametrize("name", ["rest", "slide", "press", "twist", "bumps"])
@pytest.mark.parametrize("view", ["left", "right"])
def test_the_whole_grid_of_a_deformed_gel_hangs_together(sensor, stills, view_image, name, view):
    _, detect, dark_first = rig_of(sensor, view)
    still = stills[name]
    truth = build_views(sensor)[view].placement.from_frame(still.truth[f"corners_{view}_px"])
    assert seen(detect(view_image(still, view)), truth, dark_first).all()


def blurred(image, rng):
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3.5), np.uint8)


def noisy(image, rng):
    return np.clip(image + rng.normal(0, 16, image.shape), 0, 255).astype(np.uint8)


def dim_to_one_side(image, rng):
    return np.rint(image * np.linspace(0.2, 1, image.shape[1])).astype(np.uint8)


def spotted(image, rng):
    """Forty spots of missing ink and of dirt, up to two thirds of a checker wide."""
    image = image.copy()
    for _ in range(40):
        place = [int(rng.integers(0, size)) for size in image.shape[::-1]]
        cv2.circle(image, place, int(rng.integers(2, 6)), float(rng.choice([30, 180])), -1)
    return image


def ragged(image, rng):
    """Edges stray by 1.4 px rms, 0.06 mm on the sample rig, over 2 px along them."""
    stray = [cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), 2.0) for _ in range(2)]
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    at = [(q + 1.4 * s / s.std()).astype(np.float32) for q, s in zip((x, y), stray, strict=True)]
    return np.asarray(cv2.remap(image, *at, cv2.INTER_LINEAR), np.uint8)


@pytest.mark.parametrize(
    ("degrade", "share"),
    [(blurred, 1.0), (noisy, 1.0), (dim_to_one_side, 1.0), (spotted, 0.97), (ragged, 0.85)],
)
def test_most_corners_of_a_flawed_image_hang_together(sensor, stills, view_image, degrade, share):
    _, detect, dark_first = rig_of(sensor, "left")
    truth = build_views(sensor)["left"].placement.from_frame(
        stills["slide"].truth["corners_left_px"]
    )
    image = degrade(view_image(stills["slide"], "left"), np.random.default_rng(4))
    assert seen(detect(image), truth, dark_first).mean() >= share


DETECTORS = ("contour_stitching", "saddle_lattice")


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("pattern", [(4, 4, "dark"), (5, 12, "light"), (60, 60, "dark")], ids=str)
def test_any_count_and_either_colour(plane_rig, render_rest, name, pattern):
    """At 60 x 60 checkers are 5 px wide and are magnified."""
    rig = plane_rig(*pattern)
    nominal, detect, dark_first = rig_of(rig, "right", name)
    assert seen(detect(render_rest(rig, "right")), nominal.corners, dark_first).all()


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("change", [(18, 1.25, 0.0), (0, 1.0, 0.25)], ids=str)
def test_a_grid_that_is_turned_and_stretched_or_sheared(plane_rig, render_rest, name, change):
    degrees, stretch, shear = change
    rig = plane_rig(9, 9)
    nominal, detect, dark_first = rig_of(rig, "left", name)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    way = np.array([[c, -s], [s, c]]) @ [[stretch, shear], [0.3 * shear, 1 / stretch]]
    middle = nominal.corners.mean(axis=(0, 1))
    shift, image = middle - way @ middle, render_rest(rig, "left")
    moved = cv2.warpAffine(
        image, np.c_[way, shift], image.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    assert seen(detect(moved), nominal.corners @ way.T + shift, dark_first).all()


def test_a_hidden_part_and_clutter_cost_no_more_than_themselves(sensor, stills, view_image):
    """Checkers of another size and noise over a third of the pattern give no false pointer."""
    nominal, detect, dark_first = rig_of(sensor, "left")
    image = view_image(stills["rest"], "left").copy()
    rng = np.random.default_rng(3)
    low = nominal.corners[:, :7, 0].max()
    hidden = np.arange(image.shape[1]) < low
    clutter = 60 + 120 * (np.add.outer(*(np.arange(n) // 9 for n in image.shape)) % 2)
    image[:, hidden] = (clutter + rng.normal(0, 8, image.shape))[:, hidden].clip(0, 255)
    visible = nominal.corners[..., 0] > low + 2 * nominal.side_px
    found = seen(detect(image), nominal.corners, dark_first)
    assert found[visible].all()
    assert not found[nominal.corners[..., 0] < low - nominal.side_px].any()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_image_without_a_pattern_gives_no_corner(sensor, level):
    _, detect, _ = rig_of(sensor, "left")
    place = build_views(sensor)["left"].placement
    image = np.full((place.height, place.width), level, np.uint8)
    assert largest_set(detect(image)) == 0
    noise = np.random.default_rng(0).normal(level, 5, image.shape).clip(0, 255).astype(np.uint8)
    assert largest_set(detect(noise)) < 10
