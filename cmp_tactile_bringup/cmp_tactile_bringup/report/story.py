"""What was felt, in words made from the measured values."""

from __future__ import annotations

import numpy as np

from cmp_tactile_bringup.report.results import DemoResults, find_jump

__all__ = ["FORCE_CAVEAT", "felt", "most_telling_frame"]

FORCE_CAVEAT = (
    "The truth of this recording ends at the positions. Its deformations are smooth fields chosen "
    "by hand, not solutions of elasticity, so there is no true force to compare with: the force "
    "figures show what the elastic model of the gel makes of the measured displacement."
)


def most_telling_frame(results: DemoResults) -> int:
    """Number of the frame just before the largest jump: pressed and dragged at once."""
    return results.frames[find_jump(results).before].index


def felt(results: DemoResults) -> list[str]:
    """Sentences that tell the recording as the sensor felt it."""
    jump = find_jump(results)
    before, after = results.frames[jump.before], results.frames[jump.after]
    moved_mm = before.surface.displacement * 1e3
    depth_mm = -float(np.nanmin(moved_mm[..., 2]))
    drag_mm = float(np.nanmax(np.linalg.norm(moved_mm[..., :2], axis=-1)))
    jump_mm = float(np.nanmax(jump.distance)) * 1e3
    kept = int(np.isfinite(after.surface.position).all(axis=-1).sum())
    normal, sideways = -before.force.wrench[2], np.hypot(*before.force.wrench[:2])
    interval_ms = (after.stamp_ns - before.stamp_ns) * 1e-6
    return [
        (
            f"By frame {before.index}, {results.time_s[jump.before]:.2f} s into the recording, "
            f"an object had pressed the gel in by {depth_mm:.2f} mm and dragged it sideways by "
            f"up to {drag_mm:.2f} mm: {normal:.2f} N into the gel and {sideways:.2f} N along it, "
            "by the elastic model."
        ),
        (
            f"Then a knock: within one frame ({interval_ms:.0f} ms) the markers jumped by up to "
            f"{jump_mm:.2f} mm, {jump_mm * 1e-3 / results.sensor.pattern.pitch:.1f} checkers. "
            f"{kept} of {after.surface.status.size} markers kept their numbers and were measured "
            "in the very next frame."
        ),
    ]
