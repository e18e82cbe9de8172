"""How well a dense field is measured: its error, and the finest wave that it still shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.surface.dense import DenseSurface
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from paper.pattern_choice_fields import WAVELENGTHS, wave_directions

__all__ = ["NODES", "field_rms", "finest_wave", "true_displacement", "wave_gains"]

# Every pattern of at least 8 x 8 corners on the print covers these.
NODES = SurfaceGrid(111, 111, (0.011, 0.011))
LEAST_COVER = 0.98
# The finest wave is that of which this share of the amplitude is left.
RESOLVED = 0.5


def true_displacement(surface: DeformedSurface) -> NDArray[np.float64]:
    """Displacement (rows, cols, 3) m of the nodes' material points from rest."""
    rest = DeformedSurface.rest(surface.pattern)
    moved = surface.at_material(NODES.points) - rest.at_material(NODES.points)
    return np.asarray(moved.reshape(NODES.rows, NODES.cols, 3))


def field_rms(dense: DenseSurface, truth: NDArray[np.float64]) -> float:
    """RMS length of the displacement's error over all nodes, m.

    NaN where more than two in a hundred nodes are missing: what is left says nothing of a frame.
    """
    squared = ((dense.displacement - truth) ** 2).sum(axis=-1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.mean() >= LEAST_COVER else float("nan")


def wave_gains(dense: DenseSurface, truth: NDArray[np.float64], which: int) -> NDArray[np.float64]:
    """Share (waves,) of each wave's amplitude that is measured, in phase; least squares."""
    points = NODES.points
    known = np.isfinite(dense.displacement[..., 2]).ravel()
    if known.mean() < LEAST_COVER:
        return np.full(len(WAVELENGTHS), np.nan)
    phases = 2 * np.pi * (points @ wave_directions(which).T) / WAVELENGTHS
    basis = np.hstack([np.sin(phases), np.cos(phases), np.ones((len(points), 1)), points])[known]
    fields = np.stack([dense.displacement[..., 2].ravel(), truth[..., 2].ravel()], axis=-1)[known]
    measured, true = np.linalg.lstsq(basis, fields, rcond=None)[0][: len(WAVELENGTHS)].T
    return np.asarray(measured / true)


def finest_wave(gains: NDArray[np.float64]) -> float:
    """Wavelength, m, down to which at least half of the amplitude is measured.

    Between two of WAVELENGTHS by their logarithm.  NaN where the longest is not measured, or
    nothing; the shortest where all are.
    """
    low = np.flatnonzero(~(gains >= RESOLVED))
    if not len(low):
        return float(WAVELENGTHS[-1])
    first = int(low[0])
    if first == 0 or not np.isfinite(gains[first]):
        return float("nan")
    before, after = gains[first - 1], gains[first]
    share = (before - RESOLVED) / (before - after)
    start, end = np.log(WAVELENGTHS[first - 1 : first + 1])
    return float(np.exp(start + share * (end - start)))
