"""The page of a recorded grasp: its video, and what both fingers felt in each phase."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cmp_tactile_bringup.report import style
from cmp_tactile_simulation.grasp.record import TABLE_FILE, VIDEO_FILE
from cmp_tactile_simulation.grasp.scene import SIDES, GraspScene

HEADINGS = (
    *("phase", "from, s", "finger", "grip, N", "load, N", "torque, N mm", "slip"),
    *("error of the force, mN", "usable frames"),
)


def write_grasp_page(folder: Path, scene: GraspScene, summary: str) -> Path:
    """Write index.html beside the table and the video of a grasp; returns its path.

    summary: what was measured, in one line.
    """
    table = pd.read_csv(folder / TABLE_FILE)
    rows = [
        _row(str(phase), side, group[group.side == side])
        for phase, group in table.groupby("phase", sort=False)
        for side in SIDES
    ]
    return style.write_page(
        folder / "index.html",
        "grasp.html.jinja",
        title=scene.title or scene.name,
        video=VIDEO_FILE,
        summary=summary,
        headings=HEADINGS,
        rows=rows,
        files=sorted(item.name for item in folder.iterdir()),
    )


def _row(phase: str, side: str, frames: Any) -> tuple[str, ...]:
    """The true forces of a phase at their largest, and the error of those that were measured."""
    used = frames[frames.usable == 1]
    errors = np.hypot(
        np.hypot(used.fx - used.fx_true, used.fy - used.fy_true), used.fz - used.fz_true
    )
    slips = [item for item in frames.slip.unique() if item != "no_contact"]
    return (
        phase,
        f"{frames.time_s.min():.1f}",
        side,
        f"{-frames.fz_true.min():.2f}",
        f"{np.hypot(frames.fx_true, frames.fy_true).max():.2f}",
        f"{1e3 * frames.mz_true.abs().max():.1f}",
        ", ".join(slips) or "no contact",
        f"{1e3 * np.sqrt((errors**2).mean()):.1f}" if len(used) else "",
        f"{len(used)} of {len(frames)}",
    )
