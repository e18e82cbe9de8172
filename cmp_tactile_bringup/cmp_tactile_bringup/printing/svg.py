"""A sheet as SVG."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.printing.sheet import LINE_WIDTH, Label, Line, PrintSheet

# Of a coordinate in mm: 10 nm.
DECIMALS = 5
LINE_LAYERS = ("REGISTRATION", "OUTLINE", "CUT")


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
    text = f"{value:.{DECIMALS}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
