"""Writes the whole report: figures, animation and page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import TableRow
from cmp_tactile_bringup.report.figures.animation import overview_figure, write_animation
from cmp_tactile_bringup.report.figures.contact import contact_figure
from cmp_tactile_bringup.report.figures.displacement import displacement_figure
from cmp_tactile_bringup.report.figures.force import force_figure
from cmp_tactile_bringup.report.figures.frame import frame_figure
from cmp_tactile_bringup.report.figures.knock import knock_figure
from cmp_tactile_bringup.report.figures.shape import shape_figure
from cmp_tactile_bringup.report.figures.wrench import wrench_figure
from cmp_tactile_bringup.report.page import Picture, write_page
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_bringup.report.story import most_telling_frame

__all__ = ["report_steps", "write_report"]

FIGURES = 7
# The animation in one picture, for where nothing moves.
OVERVIEW = "overview.png"


def report_steps(results: DemoResults) -> int:
    """How often `write_report` will call `on_step`."""
    return FIGURES + len(results.frames) + 1


def write_report(
    results: DemoResults,
    rows: Sequence[TableRow],
    folder: Path,
    on_step: Callable[[], None] = lambda: None,
) -> Path:
    """Write PNG figures, the animation and index.html into the folder; returns the page's path.

    Raises LookupError where no two neighbouring frames came through.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = [_animation(results, folder, on_step)]
    style.save_figure(overview_figure(results, most_telling_frame(results)), folder / OVERVIEW)
    for name, heading, caption, draw in _figures(results):
        path = style.save_figure(draw(), folder / f"{name}.png")
        pictures.append(Picture(heading, path, caption, shows_force=name == "force"))
        on_step()
    page = write_page(results, rows, pictures, folder / "index.html")
    on_step()
    return page


def _animation(results: DemoResults, folder: Path, on_step: Callable[[], None]) -> Picture:
    path = write_animation(results, folder / "grasp.webp", on_step)
    return Picture(
        "The recording, slowed down",
        path,
        "Left: the left view with the gridlines found. Middle: displacement, mm; the darker, the "
        "deeper pressed in. Right: force on the gel, over mm; colour is pressure, arrows are "
        "tangential force.",
    )


def _figures(results: DemoResults) -> list[tuple[str, str, str, Callable[[], Figure]]]:
    index = most_telling_frame(results)
    return [
        (
            "frame",
            "Gridlines in the camera frame",
            (
                "Blue: gridlines along x, orange: along y. Measured markers are the crossings; "
                "virtual markers lie on the gridlines between them, at sub-pixel precision."
            ),
            lambda: frame_figure(results, index),
        ),
        (
            "displacement",
            "Displacement field",
            "The dent and the drag, marker by marker, just before the knock.",
            lambda: displacement_figure(results, index),
        ),
        (
            "shape",
            "Shape of the contact",
            (
                "The surface between the markers, from corners and virtual markers: left from "
                "above, right in section along the dashed line."
            ),
            lambda: shape_figure(results, index),
        ),
        (
            "knock",
            "The moment of the knock",
            (
                "Circles in the second frame: where the markers were in the first. Tracking by "
                "nearest neighbour would confuse markers that move by more than half a checker; "
                "numbers read off the grid do not depend on how far it moved."
            ),
            lambda: knock_figure(results),
        ),
        (
            "force",
            "Force field",
            (
                "Force of the object on the gel in the same frame: above, from the displacement of "
                "the markers by an elastic model of the gel; below, as it truly is. One scale for "
                "both, drawn where the gel has moved to; dotted: the true edge of the contact. The "
                "measured pressure is smoothed, which lowers its peak: the picture names by how "
                "much the two peaks differ. The resultant is not smoothed."
            ),
            lambda: force_figure(results, index),
        ),
        (
            "wrench",
            "Force over time",
            (
                "Sums over the gel: depth and drag, force, and moment about the gel frame's "
                "origin, in the gel frame; broad lines are the truth. Fz below zero: pressed. "
                "Below force and moment, measured less true: the bands are the error bars that the "
                "sensor itself gives, two standard deviations to either side."
            ),
            lambda: wrench_figure(results),
        ),
        (
            "contacts",
            "Contacts, slip and friction over time",
            (
                "How many separate contacts there are and how large, whether they slip, how much "
                "of the friction they use, and what the sensor warned of; broad lines are the "
                "truth. Both bars of slip go by one rule: a contact of which little slides, at "
                "its rim, sticks."
            ),
            lambda: contact_figure(results),
        ),
    ]
