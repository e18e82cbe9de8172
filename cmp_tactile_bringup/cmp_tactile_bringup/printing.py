"""A printed pattern in words and numbers, and as files.

In: sheets of `cmp_tactile_processing.printing`.
Out: what to print, how to mount it, what will be seen; SVG, PDF, DXF, and the description that
agrees.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_processing.cache.files import write_whole
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.printing.pattern import (
    CHORD_TOLERANCE,
    PatternAdvice,
    PrintedPattern,
    PrintOptions,
    advise,
    checker_sides_px,
    code_advice,
)
from cmp_tactile_processing.printing.sheet import (
    LAYERS,
    LINE_WIDTH,
    Label,
    Line,
    PrintedCopy,
    PrintSheet,
)
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

if TYPE_CHECKING:
    from ezdxf.layouts import Modelspace


PROCESSES = {
    "along_axis": "along_axis: pad or transfer printing, or exposure, along the gel's z axis",
    "unrolled": "unrolled: a film, printed flat and laid around the gel",
}


def print_facts(printed: PrintedPattern, copy: PrintedCopy, sheet: PrintSheet) -> dict[str, str]:
    """Size, process, side, marks and places on the sheet."""
    options = printed.options
    size = _size(printed)
    with_margin = size + 2e3 * options.margin
    facts = {
        "Pattern": _kind(printed),
        "Ink": _ink(options),
        "Size": f"{_mm(size)}, {_mm(with_margin)} with its margin",
        "Process": PROCESSES[printed.process],
        "Seen from": "the camera's side (mirrored): the print side goes onto the gel"
        if copy.mirrored
        else "the touching side: the print side looks away from the gel",
        "Targets": f"at x = ±{copy.targets[0]:g} mm, y = ±{copy.targets[1]:g} mm of the flat "
        f"print, apex at (0, 0); the one of corner (0, 0) is filled in one quarter",
        "Sheet": f"{sheet.width:g} x {sheet.height:g} mm, copies: {len(sheet.origins)}",
        "Apex on the sheet": _places(sheet),
    }
    if printed.process == "unrolled":
        facts["Curved edges"] = f"polygons within {CHORD_TOLERANCE * 1e6:g} um"
    if printed.rim_strain:
        facts["Stretch of the film"] = (
            f"{100 * printed.rim_strain:+.2f} % along the rim at the farthest corner of the "
            f"margin, none along lines from the apex: a film does not unroll from a sphere"
        )
    return facts


def seen_facts(sensor: SensorDescription, pattern_type: str = "cmp") -> dict[str, str]:
    """What the camera will see of it, and which checkers would be better."""
    distance = "Checker side" if pattern_type == "cmp" else "Distance of dots"
    try:
        sides = checker_sides_px(sensor)
    except DescriptionError as error:
        return {distance: _not_known(sensor, error)}
    facts = {f"{distance} {view}": _sides(values) for view, values in sides.items()}
    facts["Advised"] = _advised(sensor)
    if sensor.pattern.code != "none" and pattern_type == "cmp":
        facts["Code"] = code_advice(sensor)
    return facts


def advice_of(sensor: SensorDescription) -> PatternAdvice:
    """As advise has it; DescriptionError where a view does not show the whole print."""
    for view, sides in checker_sides_px(sensor).items():
        if not np.isfinite(sides).all():
            raise DescriptionError(
                f"{sensor.origin}: views.{view}: some corners of the pattern are beyond what "
                f"the lens shows, so a print of this size gets no advice"
            )
    return advise(sensor)


def _not_known(sensor: SensorDescription, error: DescriptionError) -> str:
    """Without the file, which stands above."""
    return f"not known: {str(error).removeprefix(f'{sensor.origin}: ')}"


def _advised(sensor: SensorDescription) -> str:
    try:
        advice = advice_of(sensor)
    except DescriptionError as error:
        return _not_known(sensor, error)
    return (
        f"{advice.rows} x {advice.cols} corners, pitch {advice.pitch * 1e3:.6g} mm, "
        f"{advice.points_per_segment} virtual markers between: {advice.reason}"
    )


def pattern_warnings(sensor: SensorDescription, printed: PrintedPattern) -> list[str]:
    """What should be known before it is printed."""
    warnings = []
    if not printed.fits_gel:
        found = _mm(_size(printed) + 2e3 * printed.options.margin)
        block = _mm(np.array(sensor.elastomer.size[:2]) * 1e3)
        warnings.append(f"pattern with its margin is {found}, more than the gel's block of {block}")
    if printed.gel is None:
        warnings.append(
            "the gel's block reaches beyond its surface (pattern.surface.radius): it has no "
            "outline on the flat print"
        )
    if printed.options.pattern_type == "dmp":
        warnings.append("dots are for comparisons: the nodes of cmp_tactile track checkers only")
    return warnings


def _kind(printed: PrintedPattern) -> str:
    pattern, options = printed.pattern, printed.options
    pitch = f"pitch {pattern.pitch * 1e3:.6g} mm"
    if options.pattern_type == "dmp":
        width = options.dot_diameter * pattern.pitch * 1e3
        return f"{pattern.rows} x {pattern.cols} dots of {width:.6g} mm, {pitch}"
    outside = f"{pattern.corner_checker} checker outside corner (0, 0)"
    code = f", code: {pattern.code}, seed {pattern.code_seed}" if pattern.code != "none" else ""
    return f"{pattern.rows} x {pattern.cols} corners, {pitch}, {outside}{code}"


def _ink(options: PrintOptions) -> str:
    part = "the dark checkers" if options.pattern_type == "cmp" else "the dots"
    if options.invert:
        part = f"all but {part}, margin and bleed included (inverted)"
    gain = f"; {options.ink_gain * 1e6:g} um taken off each edge" if options.ink_gain else ""
    return f"{part}{gain}"


def _size(printed: PrintedPattern) -> NDArray[np.float64]:
    """Of the checkers on the gel, x and y, mm."""
    pattern = printed.pattern
    return np.array([pattern.cols + 1, pattern.rows + 1]) * pattern.pitch * 1e3


def _sides(values: NDArray[np.float64]) -> str:
    seen = values[np.isfinite(values)]
    if not len(seen):
        return "not seen"
    hidden = "" if len(seen) == len(values) else "; some corners are beyond what the lens shows"
    return f"{seen.min():.1f} px at least, {seen.mean():.1f} px on average{hidden}"


def _places(sheet: PrintSheet) -> str:
    x, y = sheet.origins[0]
    first = f"({x:.3f}, {y:.3f}) mm from the top left corner"
    if len(sheet.origins) == 1:
        return first
    across = sorted({x for x, _ in sheet.origins})
    down = sorted({y for _, y in sheet.origins})
    steps = [
        f"{axis[1] - axis[0]:.3f} mm {way}"
        for axis, way in ((across, "to the right"), (down, "down"))
        if len(axis) > 1
    ]
    return f"{first} for the first copy; {', '.join(steps)} to the next"


def _mm(size: NDArray[np.float64]) -> str:
    return f"{size[0]:.6g} x {size[1]:.6g} mm"


# Of a coordinate in mm: 10 nm in SVG, 1 nm in DXF.
SVG_DECIMALS, DXF_DECIMALS = 5, 6
LINE_LAYERS = ("REGISTRATION", "OUTLINE", "CUT")
POINTS_PER_MM = 72 / 25.4
FONT = "Helvetica"
EVEN_ODD = 0
# Apart, so that a machine that follows outlines can leave it out.
FILL_LAYER = "PATTERN_FILL"
# Height of capitals, of the font's size.
CAPITALS = 0.72


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
    ink = [contour for copy in sheet.drawing.ink for contour in copy]
    yield from _layer("PATTERN", [_filled(ink)])
    for layer in LINE_LAYERS:
        lines = [line for line in sheet.drawing.lines if line.layer == layer]
        solids = sheet.drawing.solids if layer == "REGISTRATION" else ()
        paths = [_stroked(lines)] if lines else []
        yield from _layer(layer, [*paths, *([_filled(solids)] if solids else [])])
    yield from _layer("TEXT", [_text(label) for label in sheet.drawing.labels])
    yield "</svg>"


def _layer(name: str, elements: Iterable[str]) -> Iterator[str]:
    yield f'<g id="{name}" inkscape:groupmode="layer" inkscape:label="{name}">'
    yield from elements
    yield "</g>"


def _filled(contours: Iterable[NDArray[np.float64]]) -> str:
    path = "".join(_path(contour, closed=True) for contour in contours)
    return f'<path fill="#000" fill-rule="evenodd" stroke="none" d="{path}"/>'


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
    drawing = sheet.drawing
    _fill(canvas, sheet, [contour for copy in drawing.ink for contour in copy])
    _fill(canvas, sheet, list(drawing.solids))
    canvas.setLineWidth(LINE_WIDTH * POINTS_PER_MM)
    path = canvas.beginPath()
    for line in drawing.lines:
        _trace(path, _on_page(sheet, line.points), closed=line.closed)
    canvas.drawPath(path, stroke=1, fill=0)
    for label in drawing.labels:
        _write(canvas, sheet, label)
    canvas.save()
    return file.getvalue()


def _fill(canvas: Any, sheet: PrintSheet, contours: list[NDArray[np.float64]]) -> None:
    path = canvas.beginPath()
    for contour in contours:
        _trace(path, _on_page(sheet, contour), closed=True)
    canvas.drawPath(path, stroke=0, fill=1, fillMode=EVEN_ODD)


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

    Each polygon of the ink is a closed LWPOLYLINE on PATTERN; each copy's ink is a solid HATCH,
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
    for copy in sheet.drawing.ink:
        _add_ink(space, sheet, copy)
    for solid in sheet.drawing.solids:
        points = _on_sheet(sheet, solid)
        attributes = {"layer": "REGISTRATION"}
        space.add_hatch(dxfattribs=attributes).paths.add_polyline_path(points, is_closed=True)
    for line in sheet.drawing.lines:
        points = _on_sheet(sheet, line.points)
        space.add_lwpolyline(points, close=line.closed, dxfattribs={"layer": line.layer})
    for label in sheet.drawing.labels:
        _add_text(space, sheet, label)
    stream = StringIO()
    document.write(stream)
    return stream.getvalue().encode()


def _add_ink(space: Modelspace, sheet: PrintSheet, copy: tuple[NDArray[np.float64], ...]) -> None:
    hatch = space.add_hatch(dxfattribs={"layer": FILL_LAYER})
    for contour, flags in zip(copy, _path_flags(copy), strict=True):
        points = _on_sheet(sheet, contour)
        space.add_lwpolyline(points, close=True, dxfattribs={"layer": "PATTERN"})
        hatch.paths.add_polyline_path(points, is_closed=True, flags=flags)


def _path_flags(copy: tuple[NDArray[np.float64], ...]) -> list[int]:
    """Outer, hole in it, and what lies in the hole; holes run the other way round than ink."""
    from ezdxf.lldxf import const

    turns = [float(np.sign(_signed_area(contour))) for contour in copy]
    holes = [turn != turns[0] for turn in turns]
    if not any(holes):
        return [const.BOUNDARY_PATH_EXTERNAL] * len(copy)
    inner = [
        const.BOUNDARY_PATH_OUTERMOST if hole else const.BOUNDARY_PATH_DEFAULT for hole in holes
    ]
    return [const.BOUNDARY_PATH_EXTERNAL, *inner[1:]]


def _signed_area(contour: NDArray[np.float64]) -> float:
    x, y = contour.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2


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


WRITERS: dict[str, Callable[[PrintSheet, str], bytes]] = {
    "svg": svg_bytes,
    "pdf": pdf_bytes,
    "dxf": dxf_bytes,
}
FORMATS = tuple(WRITERS)
LIBRARIES = {"pdf": "reportlab", "dxf": "ezdxf"}


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
        output = output.expanduser()
        if output.is_dir():
            msg = f"{output}: is a folder, expected a name, as {output / 'my_pattern'}"
            raise OutputError(msg)
        if output.suffix in {".yaml", *(f".{name}" for name in FORMATS)}:
            output = output.with_suffix("")
        files = {name: output.with_name(f"{output.name}.{name}") for name in (*formats, "yaml")}
        sensor = files.pop("yaml")
        return cls(files, sensor)

    def check_free(self, source: Path, *, overwrite: bool) -> None:
        """Raise OutputError where a file is there already, or is the description that is read."""
        for path in (*self.sheets.values(), self.sensor):
            if path.resolve() == source.resolve():
                msg = f"{path}: is read, so it is not replaced; --output gives another name"
                raise OutputError(msg)
            if path.is_dir():
                msg = f"{path}: is a folder, so it is not replaced; --output gives another name"
                raise OutputError(msg)
            if path.exists() and not overwrite:
                msg = f"{path}: exists already; --overwrite replaces it"
                raise OutputError(msg)

    def write(self, sheet: PrintSheet, sensor: SensorDescription) -> tuple[list[Path], list[str]]:
        """Write everything; returns the files and, for each that is missing, a line why.

        The description is written last, and only beside a sheet.
        """
        without = {name: LIBRARIES[name] for name in self.sheets if not _is_there(name)}
        contents = {
            path: WRITERS[name](sheet, sensor.name)
            for name, path in self.sheets.items()
            if name not in without
        }
        missing = [
            f"{self.sheets[name]}: not written: the library {library} is not installed "
            f"(python3 -m pip install {library})"
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
