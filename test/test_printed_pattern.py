"""Printed sheets, read back from their files: ink where the simulator has it, in every format."""

import base64
import itertools
import re
import zlib
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from cmp_tactile_bringup.printing.files import dxf_bytes, pdf_bytes, svg_bytes
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.printing.pattern import PrintOptions, printed_pattern
from cmp_tactile_processing.printing.sheet import print_sheet
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.rendering.ink import DARK_GREY, Checkerboard

# Edges are looked at this far to both sides, mm: what is promised of them.
EDGE_MM = 1e-3
# Coordinates in files, rounded to 10 nm and better.
ATOL_FILE_MM = 2e-5
# The PDF's page size is rounded to a ten-thousandth of a point, 0.04 um.
ATOL_PAGE_MM = 4e-5
POINTS_PER_MM = 72 / 25.4
SURFACES = {
    "plane": PatternSurface(),
    "sphere_cap": PatternSurface("sphere_cap", 0.012),
    "wide_cap": PatternSurface("sphere_cap", 0.027),
    "cylinder_x": PatternSurface("cylinder", 0.009, "x"),
    "cylinder_y": PatternSurface("cylinder", 0.009, "y"),
}
SVG = "{http://www.w3.org/2000/svg}"


class SvgSheet:
    """What a printer makes of the file: polygons in mm from the top left corner of the paper."""

    def __init__(self, data):
        root = ET.fromstring(data)  # noqa: S314
        self.size = tuple(float(root.attrib[key].removesuffix("mm")) for key in ("width", "height"))
        assert [float(v) for v in root.attrib["viewBox"].split()] == [0, 0, *self.size]
        layers = {group.attrib["id"]: group for group in root.iter(f"{SVG}g")}
        (ink,) = layers["PATTERN"].iter(f"{SVG}path")
        assert ink.attrib["fill-rule"] == "evenodd"
        self.ink = polygons(ink.attrib["d"])
        self.marks = [p for path in layers["MARKS"] for p in polygons(path.attrib["d"])]
        self.outlines = [p for path in layers["OUTLINE"] for p in polygons(path.attrib["d"])]
        self.texts = [
            (str(text.text), np.array([float(text.attrib["x"]), float(text.attrib["y"])]))
            for text in layers["TEXT"]
        ]

    def lines(self):
        return [text for text, _ in self.texts]


def polygons(path):
    parts = [part for part in path.replace("Z", "").split("M") if part]
    return [np.array([[float(v) for v in p.split(",")] for p in part.split("L")]) for part in parts]


class Placed:
    """The pattern on a sheet, by the two arrows that begin at its corner (0, 0)."""

    def __init__(self, sheet, apex):
        begins, counts = np.unique(
            [mark[0] for mark in sheet.marks if len(mark) == 2], axis=0, return_counts=True
        )
        corners = [
            begin
            for begin in begins[counts == 2]
            if all(abs(np.linalg.norm(way) - 6) < 1e-4 for way in ways_from(sheet, begin))
        ]
        (self.corner,) = corners
        self.apex = apex
        places = dict(sheet.texts)
        ways = [way / np.linalg.norm(way) for way in ways_from(sheet, self.corner)]
        self.x_axis, self.y_axis = (
            max(ways, key=lambda way: way @ (places[letter] - self.corner)) for letter in "xy"
        )

    @property
    def handedness(self):
        """Of the axes on the page, with y pointing down."""
        return float(np.linalg.det(np.stack([self.x_axis, self.y_axis])))

    def on_sheet(self, flat_mm):
        return self.apex + flat_mm[:, :1] * self.x_axis + flat_mm[:, 1:] * self.y_axis


def ways_from(sheet, begin):
    """Of the lines from a point."""
    lines = [mark for mark in sheet.marks if len(mark) == 2]
    return [end - start for start, end in lines if np.allclose(start, begin)]


def inked(contours, points):
    """Whether points lie in the ink: the even-odd rule."""
    begin = np.concatenate(contours)
    end = np.concatenate([np.roll(contour, -1, axis=0) for contour in contours])
    inside = np.zeros(len(points), dtype=bool)
    for chunk in np.array_split(np.arange(len(points)), max(1, len(points) * len(begin) // 2**21)):
        x, y = points[chunk, None, 0], points[chunk, None, 1]
        crosses = (begin[:, 1] > y) != (end[:, 1] > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = begin[:, 0] + (y - begin[:, 1]) * (end - begin)[:, 0] / (end - begin)[:, 1]
        inside[chunk] = (crosses & (at > x)).sum(axis=1) % 2 == 1
    return inside


def laid_flat(surface, process, xy):
    """Where material points lie on the flat print, by angles about the surface's centre."""
    if process == "along_axis" or surface.type == "plane":
        return xy
    z = surface.height(xy) + surface.radius
    if surface.type == "cylinder":
        across = 1 if surface.axis == "x" else 0
        flat = xy.copy()
        flat[:, across] = surface.radius * np.arctan2(xy[:, across], z)
        return flat
    angle = np.arctan2(np.hypot(*xy.T), z)
    bearing = np.arctan2(xy[:, 1], xy[:, 0])
    return surface.radius * angle[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)


def material_points(pattern, rng):
    """All over the pattern and its margin, and closely beside its gridlines, m."""
    half = np.array([pattern.cols + 1, pattern.rows + 1]) * pattern.pitch / 2
    points = [rng.uniform(-half - 0.0008, half + 0.0008, (600, 2))]
    for axis, side in itertools.product((0, 1), (-1, 1)):
        beside = rng.uniform(-half + 1e-5, half - 1e-5, (400, 2))
        count = (pattern.cols, pattern.rows)[axis] + 2
        lines = (rng.integers(0, count, 400) - (count - 1) / 2) * pattern.pitch
        beside[:, axis] = lines + side * EDGE_MM * 1e-3
        points.append(beside)
    return np.concatenate(points)


@pytest.fixture(scope="module")
def rig():
    """5 x 8 corners, of which neither a turn nor a mirror image is the same."""
    rig = load_sensor("sample_rig")
    pattern = replace(rig.pattern, rows=5, cols=8, pitch=0.0012)
    return replace(rig, name="fingertip", pattern=pattern)


def with_surface(rig, name, **changes):
    return replace(rig, pattern=replace(rig.pattern, surface=SURFACES[name], **changes))


def drawn(sensor, options=None, **how):
    return print_sheet(sensor.name, printed_pattern(sensor, options), **how)


def svg_of(sheet):
    return SvgSheet(svg_bytes(sheet, "title"))


CMP = PrintOptions()
INVERTED = replace(CMP, invert=True)


@pytest.mark.parametrize(
    ("surface", "process", "options", "mirrored", "colour"),
    [
        ("plane", "along_axis", CMP, False, "dark"),
        ("plane", "along_axis", INVERTED, True, "light"),
        ("sphere_cap", "along_axis", CMP, True, "dark"),
        ("sphere_cap", "along_axis", INVERTED, False, "light"),
        ("sphere_cap", "unrolled", CMP, False, "light"),
        ("sphere_cap", "unrolled", INVERTED, True, "dark"),
        ("cylinder_x", "along_axis", INVERTED, False, "dark"),
        ("cylinder_x", "unrolled", CMP, False, "dark"),
        ("cylinder_y", "along_axis", CMP, True, "light"),
        ("cylinder_y", "unrolled", INVERTED, True, "light"),
    ],
)
def test_what_is_printed_and_mounted_is_what_the_simulator_sees(
    surface, process, options, mirrored, *, colour, rig
):
    """Material points, mounted by the axes, have the grey of the simulated print."""
    sensor = with_surface(rig, surface, corner_checker=colour)
    options = replace(options, process=process)
    made = drawn(sensor, options, mirrored=mirrored, paper="fit")
    sheet = svg_of(made)
    placed = Placed(sheet, made.apex)
    points = material_points(sensor.pattern, np.random.default_rng(0))
    dark = Checkerboard(sensor.pattern).grey(points) == DARK_GREY
    assert 0.05 < dark.mean() < 0.6
    flat = laid_flat(sensor.pattern.surface, process, points) * 1e3
    assert (inked(sheet.ink, placed.on_sheet(flat)) == (dark != options.invert)).all()
    assert placed.handedness == pytest.approx(1 if mirrored else -1, abs=1e-6)
    # Corner (0, 0) is at the bottom left, and at the top left of a mirrored sheet.
    assert placed.corner[0] < placed.apex[0]
    assert (placed.corner[1] < placed.apex[1]) == mirrored


@pytest.mark.parametrize("options", [CMP, INVERTED], ids=["dark ink", "light ink"])
@pytest.mark.parametrize(
    ("colour", "border"), [("dark", "in_view"), ("light", "in_view"), ("light", "beyond_view")]
)
def test_the_dots_of_a_code_are_printed_as_the_simulator_has_them(options, colour, border, rig):
    coded = {"code": "dots", "code_seed": 7, "pitch": 0.001, "border": border}
    # The small cap does not span the whole gel.
    surface = "sphere_cap" if border == "in_view" else "plane"
    sensor = with_surface(rig, surface, corner_checker=colour, **coded)
    pattern = sensor.sheet
    larger = pattern.rows > sensor.pattern.rows and pattern.cols > sensor.pattern.cols
    assert larger == (border == "beyond_view")
    options = replace(options, process="unrolled")
    made = drawn(sensor, options, paper="fit")
    sheet = svg_of(made)
    middles = pattern.checker_middles().reshape(-1, 2)
    around = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2)) * pattern.pitch
    points = np.concatenate([middles, (middles[:, None] + around).reshape(-1, 2)])
    points = far_from_dots(middles, DOT_DIAMETER * pattern.pitch, points)
    dark = Checkerboard(pattern).grey(points) == DARK_GREY
    plain = Checkerboard(replace(pattern, code="none")).grey(points) == DARK_GREY
    np.testing.assert_array_equal((dark != plain)[: len(middles)], pattern.dots().ravel())
    flat = laid_flat(pattern.surface, "unrolled", points) * 1e3
    placed = Placed(sheet, made.apex)
    assert (inked(sheet.ink, placed.on_sheet(flat)) == (dark != options.invert)).all()
    assert "code: dots, seed 7" in sheet.lines()


def far_from_dots(centres, diameter, points):
    """Without what lies nearer than 1 um to the edge of a dot around a centre."""
    distance = np.linalg.norm(points[:, None] - centres[None], axis=-1).min(axis=1)
    return points[np.abs(distance - diameter / 2) > EDGE_MM * 1e-3]


def test_the_mirrored_sheet_is_what_the_cameras_see(rig):
    """Their un-mirrored views show the axes turned as the mirrored sheet has them."""
    made = drawn(rig, mirrored=True)
    mirrored = Placed(svg_of(made), made.apex).handedness
    for view in build_views(rig).values():
        origin, right, down = view.project(rig.pattern.corners()[[0, 0, 1], [0, 1, 0]])
        turn = np.linalg.det(np.stack([right - origin, down - origin]))
        assert np.sign(turn) == pytest.approx(mirrored, abs=1e-6)


def test_scale_bars_and_rulers_have_their_length_to_a_micrometre(rig):
    lengths = [np.ptp(mark, axis=0) for mark in svg_of(drawn(rig)).marks]
    for length in (10.0, 100.0):
        for way in (0, 1):
            bars = [ends for ends in lengths if ends[1 - way] == 0]
            assert sum(abs(ends[way] - length) < 1e-3 for ends in bars) == 1


def test_the_outline_is_the_gels_block(rig):
    surface = PatternSurface("cylinder", 0.02, "y")
    made = drawn(replace(rig, pattern=replace(rig.pattern, surface=surface)))
    sheet = svg_of(made)
    placed = Placed(sheet, made.apex)
    corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * rig.elastomer.size[:2] / 2
    flat = laid_flat(surface, "unrolled", corners) * 1e3
    (outline,) = sheet.outlines
    for corner in placed.on_sheet(flat):
        assert np.linalg.norm(outline - corner, axis=1).min() < ATOL_FILE_MM
    np.testing.assert_allclose(np.ptp(outline, axis=0), np.ptp(flat, axis=0), atol=ATOL_FILE_MM)
    assert np.ptp(flat[:, 0]) == pytest.approx(2 * 20 * np.arcsin(11 / 20), abs=1e-9)


def pdf_page(data):
    """Size in mm and drawing commands of the only page, by the file's own words alone."""
    (box,) = re.findall(rb"/MediaBox \[ ([\d. ]+) \]", data)
    streams = []
    for filters, stream in re.findall(
        rb"/Filter \[(.*?)\].*?stream\r?\n(.*?)~>endstream", data, re.DOTALL
    ):
        assert filters.split() == [b"/ASCII85Decode", b"/FlateDecode"]
        streams.append(zlib.decompress(base64.a85decode(stream)))
    (commands,) = streams
    return np.array([float(v) for v in box.split()])[2:] / POINTS_PER_MM, commands.decode("latin-1")


def filled_in_pdf(commands):
    """Polygons of the first filled path, points."""
    numbers = re.findall(r"(-?[\d.]+) (-?[\d.]+) ([ml])\b", commands[: commands.index("f*")])
    found = []
    for x, y, operator in numbers:
        if operator == "m":
            found.append([])
        found[-1].append([float(x), float(y)])
    return [np.array(polygon) for polygon in found]


@pytest.fixture(scope="module")
def odd_sheet(rig):
    """An inverted, mirrored, stretched film, in every format."""
    pytest.importorskip("ezdxf")
    pytest.importorskip("reportlab")
    options = replace(INVERTED, process="unrolled")
    return drawn(with_surface(rig, "wide_cap"), options, mirrored=True)


def test_the_pdf_holds_the_same_ink_as_the_svg_and_asks_not_to_be_scaled(odd_sheet):
    data = pdf_bytes(odd_sheet, "title")
    assert b"/PrintScaling /None" in data
    page, commands = pdf_page(data)
    svg = svg_of(odd_sheet)
    assert page == pytest.approx(svg.size, abs=ATOL_PAGE_MM)
    ink = [p / POINTS_PER_MM * (1, -1) + (0, svg.size[1]) for p in filled_in_pdf(commands)]
    assert_same_ink(ink, svg.ink)


def test_the_dxf_holds_the_same_ink_as_the_svg_on_its_layers(odd_sheet, tmp_path):
    import ezdxf

    (tmp_path / "sheet.dxf").write_bytes(dxf_bytes(odd_sheet, "title"))
    document = ezdxf.readfile(tmp_path / "sheet.dxf")
    assert (document.dxfversion, document.header["$INSUNITS"]) == ("AC1024", 4)
    assert document.audit().errors == []
    space = document.modelspace()
    kinds = {(entity.dxftype(), entity.dxf.layer) for entity in space}
    assert kinds == {
        ("LWPOLYLINE", "PATTERN"),
        ("HATCH", "PATTERN_FILL"),
        ("LWPOLYLINE", "MARKS"),
        ("LWPOLYLINE", "OUTLINE"),
        ("TEXT", "TEXT"),
    }
    lines = space.query('LWPOLYLINE[layer=="PATTERN"]')
    assert all(line.closed for line in lines)
    svg = svg_of(odd_sheet)
    ink = [np.array([p[:2] for p in line.get_points()]) * (1, -1) for line in lines]
    assert_same_ink([contour + (0, svg.size[1]) for contour in ink], svg.ink)
    (hatch,) = space.query('HATCH[layer=="PATTERN_FILL"]')
    assert len(hatch.paths) == len(svg.ink)
    assert (hatch.dxf.solid_fill, hatch.dxf.hatch_style) == (1, 0)  # odd parity


def assert_same_ink(found, expected):
    assert len(found) == len(expected)
    for contour, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(contour, other, atol=ATOL_FILE_MM)
