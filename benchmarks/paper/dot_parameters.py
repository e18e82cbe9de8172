"""Settings of the dot methods (DMP).

Chosen on contacts that no experiment uses; benchmarks/results/paper_dot_tuning.md holds the tables
that the reasons below refer to, and says how they were measured.
"""

from __future__ import annotations

from dataclasses import dataclass

from paper.film import DOT_DIAMETER

__all__ = ["DotParameters"]


@dataclass(frozen=True)
class DotParameters:
    """What all dot methods share, and what each has of its own.

    Lengths are shares of the pitch as the view shows it, darkness of the dots' own.
    diameter: of the printed dots.
    threshold: darkness from which a pixel counts for the centre.  window: radius around the centre
    within which pixels count, in radii of a dot.
    curvature: whether centres are corrected for the curvature of the measured grid, or only for
    that of the nominal one, which is perspective and the gel's shape at rest.
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
    # Skin that weighs adds noise, a dot's rim that does not weigh lets pixels draw the centre.
    threshold: float = 0.05
    window: float = 1.6
    # The neighbours tell about two fifths of what a contact does to the centres.
    curvature: bool = True
    # Noise of a quarter of the contrast answers with 0.23 at most, in 450 x 450 px.
    least_response: float = 0.4
    # Contacts change areas by less than half and stretch by less than these.
    least_area: float = 0.55
    most_area: float = 1.8
    most_elongation: float = 2.0
    most_residual: float = 0.12
    # More changes nothing but which markers go wrong; less loses dots that move slowly.
    nearest_gate: float = 0.9
    # Less loses what leaps; more changes nothing.
    assignment_gate: float = 3.0
    # Neighbours are told apart up to half a pitch; all values up to that do as well.
    grid_gate: float = 0.45
    recovery_gate: float = 0.35
    # As good as any, but three halvings blur dots away.
    flow_window: float = 1.2
    flow_levels: int = 2
    flow_return: float = 1.0
