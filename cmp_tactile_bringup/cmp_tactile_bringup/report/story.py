"""What was felt, in words made from the measured values."""

from __future__ import annotations

import numpy as np

from cmp_tactile_bringup.report.force_evaluation import BAND
from cmp_tactile_bringup.report.results import DemoResults, find_jump
from cmp_tactile_processing.measured.force_field import ForceField

__all__ = ["felt", "force_caveat", "most_telling_frame"]

MATERIAL = {
    "linear": "Both gels are linear, so that what a real one does beyond that (large strains, "
    "creep) is not tested.",
    "neo_hookean": "The simulated gel is neo-Hookean, the sensor takes it for linear.",
}


def force_caveat(results: DemoResults) -> str:
    """What the comparison with the true force tells, and what it does not."""
    return (
        "The true force is that of a simulation: contact with friction, solved on a "
        "finite-element mesh of its own, finer than the one from which the sensor computes force. "
        f"{MATERIAL[results.sensor.elastomer.model]} The sensor sees the contact only through its "
        "skin and at its markers: its field is smoother than the true one, and its outline of the "
        "contact is rounder and, where the pressure ends abruptly, wider."
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
    felt_n, true_n = before.force.wrench, results.recording.truth.wrench[before.index]
    interval_ms = (after.stamp_ns - before.stamp_ns) * 1e-6
    return [
        (
            f"By frame {before.index}, {results.time_s[jump.before]:.2f} s into the recording, "
            f"an object had pressed the gel in by {depth_mm:.2f} mm and dragged it sideways by "
            f"up to {drag_mm:.2f} mm: {-felt_n[2]:.2f}{_spread(before.force)} N into the gel, "
            f"truly {-true_n[2]:.2f} N, and {np.hypot(*felt_n[:2]):.2f} N along it, truly "
            f"{np.hypot(*true_n[:2]):.2f} N."
        ),
        (
            f"Then a knock: within one frame ({interval_ms:.0f} ms) the markers jumped by up to "
            f"{jump_mm:.2f} mm, {jump_mm * 1e-3 / results.sensor.pattern.pitch:.1f} checkers. "
            f"{kept} of {after.surface.status.size} markers kept their numbers and were measured "
            "in the very next frame."
        ),
    ]


def _spread(force: ForceField) -> str:
    """Two standard deviations of the normal force, where they are known."""
    std = force.wrench_std[2]
    return f" ± {BAND * std:.2f}" if np.isfinite(std) else ""
