"""The report of a demonstration: figures, animation, and a page that needs no other file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import BAND
from cmp_tactile_bringup.report.figures.over_time import contact_figure, wrench_figure
from cmp_tactile_bringup.report.figures.overview import overview_figure, write_animation
from cmp_tactile_bringup.report.results import DemoResults, TableRow, find_jump

# By the names of their files; captions are in the template of the page.
FIGURES = {"wrench": wrench_figure, "contacts": contact_figure}


def report_steps(results: DemoResults) -> int:
    """How often `write_report` will call `on_step`."""
    return len(results.frames) + len(FIGURES) + 1


def write_report(
    results: DemoResults,
    rows: Sequence[TableRow],
    folder: Path,
    on_step: Callable[[], None] = lambda: None,
) -> Path:
    """Write PNG figures, the animation and index.html into the folder; returns the page's path.

    Raises LookupError where no two neighbouring frames came through.
    """
    felt = _felt(results)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [write_animation(results, folder / "grasp.webp", on_step)]
    # The animation in one picture, for where nothing moves.
    style.save_figure(overview_figure(results, felt["frame"]), folder / "overview.png")
    for name, draw in FIGURES.items():
        paths.append(style.save_figure(draw(results), folder / f"{name}.png"))
        on_step()
    pictures = {path.stem: _embedded(path) for path in paths}
    values = {"results": results, "rows": rows, "pictures": pictures, "felt": felt}
    page = style.write_page(folder / "index.html", "demo.html.jinja", **values)
    on_step()
    return page


def _embedded(picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{data}"


def _felt(results: DemoResults) -> dict[str, Any]:
    """What the sensor felt just before and in the largest jump, pressed and dragged at once."""
    jump = find_jump(results)
    before, after = results.frames[jump.before], results.frames[jump.after]
    moved_mm = before.surface.displacement * 1e3
    jump_mm = float(np.nanmax(jump.distance)) * 1e3
    wrench, true = before.force.wrench, results.recording.truth.wrench[before.index]
    band = BAND * before.force.wrench_std[2]
    return {
        "frame": before.index,
        "time_s": results.time_s[jump.before],
        "depth_mm": -np.nanmin(moved_mm[..., 2]),
        "drag_mm": np.nanmax(np.linalg.norm(moved_mm[..., :2], axis=-1)),
        "normal": -wrench[2],
        "normal_band": band if np.isfinite(band) else None,
        "true_normal": -true[2],
        "tangential": np.hypot(*wrench[:2]),
        "true_tangential": np.hypot(*true[:2]),
        "interval_ms": (after.stamp_ns - before.stamp_ns) * 1e-6,
        "jump_mm": jump_mm,
        "jump_checkers": jump_mm * 1e-3 / results.sensor.pattern.pitch,
        "kept": int(np.isfinite(after.surface.position).all(axis=-1).sum()),
        "markers": after.surface.status.size,
    }
