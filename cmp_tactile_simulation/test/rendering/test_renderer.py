"""The renderer against rays cast by brute force, and against the projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Status
from cmp_tactile_simulation.rendering.ink import (
    DARK_GREY,
    HOUSING_GREY,
    LIGHT_GREY,
    Checkerboard,
    PrintDefects,
)
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, Renderer, true_grids
from cmp_tactile_simulation.rendering.surface import DeformedSurface

CONTRAST = LIGHT_GREY - DARK_GREY
RIGS = (
    "mirror_stereo",
    "two_view",
    "distorted",
    "equidistant",
    "layers",
    "cylinder",
    "light_corner",
    "one_mirror",
)


def _meet(surface, origins, directions):
    """Material points (n, 2) of rays with a surface without folds: Newton by differences."""
    t = -origins[:, 2:] / directions[:, 2:]
    xy = (origins + t * directions)[:, :2]
    step = 1e-7
    for _ in range(20):
        at = surface.at_material(xy)
        along = (surface.at_material(xy + [step, 0]) - at) / step
        across = (surface.at_material(xy + [0, step]) - at) / step
        matrix = np.stack([along, across, -directions], axis=-1)
        off = np.linalg.solve(matrix, (origins - at)[..., None])[..., 0]
        xy = xy + off[:, :2]
    return xy


def _sub_pixels(samples):
    """Offsets (samples^2, 2) from a pixel's centre, px."""
    place = (np.arange(samples) + 0.5) / samples - 0.5
    return np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 2)


def _brute_force(sensor, ink, surface, view, pixels):
    """Mean grey of pixels (n, 2) of the view, each by 24 x 24 rays and hard-edged ink."""
    q = pixels[:, None] + _sub_pixels(24)
    origins, directions = view.rays(q.reshape(-1, 2))
    xy = _meet(surface, origins, directions)
    return _grey(sensor, ink, xy).reshape(len(pixels), -1).mean(axis=1)


def _grey(sensor, ink, xy):
    # False for NaN, where a ray passes the sphere or cylinder.
    on_top = (np.abs(xy) <= np.divide(sensor.elastomer.size[:2], 2)).all(axis=-1)
    return np.where(on_top, ink.grey(xy), HOUSING_GREY)


@pytest.mark.parametrize("name", RIGS)
def test_every_kind_of_rig_shows_what_its_rays_meet(rigs, deformed, dent, name):
    sensor = rigs[name]
    surface, ink = deformed(sensor, dent), Checkerboard(sensor.pattern)
    frame = Renderer(sensor, ink).render(surface).pixels
    rng = np.random.default_rng(1)
    for view in build_views(sensor).values():
        image = split_frame(frame, view.placement)
        # As many pixels with an edge in them as without.
        edges = np.argwhere((image > DARK_GREY + 1) & (image < LIGHT_GREY - 1))[:, ::-1]
        anywhere = rng.integers(0, image.shape[::-1], (60, 2))
        pixels = np.concatenate([edges[rng.choice(len(edges), 60)], anywhere])
        shown = image[pixels[:, 1], pixels[:, 0]]
        off = shown - _brute_force(sensor, ink, surface, view, pixels.astype(float))
        # Hard-edged samples of 1/24 px are off by up to half of one along the whole edge.
        assert np.abs(off).max() < CONTRAST / 40
        assert np.sqrt((off**2).mean()) < CONTRAST / 100
        assert (np.ptp(shown) > 0.95 * CONTRAST).all(), "the pattern is in view"


def test_a_ridge_hides_what_lies_behind_it(rigs, deformed):
    """Against a march along the ray in steps of 10 um: which part of the surface comes first."""
    sensor, view, surface, depth = _ridge(rigs, deformed)
    ink = Checkerboard(sensor.pattern)
    image = split_frame(Renderer(sensor, ink).render(surface).pixels, view.placement)

    rng = np.random.default_rng(3)
    pixels = rng.integers((40, 90), (200, 130), (200, 2)).astype(float)
    origins, directions = view.rays(pixels)
    folded = 0
    for pixel, origin, direction in zip(pixels.astype(int), origins, directions, strict=True):
        xy, crossings = _march(depth, origin[None], direction[None], 1e-5)
        # Well inside a checker as seen from here, where a single ray gives the pixel's grey.
        around = xy + 6e-5 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [0, 0]])
        nearby = image[pixel[1] - 1 : pixel[1] + 2, pixel[0] - 1 : pixel[0] + 2]
        if np.ptp(_grey(sensor, ink, around)) == 0 and np.ptp(nearby) == 0:
            assert image[pixel[1], pixel[0]] == _grey(sensor, ink, xy), f"pixel {pixel}"
            folded += int(crossings[0] > 1)
    assert folded > 5, "some rays meet the surface more than once"


def _march(depth, origins, directions, step):
    """Where rays (n, 3) first come above the surface, (n, 2), and how often they cross it."""
    span = np.arange(0, 0.012, step)
    start = (-0.003 - origins[:, 2]) / directions[:, 2]
    p = origins[:, None] + (start[:, None] + span)[..., None] * directions[:, None]
    height = p[..., 2] - depth(p[..., :2])
    above = height >= 0
    crossings = np.count_nonzero(above[:, 1:] != above[:, :-1], axis=1)
    ray, last = np.arange(len(p)), np.argmax(above, axis=1)
    # Straight between two steps.
    low, high = height[ray, last - 1], height[ray, last]
    share = (high / (high - low))[:, None]
    return (share * p[ray, last - 1] + (1 - share) * p[ray, last])[:, :2], crossings


def _ridge(rigs, deformed):
    """A flat gel with a steep ridge that bulges towards a camera which looks across it, aslant."""
    sensor = rigs["aslant"]

    def field(x, y):
        return [0 * x, 0 * x, -2.5e-3 * np.exp(-((y - 0.15 * x) ** 2) / (2 * 9e-4**2))]

    surface = deformed(sensor, field)
    (view,) = build_views(sensor).values()
    # Points move along z alone: material point and place in x and y are the same.
    return sensor, view, surface, lambda xy: surface.at_material(xy)[..., 2]


def test_frames_do_not_depend_on_threads_nor_on_what_was_rendered_before(rigs, deformed, dent):
    sensor = rigs["mirror_stereo"]
    surface = deformed(sensor, dent)
    ink = Checkerboard(sensor.pattern, PrintDefects(missing_ink=20, ragged_edge=1e-5), seed=4)
    one, three = (Renderer(sensor, ink, threads=threads) for threads in (1, 3))
    first = one.render(surface).grey.tobytes()
    three.render(DeformedSurface.rest(sensor.pattern))
    assert three.render(surface).grey.tobytes() == first
    assert one.render(surface).grey.tobytes() == first


def test_defects_stick_to_the_skin(rigs, deformed, dent):
    """The difference that a blob makes lies, in every state, where its material point is."""
    sensor = rigs["mirror_stereo"]
    defects = PrintDefects(missing_ink=1, blob_radius=4e-4)
    clean, flawed = (
        Renderer(sensor, Checkerboard(sensor.pattern, item, seed=5))
        for item in (PrintDefects(), defects)
    )
    views = build_views(sensor)
    bins = Checkerboard(sensor.pattern, defects, seed=5).arrays.blobs
    blob = bins[np.isfinite(bins[..., 7])][0, :2]
    for surface in (DeformedSurface.rest(sensor.pattern), deformed(sensor, dent)):
        changed = np.abs(clean.render(surface).pixels - flawed.render(surface).pixels)
        for view in views.values():
            part = split_frame(changed, view.placement)
            v, u = np.nonzero(part > 20)
            assert len(u), "the blob covers some ink"
            q = view.project(surface.at_material(blob))
            # 0.4 mm times 1.5 for the size and 1.27 for the shape, at 8 px/mm.
            assert np.hypot(u - q[0], v - q[1]).max() < 7


@pytest.mark.parametrize("name", ["mirror_stereo", "two_view", "distorted", "layers"])
def test_grids_are_the_projection_of_the_surface(rigs, deformed, dent, name):
    sensor = rigs[name]
    surface = deformed(sensor, dent)
    truth, grids = OpticalTruth(sensor).surface(surface), true_grids(sensor, surface)
    for side, view in build_views(sensor).items():
        grid = grids[side]
        assert grid.shape == sensor.pattern.shape
        assert grid.placement == view.placement
        assert (grid.corner_status == Status.MEASURED).all()
        assert grid.found_fraction == 1.0
        assert not grid.reason
        for found, points in (
            (grid.corners, truth.position),
            (grid.row_lines, truth.row_position),
            (grid.col_lines, truth.col_position),
        ):
            np.testing.assert_allclose(found, view.project(points), atol=1e-9)


def test_markers_outside_the_view_are_missing(rigs):
    sensor = rigs["distorted"]
    left = sensor.views["left"]
    cut = replace(sensor, views={"left": replace(left, roi=replace(left.roi, width=150))})
    surface = DeformedSurface.rest(sensor.pattern)
    whole, part = (true_grids(item, surface)["left"] for item in (sensor, cut))
    outside = whole.corners[..., 0] > 149.5
    assert 0 < np.count_nonzero(outside) < outside.size
    np.testing.assert_array_equal(np.isnan(part.corners[..., 0]), outside)
    np.testing.assert_array_equal(part.corner_status == Status.MISSING, outside)
    np.testing.assert_array_equal(np.isnan(part.row_lines[..., 0]), part.row_line_status == 0)
    np.testing.assert_allclose(part.corners[~outside], whole.corners[~outside], atol=1e-9)
    assert part.reason == f"{np.count_nonzero(outside)} corners hidden or outside the view"


def test_markers_that_the_surface_hides_are_missing(rigs, deformed):
    """A steep bulge: each marker against a march along its own ray."""
    sensor = rigs["aslant"]

    def field(x, y):
        return [0 * x, 0 * x, -4e-3 * np.exp(-(x**2 + y**2) / (2 * 1e-3**2))]

    surface = deformed(sensor, field)
    grids = true_grids(sensor, surface)
    corners, hidden_in_all = surface.corners(), 0
    for side, view in build_views(sensor).items():
        origin = view.centre
        share = np.linspace(0.5, 1 - 1e-4, 4000)
        p = origin + share[:, None, None, None] * (corners - origin)
        height = p[..., 2] - surface.at_material(p[..., :2])[..., 2]
        hidden = (height > 2e-6).any(axis=0)
        np.testing.assert_array_equal(grids[side].corner_status == Status.MISSING, hidden)
        assert np.isnan(grids[side].corners[hidden]).all()
        hidden_in_all += np.count_nonzero(hidden)
    assert hidden_in_all > 0
