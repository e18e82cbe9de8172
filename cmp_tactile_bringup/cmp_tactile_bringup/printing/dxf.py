"""A sheet as DXF, by ezdxf."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.printing.sheet import LAYERS, Label, PrintSheet

if TYPE_CHECKING:
    from ezdxf.layouts import Modelspace

# Of a coordinate in mm: 1 nm.
DECIMALS = 6
# Apart, so that a machine that follows outlines can leave it out.
FILL_LAYER = "PATTERN_FILL"
# Height of capitals, of the font's size.
CAPITALS = 0.72


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

    turns = [
        np.sign(cv2.contourArea(contour.astype(np.float32), oriented=True)) for contour in copy
    ]
    holes = [turn != turns[0] for turn in turns]
    if not any(holes):
        return [const.BOUNDARY_PATH_EXTERNAL] * len(copy)
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
    placed = np.round((0.0, sheet.height) + points * (1.0, -1.0), DECIMALS)
    return [(float(x), float(y)) for x, y in placed]
