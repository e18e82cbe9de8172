"""A sheet as PDF, by reportlab."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.printing.sheet import LINE_WIDTH, Label, PrintSheet

POINTS_PER_MM = 72 / 25.4
FONT = "Helvetica"
EVEN_ODD = 0


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
