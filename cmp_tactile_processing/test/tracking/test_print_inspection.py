"""Flaws drawn into a print are found, named and weighted; a sound print is left alone.

The prints are drawn in closed form, seen at a slant, with 3 x 3 samples a pixel.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import GeometryError, ReferenceFramesError
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import Grid, GridShape, Status
from cmp_tactile_processing.tracking.print_inspection.defects import DefectKind
from cmp_tactile_processing.tracking.print_inspection.inspector import PrintInspection

SAMPLES = 3
DARK, LIGHT = 45.0, 195.0
# Points on each edge between which its straying is a straight line, per checker.
STRAY_POINTS = 8


@dataclass(frozen=True)
class Blob:
    """A disc of bare skin (light) or of dirt, place in grid numbers, radius in checkers."""

    row: float
    col: float
    radius: float
    light: bool


@dataclass(frozen=True)
class DrawnPrint:
    """A print with rows x cols corners and checkers of side_px in the middle of the image.

    ragged_px: rms by which edges stray.  slant: share by which checkers grow across the image.
    """

    rows: int = 10
    cols: int = 12
    side_px: float = 17.0
    per_segment: int = 6
    blobs: tuple[Blob, ...] = ()
    ragged_px: float = 0.0
    slant: float = 0.2
    turn: float = 0.1
    first_dark: bool = True
    seed: int = 0

    @property
    def homography(self):
        """From (j, i, 1) to pixels."""
        middle = np.array([(self.cols - 1) / 2, (self.rows - 1) / 2])
        reach = max(middle) + 2
        turned = np.array(
            [[np.cos(self.turn), -np.sin(self.turn)], [np.sin(self.turn), np.cos(self.turn)]]
        )
        H = np.eye(3)
        H[:2, :2] = self.side_px * turned
        H[:2, 2] = self.size / 2 - H[:2, :2] @ middle
        tilt = np.array(
            [[1, 0, 0], [0, 1, 0], [-self.slant / reach / 2, self.slant / reach / 3, 1]]
        )
        shift = np.eye(3)
        shift[:2, 2] = middle
        return H @ shift @ tilt @ np.linalg.inv(shift)

    @property
    def size(self):
        """Width and height of the image, px."""
        reach = (max(self.rows, self.cols) + 3) * self.side_px * (1 + self.slant / 2)
        return np.array([int(reach), int(reach)])

    @property
    def shape(self):
        return GridShape(self.rows, self.cols, self.per_segment)

    def pixels(self, i, j):
        """Pixels (..., 2) of grid numbers."""
        i, j = np.broadcast_arrays(i, j)
        q = np.stack([j, i, np.ones_like(i)], axis=-1) @ self.homography.T
        return np.asarray(q[..., :2] / q[..., 2:])

    def strays(self, axis):
        """Straying of each edge, checkers, at points 1 / STRAY_POINTS apart, from number -2 on."""
        rng = np.random.default_rng((self.seed, axis))
        count, along = (self.rows, self.cols) if axis == 0 else (self.cols, self.rows)
        # Linear interpolation keeps 2/3 of the variance on average.
        amount = self.ragged_px / self.side_px * np.sqrt(3 / 2)
        return amount * rng.normal(0, 1, (count + 4, (along + 4) * STRAY_POINTS))

    def edge(self, axis, number, along):
        """Straying of edges of that number at places along them, checkers."""
        strays = self.strays(axis)
        place = np.clip((along + 2) * STRAY_POINTS, 0, strays.shape[1] - 2)
        cell = place.astype(int)
        line = np.clip(number + 2, 0, strays.shape[0] - 1)
        rest = place - cell
        return strays[line, cell] * (1 - rest) + strays[line, cell + 1] * rest

    def ideal(self, blur_px, light=1.0):
        """The image before noise, (H, W) float."""
        width, height = self.size
        y, x = ((np.arange(count * SAMPLES) + 0.5) / SAMPLES - 0.5 for count in (height, width))
        q = np.stack([*np.broadcast_arrays(x[None], y[:, None]), np.ones((len(y), len(x)))], -1)
        number = q @ np.linalg.inv(self.homography).T
        j, i = number[..., 0] / number[..., 2], number[..., 1] / number[..., 2]
        near_i, near_j = np.rint(i).astype(int), np.rint(j).astype(int)
        row = near_i - (i < near_i + self.edge(0, near_i, j))
        col = near_j - (j < near_j + self.edge(1, near_j, i))
        grey = np.where(((row + col) % 2 == 0) == self.first_dark, DARK, LIGHT)
        for blob in self.blobs:
            inside = np.hypot(i - blob.row, j - blob.col) < blob.radius
            grey[inside] = LIGHT if blob.light else DARK
        printed = (row >= -1) & (row < self.rows) & (col >= -1) & (col < self.cols)
        grey[~printed] = LIGHT
        small = grey.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
        return cv2.GaussianBlur(small, (0, 0), blur_px) * light

    def grid(self, corner_noise_px=0.02, origin=(0, 0)):
        """The gridlines as a perfect tracker would measure them, with noise."""
        rng = np.random.default_rng((self.seed, 7))
        i, j = np.mgrid[: self.rows, : self.cols]
        share = (np.arange(self.per_segment) + 1) / (self.per_segment + 1)
        down = self.edge(0, i, j + 0.0), self.edge(1, j, i + 0.0)
        corners = self.pixels(i + down[0], j + down[1])
        corners = corners + rng.normal(0, corner_noise_px, corners.shape)
        i_row, j_row = i[:, :-1, None] + 0 * share, j[:, :-1, None] + share
        rows = self.pixels(i_row + self.edge(0, i_row.astype(int), j_row), j_row)
        i_col, j_col = i[:-1, :, None] + share, j[:-1, :, None] + 0 * share
        cols = self.pixels(i_col, j_col + self.edge(1, j_col.astype(int), i_col))
        grid = Grid.missing(self.shape, "")
        for status in (grid.corner_status, grid.row_line_status, grid.col_line_status):
            status[:] = Status.MEASURED
        return dataclasses.replace(
            grid,
            corners=corners + origin,
            row_lines=rows + rng.normal(0, corner_noise_px, rows.shape) + origin,
            col_lines=cols + rng.normal(0, corner_noise_px, cols.shape) + origin,
            row_line_std=np.full(self.shape.row_lines, corner_noise_px),
            col_line_std=np.full(self.shape.col_lines, corner_noise_px),
        )


def photograph(ideal, noise, seed=0):
    """A camera's image of it."""
    noisy = ideal + np.random.default_rng(seed).normal(0, noise, ideal.shape)
    grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.2), dtype=np.float32)
    return PreparedImage(grey, smooth, 1.2, noise, float(np.ptp(np.percentile(grey, [5, 95]))))


def inspect_frame(image, grid, *origin):
    """The state of the print as one frame shows it."""
    inspection = PrintInspection(grid.shape)
    inspection.add(image, grid, *origin)
    return inspection.result()


def inspect(drawn, noise=2.0, blur=0.8, light=1.0):
    return inspect_frame(photograph(drawn.ideal(blur, light), noise, drawn.seed), drawn.grid())


def assert_sound(found):
    assert found.defects == ()
    assert not found.row_line_doubtful.any()
    assert not found.col_line_doubtful.any()
    assert found.corner_weight.min() > 0.9
    assert found.judged > 0.98


def missing_ink(row, col, radius=0.2):
    return Blob(row, col, radius, light=True)


def dirt(row, col, radius=0.2):
    return Blob(row, col, radius, light=False)


@pytest.mark.parametrize("blur", [0.5, 3.0])
@pytest.mark.parametrize("noise", [0.0, 2.0, 8.0])
@pytest.mark.parametrize("shade", [0.0, 1.6], ids=["even light", "shading"])
def test_a_clean_print_gives_no_alarm(noise, blur, shade):
    drawn = DrawnPrint(seed=int(noise))
    x = np.linspace(0, 1, drawn.size[0])
    light = np.exp(-shade * x)[None] * (1 - shade / 4 * (x[:, None] - 0.5) ** 2)
    assert_sound(inspect(drawn, noise, blur, light))


@pytest.mark.parametrize(
    ("rows", "cols", "side", "blur"), [(4, 4, 60, 1.0), (5, 9, 40, 3.0), (30, 21, 9, 0.7)]
)
@pytest.mark.parametrize("first_dark", [True, False])
def test_a_clean_print_of_another_size_or_colour_gives_no_alarm(rows, cols, side, blur, first_dark):
    assert_sound(inspect(DrawnPrint(rows, cols, side, first_dark=first_dark), 2.0, blur))


def test_glare_is_not_taken_for_missing_ink():
    drawn = DrawnPrint()
    glared = drawn.ideal(0.8)
    y, x = np.mgrid[: glared.shape[0], : glared.shape[1]]
    centre = drawn.pixels(5.3, 4.6)
    glared += 400 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 12**2))
    found = inspect_frame(photograph(glared, 2.0), drawn.grid())
    assert found.defects == ()
    assert found.judged < 0.95


@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_spots_are_found_named_and_placed(noise):
    """On ink, on skin, across an edge and on the outermost checkers; of 2 px radius and more."""
    blobs = (
        missing_ink(2.5, 2.5, 0.13),
        missing_ink(6.35, 6.5, 0.2),
        missing_ink(-0.45, 3.4, 0.15),
        missing_ink(8.1, 8.5, 0.3),
        dirt(3.5, 6.5, 0.13),
        dirt(7.5, 2.6, 0.25),
        dirt(4.5, 11.4, 0.15),
    )
    drawn, origin = DrawnPrint(blobs=blobs), np.array([100.0, 40.0])
    image = photograph(drawn.ideal(0.8), noise)
    found = inspect_frame(image, drawn.grid(origin=origin), origin).defects
    assert len(found) == len(blobs)
    for blob in blobs:
        (near,) = (x for x in found if np.hypot(x.row - blob.row, x.col - blob.col) < 0.2)
        kind = DefectKind.MISSING_INK if blob.light else DefectKind.DIRT
        assert near.kind is kind
        assert near.cell == (np.floor(blob.row), np.floor(blob.col))
        # Half a pixel for the spot's noisy rim, a sixth of a checker where an edge cuts it.
        at = drawn.pixels(near.row, near.col) + origin
        np.testing.assert_allclose(near.centre_px, at, atol=0.6)
        assert near.extent_px == pytest.approx(2 * blob.radius * drawn.side_px, rel=0.4)


def test_a_smaller_part_of_few_spots_of_two_px_is_missed():
    """90 % of 80 discs of 2 px radius, anywhere where all of the disc makes a difference."""
    rng = np.random.default_rng(3)
    hit = 0
    for seed in range(2):
        i, j = (part.ravel() for part in np.mgrid[:9, :11])
        cell = rng.permutation(len(i))[:40]
        place = np.stack([i, j], axis=1)[cell] + rng.uniform(0.12, 0.88, (40, 2))
        blobs = [Blob(row, col, 2 / 17, light=(int(row) + int(col)) % 2 == 0) for row, col in place]
        found = inspect(DrawnPrint(blobs=tuple(blobs), slant=0.0, seed=seed)).defects
        spots = np.array([[spot.row, spot.col] for spot in found])
        hit += int((np.linalg.norm(place[:, None] - spots, axis=2).min(axis=1) < 0.2).sum())
        assert len(spots) <= 40
    assert hit >= 72


def test_several_frames_show_what_one_cannot():
    """A faint spot under strong noise."""
    faint = DrawnPrint(blobs=(missing_ink(4.5, 4.5, 0.07),))
    ideal = faint.ideal(2.0)
    inspection = PrintInspection(faint.shape)
    with pytest.raises(ReferenceFramesError, match="no frames"):
        inspection.result()
    assert inspect_frame(photograph(ideal, 12.0, 0), faint.grid()).defects == ()
    for seed in range(20):
        inspection.add(photograph(ideal, 12.0, seed), faint.grid())
    found = inspection.result()
    assert found.frames == 20
    assert [spot.cell for spot in found.defects] == [(4, 4)]


def test_a_spot_on_a_corner_destroys_it_and_what_is_next_to_it_alone():
    drawn = DrawnPrint(blobs=(dirt(4.0, 5.0, 0.25),))
    grid = drawn.grid()
    grid.corner_status[4, 5], grid.corners[4, 5] = Status.MISSING, np.nan
    found = inspect_frame(photograph(drawn.ideal(0.8), 2.0), grid)
    weight = found.corner_weight.copy()
    assert weight[4, 5] == 0
    weight[4, 5] = 1
    assert weight.min() > 0.9
    for line, ends in (
        (found.row_line_doubtful[4], (4, 5)),
        (found.col_line_doubtful[:, 5], (3, 4)),
    ):
        assert line[ends[0], -1]
        assert line[ends[1], 0]
    # Those half way to the next corner are out of its reach.
    assert not found.row_line_doubtful[:, :, 2:4].any()
    assert not found.col_line_doubtful[:, :, 2:4].any()
    others = np.delete(found.row_line_doubtful, 4, axis=0)
    assert not others.any()


def test_a_spot_beside_a_corner_weakens_it():
    weights = [
        inspect(DrawnPrint(blobs=(missing_ink(4 + away, 4 + away, 0.2),))).corner_weight[4, 4]
        for away in (0.05, 0.2, 0.5)
    ]
    assert weights[0] < 0.2
    assert weights[0] < weights[1] < 1
    assert weights[2] > 0.9


@pytest.mark.parametrize("ragged", [0.2, 0.5])
def test_raggedness_is_what_was_drawn(ragged):
    found = inspect(DrawnPrint(ragged_px=ragged, slant=0.0, turn=0.0))
    # The curves through ragged corners follow a little; the points are correlated.
    assert found.raggedness_px == pytest.approx(ragged, rel=0.15)
    assert np.nanmedian(found.row_raggedness) == pytest.approx(ragged, rel=0.25)
    assert [spot for spot in found.defects if spot.kind is not DefectKind.RAGGED_EDGE] == []


def test_noise_is_no_raggedness():
    drawn = DrawnPrint()
    image = photograph(drawn.ideal(0.8), 2.0)
    noisy = inspect_frame(image, drawn.grid(0.15))
    # Half of the noise; most of it in the curves through corners of the same noise.
    assert noisy.raggedness_px < 0.075
    assert noisy.defects == ()


def test_one_ragged_edge_is_named():
    drawn = DrawnPrint()
    grid = drawn.grid()
    grid.row_lines[3, 4, :, 1] += [0.9, -0.8, 1.0, -0.9, 0.7, -0.9]
    found = inspect_frame(photograph(drawn.ideal(0.8), 2.0), grid)
    assert found.row_line_doubtful[3, 4].all()
    ragged = dataclasses.replace(drawn, ragged_px=0.1).grid()
    ragged.row_lines[3, 4, :, 1] += [0.45, -0.4, 0.45, -0.4, 0.4, -0.45]
    found = inspect_frame(photograph(drawn.ideal(0.8), 2.0), ragged)
    assert [(x.kind, x.row, x.col) for x in found.defects] == [(DefectKind.RAGGED_EDGE, 3, 4.5)]


def test_what_is_hidden_is_not_inspected():
    drawn = DrawnPrint(blobs=(dirt(7.5, 2.5),))
    ideal, grid = drawn.ideal(0.8), drawn.grid()
    hidden = grid.corners[..., 0] > drawn.pixels(0.0, 7.5)[0]
    ideal[:, int(drawn.pixels(0.0, 7.5)[0]) :] = 120
    grid.corners[hidden], grid.corner_status[hidden] = np.nan, Status.MISSING
    found = inspect_frame(photograph(ideal, 2.0), grid)
    assert [spot.cell for spot in found.defects] == [(7, 2)]
    assert 0.4 < found.judged < 0.8
    # A finger is no flaw of the print.
    assert (found.corner_weight[hidden] == 1).all()


def test_where_something_presses_nothing_is_inspected():
    drawn = DrawnPrint()
    pressed, grid = drawn.ideal(0.8), drawn.grid()
    y, x = np.mgrid[: pressed.shape[0], : pressed.shape[1]].astype(np.float32)
    centre = drawn.pixels(4.5, 4.5)

    def shift(q):
        away = q - centre
        return 0.3 * away * np.exp(-(away**2).sum(axis=-1, keepdims=True) / (2 * 20**2))

    moved = np.stack([x, y], axis=-1) - shift(np.stack([x, y], axis=-1))
    image = cv2.remap(pressed, *np.moveaxis(moved.astype(np.float32), 2, 0), cv2.INTER_CUBIC)
    for _ in range(20):
        grid.corners[:] = drawn.grid(0).corners + shift(grid.corners)
    for status in (grid.row_line_status, grid.col_line_status):
        status[:] = Status.PREDICTED
    found = inspect_frame(photograph(image, 2.0), grid)
    assert found.defects == ()
    assert found.judged < 0.9
    assert found.corner_weight[4:6, 4:6].min() == 1


@pytest.mark.parametrize("grey", [0.0, 128.0, 255.0])
def test_an_image_without_the_print_is_not_inspected(grey):
    drawn = DrawnPrint()
    blank = np.full(drawn.size[::-1], grey)
    found = inspect_frame(photograph(blank, 1.0), drawn.grid())
    assert found.judged == 0
    assert found.defects == ()
    assert (found.corner_weight == 1).all()
    with pytest.raises(ReferenceFramesError, match="found 0% of the corners"):
        inspect_frame(photograph(drawn.ideal(0.8), 1.0), Grid.missing(drawn.shape, "hidden"))


def test_without_virtual_markers_spots_are_found_all_the_same():
    drawn = DrawnPrint(per_segment=0, blobs=(dirt(3.5, 4.5),))
    found = inspect(drawn)
    assert [spot.cell for spot in found.defects] == [(3, 4)]
    assert np.isnan(found.raggedness_px)


def test_frames_of_another_rest_or_size_are_refused():
    drawn = DrawnPrint()
    image = photograph(drawn.ideal(0.8), 2.0)
    inspection = PrintInspection(drawn.shape)
    inspection.add(image, drawn.grid())
    with pytest.raises(ReferenceFramesError, match=r"the gel 2\.8\d px from where"):
        inspection.add(image, drawn.grid(0, origin=(2.0, 2.0)))
    with pytest.raises(GeometryError, match="found an image of"):
        inspection.add(photograph(np.zeros((40, 50)), 1.0), drawn.grid())
    with pytest.raises(GeometryError, match="expected GridShape"):
        PrintInspection(GridShape(3, 3, 0)).add(image, drawn.grid())
    assert inspection.result().frames == 1


def test_the_report_says_what_was_found():
    text = inspect(DrawnPrint(blobs=(dirt(3.5, 4.5), missing_ink(2.5, 2.5, 0.3)))).report
    assert "1 spot without ink, 1 spot of dirt" in text
    assert "missing ink at row 2.5, column 2.5" in text
    assert "no defects" in inspect(DrawnPrint()).report
