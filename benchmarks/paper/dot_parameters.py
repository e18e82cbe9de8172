"""Settings of the dot methods (DMP); `dot_tuning` measures what they rest on."""

from __future__ import annotations

from dataclasses import dataclass

from paper.film import DOT_DIAMETER

__all__ = ["CENTRINGS", "DotParameters"]

# Ways to tell a dot's centre; see dot_centres.py and dot_detection.py.
CENTRINGS = ("centroid", "ellipse", "peak", "blob_detector")


@dataclass(frozen=True)
class DotParameters:
    """What all dot methods share, and what each has of its own.

    Lengths are shares of the pitch as the view shows it, darkness of the dots' own.
    diameter: of the printed dots.
    centring: one of CENTRINGS.  threshold: darkness from which a pixel counts.  window: radius
    around the centre within which pixels count, in radii of a dot.  smoothing_px: standard
    deviation of the Gaussian that the image is smoothed with before.
    curvature: whether centres are corrected for the curvature of the measured grid, or only for
    that of the nominal one.
    least_response: of the matched filter, as a share of a typical dot's.
    least_area, most_area: of a typical dot's; most_elongation: longer over shorter axis, after the
    foreshortening is taken out; most_residual: RMS distance of the outline from an ellipse, in
    radii.  A dot outside of these is hidden in part.
    nearest_gate, assignment_gate, grid_gate, recovery_gate: how far a dot may lie from where it is
    looked for.
    flow_window: side of the optical flow's window, in pitches; flow_levels: halvings of the image;
    flow_return: how far the flow back may miss the start, px.
    """

    diameter: float = DOT_DIAMETER
    centring: str = "centroid"
    threshold: float = 0.05
    window: float = 1.6
    smoothing_px: float = 0.0
    curvature: bool = True
    least_response: float = 0.4
    least_area: float = 0.55
    most_area: float = 1.8
    most_elongation: float = 2.0
    most_residual: float = 0.12
    nearest_gate: float = 0.9
    assignment_gate: float = 3.0
    grid_gate: float = 0.45
    recovery_gate: float = 0.35
    flow_window: float = 1.2
    flow_levels: int = 2
    flow_return: float = 1.0
