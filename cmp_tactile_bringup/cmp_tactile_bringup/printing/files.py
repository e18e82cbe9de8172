"""The files of a printed pattern: a sheet as SVG, PDF and DXF, and the description that agrees."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape, quoteattr

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import check_free, expanded_path, write_whole
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.printing.sheet import LAYERS, LINE_WIDTH, Label, Line, PrintSheet
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

if TYPE_CHECKING:
    from ezdxf.layouts import Modelspace

# Of a coordinate in mm.
SVG_DECIMALS, DXF_DECIMALS = 5, 6
LINE_LAYERS = ("OUTLINE", "MARKS")
POINTS_PER_MM = 72 / 25.4
FONT = "Helvetica"
EVEN_ODD = 0
# Apart, so that a machine that follows outlines can leave it out.
FILL_LAYER = "PATTERN_FILL"
# Height of capitals, of the font's size.
CAPITALS = 0.72
FORMATS = ("svg", "pdf", "dxf")
LIBRARIES = {"pdf": "reportlab", "dxf": "ezdxf"}


def svg_bytes(sheet: PrintSheet, title: str) -> bytes:
    """The file; layers as groups that Inkscape shows as such.

    All ink is one compound path: neighbours in one path leave no seam between them.
    """
    return "".join(f"{line}\n" for line in _lines(sheet, title)).encode()


def _lines(sheet: PrintSheet, title: str) -> Iterator[str]:
    width, height = _number(sheet.width), _number(sheet.height)
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield (
        '<svg xmlns="http://www.w3.org/2000/svg" '
        'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" '
        f'width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}">'
    )
    yield f"<title>{escape(title)}</title>"
    path = "".join(_path(contour, closed=True) for contour in sheet.ink)
    filled = f'<path fill="#000" fill-rule="evenodd" stroke="none" d="{path}"/>'
    yield from _layer("PATTERN", [filled])
    for layer in LINE_LAYERS:
        lines = [line for line in sheet.lines if line.layer == layer]
        yield from _layer(layer, [_stroked(lines)] if lines else [])
    yield from _layer("TEXT", [_text(label) for label in sheet.labels])
    yield "</svg>"


def _layer(name: str, elements: Iterable[str]) -> Iterator[str]:
    yield f'<g id="{name}" inkscape:groupmode="layer" inkscape:label="{name}">'
    yield from elements
    yield "</g>"


def _stroked(lines: Iterable[Line]) -> str:
    path = "".join(_path(line.points, closed=line.closed) for line in lines)
    return f'<path fill="none" stroke="#000" stroke-width="{LINE_WIDTH}" d="{path}"/>'


def _path(points: NDArray[np.float64], *, closed: bool) -> str:
    corners = "L".join(f"{_number(x)},{_number(y)}" for x, y in points)
    return f"M{corners}{'Z' if closed else ''}"


def _text(label: Label) -> str:
    x, y = (_number(value) for value in label.place)
    return (
        f'<text x="{x}" y="{y}" font-family="sans-serif" font-size="{label.size:g}" '
        f"text-anchor={quoteattr(label.anchor)}>{escape(label.text)}</text>"
    )


def _number(value: float) -> str:
    text = f"{value:.{SVG_DECIMALS}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def pdf_bytes(sheet: PrintSheet, title: str) -> bytes:
    """The file; it asks viewers to print it unscaled.  Raises ImportError without reportlab."""
    from reportlab.pdfgen.canvas import Canvas

    file = BytesIO()
    size = sheet.width * POINTS_PER_MM, sheet.height * POINTS_PER_MM
    canvas = Canvas(file, pagesize=size, invariant=1)
    canvas.setTitle(title)
    canvas.setCreator("cmp_tactile")
    canvas.setViewerPreference("PrintScaling", "None")
    path = canvas.beginPath()
    for contour in sheet.ink:
        _trace(path, _on_page(sheet, contour), closed=True)
    canvas.drawPath(path, stroke=0, fill=1, fillMode=EVEN_ODD)
    canvas.setLineWidth(LINE_WIDTH * POINTS_PER_MM)
    path = canvas.beginPath()
    for line in sheet.lines:
        _trace(path, _on_page(sheet, line.points), closed=line.closed)
    canvas.drawPath(path, stroke=1, fill=0)
    for label in sheet.labels:
        _write(canvas, sheet, label)
    canvas.save()
    return file.getvalue()


def _trace(path: Any, points: NDArray[np.float64], *, closed: bool) -> None:
    path.moveTo(*points[0].tolist())
    for point in points[1:].tolist():
        path.lineTo(*point)
    if closed:
        path.close()


def _write(canvas: Any, sheet: PrintSheet, label: Label) -> None:
    canvas.setFont(FONT, label.size * POINTS_PER_MM)
    ((x, y),) = _on_page(sheet, np.array([label.place])).tolist()
    draw = {
        "start": canvas.drawString,
        "middle": canvas.drawCentredString,
        "end": canvas.drawRightString,
    }[label.anchor]
    # The fonts that every reader brings know no other characters.
    draw(x, y, label.text.encode("latin-1", "replace").decode("latin-1"))


def _on_page(sheet: PrintSheet, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """In points from the bottom left."""
    return np.asarray(((0.0, sheet.height) + points * (1.0, -1.0)) * POINTS_PER_MM)


def dxf_bytes(sheet: PrintSheet, title: str) -> bytes:
    """The file: x to the right, y up, origin at the sheet's bottom left.

    Each polygon of the ink is a closed LWPOLYLINE on PATTERN; the ink is a solid HATCH,
    too.  Raises ImportError without ezdxf.
    """
    with _fixed_metadata():
        return _document_bytes(sheet, title)


@contextmanager
def _fixed_metadata() -> Iterator[None]:
    """Or the time and random numbers would be written."""
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _document_bytes(sheet: PrintSheet, title: str) -> bytes:
    import ezdxf
    from ezdxf import units

    document = ezdxf.new("R2010", units=units.MM)
    for layer in (*LAYERS, FILL_LAYER):
        document.layers.add(layer)
    document.header.custom_vars.append("Title", title)
    space = document.modelspace()
    _add_ink(space, sheet)
    for line in sheet.lines:
        points = _on_sheet(sheet, line.points)
        space.add_lwpolyline(points, close=line.closed, dxfattribs={"layer": line.layer})
    for label in sheet.labels:
        _add_text(space, sheet, label)
    stream = StringIO()
    document.write(stream)
    return stream.getvalue().encode()


def _add_ink(space: Modelspace, sheet: PrintSheet) -> None:
    hatch = space.add_hatch(dxfattribs={"layer": FILL_LAYER})
    for contour, flags in zip(sheet.ink, _path_flags(sheet.ink), strict=True):
        points = _on_sheet(sheet, contour)
        space.add_lwpolyline(points, close=True, dxfattribs={"layer": "PATTERN"})
        hatch.paths.add_polyline_path(points, is_closed=True, flags=flags)


def _path_flags(ink: tuple[NDArray[np.float64], ...]) -> list[int]:
    """Outer, hole in it, and what lies in the hole; holes run the other way round than ink."""
    from ezdxf.lldxf import const

    turns = [np.sign(cv2.contourArea(contour.astype(np.float32), oriented=True)) for contour in ink]
    holes = [turn != turns[0] for turn in turns]
    if not any(holes):
        return [const.BOUNDARY_PATH_EXTERNAL] * len(ink)
    inner = [
        const.BOUNDARY_PATH_OUTERMOST if hole else const.BOUNDARY_PATH_DEFAULT for hole in holes
    ]
    return [const.BOUNDARY_PATH_EXTERNAL, *inner[1:]]


def _add_text(space: Modelspace, sheet: PrintSheet, label: Label) -> None:
    from ezdxf.enums import TextEntityAlignment

    alignment = {
        "start": TextEntityAlignment.LEFT,
        "middle": TextEntityAlignment.CENTER,
        "end": TextEntityAlignment.RIGHT,
    }[label.anchor]
    # Two percent signs begin a control code.
    text = label.text.replace("%%", "% %")
    height = label.size * CAPITALS
    entity = space.add_text(text, height=height, dxfattribs={"layer": "TEXT"})
    entity.set_placement(_on_sheet(sheet, np.array([label.place]))[0], align=alignment)


def _on_sheet(sheet: PrintSheet, points: NDArray[np.float64]) -> list[tuple[float, float]]:
    placed = np.round((0.0, sheet.height) + points * (1.0, -1.0), DXF_DECIMALS)
    return [(float(x), float(y)) for x, y in placed]


@dataclass(frozen=True)
class PatternFiles:
    """NAME.svg, NAME.pdf, NAME.dxf, as far as they are asked for, and NAME.yaml."""

    sheets: dict[str, Path]
    sensor: Path

    @classmethod
    def from_output(cls, output: Path, formats: Sequence[str]) -> PatternFiles:
        """Files of that name; an ending that is one of theirs is left out of it.

        Raises OutputError for a folder: a name in it is needed.
        """
        output = expanded_path(output)
        if output.is_dir():
            msg = f"{output}: found a folder, expected a name, as {output / 'my_pattern'}"
            raise OutputError(msg)
        if output.suffix in {".yaml", *(f".{name}" for name in FORMATS)}:
            output = output.with_suffix("")
        files = {name: output.with_name(f"{output.name}.{name}") for name in (*formats, "yaml")}
        sensor = files.pop("yaml")
        return cls(files, sensor)

    def check_free(self, source: Path, *, overwrite: bool) -> None:
        """Raise OutputError where a file is there already, or is the description that is read."""
        paths = (*self.sheets.values(), self.sensor)
        for path in paths:
            if path.resolve() == source.resolve():
                msg = (
                    f"{path}: is the input, so it is not replaced; give another name with --output"
                )
                raise OutputError(msg)
            if path.is_dir():
                msg = f"{path}: is a folder, so it is not replaced; give another name with --output"
                raise OutputError(msg)
        check_free(paths, overwrite=overwrite)

    def write(self, sheet: PrintSheet, sensor: SensorDescription) -> tuple[list[Path], list[str]]:
        """Write everything; returns the files and, for each that is missing, a line why.

        The description is written last, and only beside a sheet.
        """
        without = {name: LIBRARIES[name] for name in self.sheets if not _is_there(name)}
        writers = {"svg": svg_bytes, "pdf": pdf_bytes, "dxf": dxf_bytes}
        contents = {
            path: writers[name](sheet, sensor.name)
            for name, path in self.sheets.items()
            if name not in without
        }
        missing = [
            f"{self.sheets[name]}: not written: found no library {library}; install it: python3 "
            f"-m pip install {library}"
            for name, library in without.items()
        ]
        if not contents:
            return [], missing
        self.sensor.parent.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            write_whole(path, content)
        write_sensor_description(self.sensor, sensor)
        return [*contents, self.sensor], missing


def _is_there(name: str) -> bool:
    """Whether the library that a format needs can be imported."""
    return name not in LIBRARIES or importlib.util.find_spec(LIBRARIES[name]) is not None
