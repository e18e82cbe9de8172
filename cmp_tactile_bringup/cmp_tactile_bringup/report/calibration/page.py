"""The report of a calibration: figures and one page with everything that was found out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.calibration.estimates import HEADINGS, estimate_rows
from cmp_tactile_bringup.report.calibration.figures import (
    gel_map_figure,
    histogram_figure,
    residual_figure,
)
from cmp_tactile_bringup.report.page import CSS
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome, Estimate, Finding

__all__ = ["Concluded", "PageFigure", "write_calibration_report", "write_page"]

PAGE = "index.html"

PageFigure = tuple[str, str, Callable[[], Figure]]
"""File name, caption, and what draws it."""


class Concluded(Protocol):
    """What every calibration tells in the end."""

    @property
    def method(self) -> str:
        """What it was made with."""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Its parameters."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong."""

    @property
    def verdict(self) -> str:
        """One or two sentences."""

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against using it."""


def write_calibration_report(
    outcome: CalibrationOutcome, pictures: Mapping[str, NDArray[np.uint8]], folder: Path, name: str
) -> Path:
    """Write the figures and index.html into the folder; returns the page's path.

    pictures: an image of each view, which the residuals are drawn over.  name: of the sensor.
    """
    return write_page(outcome, _figures(outcome, pictures), folder, (name, "images tell"))


def write_page(
    outcome: Concluded,
    figures: Sequence[PageFigure],
    folder: Path,
    names: tuple[str, str],
    more: str = "",
) -> Path:
    """Write figures and index.html into the folder; returns the page's path.

    names: of the sensor, and who tells its parameters, as "images tell".  more: HTML between the
    figures and the table of parameters.
    """
    name, told_by = names
    folder.mkdir(parents=True, exist_ok=True)
    parts = [_head(outcome, name), _findings(outcome.findings)]
    for file, caption, draw in figures:
        style.save_figure(draw(), folder / file)
        parts.append(
            f'<figure><img src="{file}" alt="{escape(caption)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    parts += [more, "<h2>Parameters</h2>", _table(outcome, told_by), "</body></html>"]
    path = folder / PAGE
    path.write_text("\n".join(part for part in parts if part), encoding="utf-8")
    return path


def _figures(
    outcome: CalibrationOutcome, pictures: Mapping[str, NDArray[np.uint8]]
) -> list[PageFigure]:
    if not any(len(item.pixels) for item in outcome.residuals):
        return []
    figures: list[PageFigure] = [
        (
            "residuals.png",
            (
                "Measured minus modelled place of every point. Arrows that point in all directions "
                "are noise; arrows that agree with their neighbours are what the model does not "
                "know."
            ),
            lambda: residual_figure(outcome.residuals, pictures),
        ),
        (
            "histogram.png",
            "How large the residuals are.",
            lambda: histogram_figure(outcome.residuals),
        ),
    ]
    sensor = outcome.sensor
    if outcome.method == "gel" and sensor is not None:
        figures.append(
            (
                "gel.png",
                (
                    "The same by marker. A single dark marker is a defect of the print or dirt; "
                    "many beside one another are a gel that is touched, or another one than "
                    "described."
                ),
                lambda: gel_map_figure(outcome.residuals, sensor),
            )
        )
    return figures


def _head(outcome: Concluded, name: str) -> str:
    kind, word = ("good", "Accepted") if outcome.accepted else ("bad", "Refused")
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Calibration of {escape(name)}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}</style></head>
<body><h1>Calibration of {escape(name)}: {escape(outcome.method)}</h1>
<p class="verdict {kind}">{word}</p>
<p class="lead">{escape(outcome.verdict)}</p>"""


def _findings(findings: Sequence[Finding]) -> str:
    lines = [
        f"<li><strong>{item.severity.value}:</strong> {escape(item.text)} "
        f"<em>{escape(item.advice)}</em></li>"
        for item in findings
    ]
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def _table(outcome: Concluded, told_by: str) -> str:
    head = "".join(f"<th>{text}</th>" for text in HEADINGS)
    lines = [
        "<tr>" + "".join(f'<td class="number">{escape(text)}</td>' for text in row.texts) + "</tr>"
        for row in estimate_rows(outcome.estimates)
    ]
    return (
        f"<table><tr>{head}</tr>{''.join(lines)}</table>"
        f"<p>Determined: the {told_by} it, with this standard deviation. Partly: they tell it "
        "only together with others. Held: they do not, and it kept what was known before.</p>"
    )
