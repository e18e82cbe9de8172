"""The reference that displacements are measured against, and the surfaces that come of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.measured import (
    GridShape,
    MarkerFault,
    Markers3D,
    ReferenceFault,
    Status,
    Surface,
    Systematics,
    no_virtual_markers,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_processing.surface.stillness import dents_of_frames

# Markers of a gel at rest stay within this of their median, m; ten times the usual noise of 5 um.
STILL_LIMIT = 50e-6
# Share of markers that a reference must hold.
LEAST_MARKERS = 0.5
# Of so many frames one may be bad, where there are enough to outvote it.
FRAMES_PER_BAD_ONE = 10
LEAST_TO_OUTVOTE = 3
MISSING, NO_REFERENCE = int(Status.MISSING), int(MarkerFault.NO_REFERENCE)

Array: TypeAlias = NDArray[np.float64]
# Position or displacement, covariance, status, fault.
Known: TypeAlias = tuple[Array, Array, NDArray[np.uint8], NDArray[np.uint8]]


@dataclass(frozen=True)
class Reference:
    """Marker positions (rows, cols, 3) m at rest, gel frame; NaN where none is known.

    covariance (rows, cols, 3, 3) m^2: of these positions; 0 for the nominal surface, which is
    taken for exact, NaN where unknown.  id: 0 for the nominal surface, then counting up.
    stamp_ns: last frame averaged, 0 if nominal.  frames: averaged, 0 if nominal.
    pixels: mean corners (rows, cols, 2) px by view, as Markers3D has them.
    faults, systematics: as Surface has them.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    id: int = 0
    stamp_ns: int = 0
    frames: int = 0
    pixels: Mapping[str, NDArray[np.float64]] | None = None
    faults: ReferenceFault = ReferenceFault.NONE
    systematics: Systematics | None = None

    @classmethod
    def nominal(cls, sensor: SensorDescription) -> Reference:
        """The pattern at rest as the sensor description has it."""
        position = sensor.pattern.corners()
        covariance = np.zeros((*position.shape, 3))
        # What is compiled is compiled now, and not in the first frame.
        codes = np.zeros(position.shape[:2], np.uint8)
        found = position.copy(), covariance.copy(), codes, codes
        _displace(found, (position, covariance), found)
        return cls(position, covariance, faults=ReferenceFault.NOT_TAKEN)

    @classmethod
    def average(
        cls, markers: Sequence[Markers3D], reference_id: int, stamp_ns: int = 0
    ) -> Reference:
        """Mean of several frames of the gel at rest.

        Of three frames or more, one in ten, at least one, may be bad: markers moved, or something
        touched the gel.  A marker that was measured in some frames is averaged from these, one that
        was predicted in all from all.  Raises CalibrationError without frames, when fewer than half
        of the markers were seen, or when more frames are bad.
        """
        if not markers:
            msg = "reference: found no frames, expected at least one"
            raise CalibrationError(msg)
        stack = _best_known(markers)
        seen = np.asarray(np.isfinite(stack[..., :2]).all(axis=-1))
        _require_markers(seen)
        used = _at_rest(stack, seen)
        _require_markers(used)
        stack[~used] = np.nan
        frames = int(np.count_nonzero(used.any(axis=(1, 2))))
        covariance = _covariance_of_mean(markers, used)
        pixels = _mean_pixels(markers, used)
        return cls(_known_mean(stack), covariance, reference_id, stamp_ns, frames, pixels)

    def surface(self, markers: Markers3D) -> Surface:
        """Displacement of the markers; missing where either position or reference is.

        Raises InputError for another number of markers: compiled loops check no bounds.
        """
        if markers.position.shape != self.position.shape:
            msg = f"reference: found {self.position.shape}, expected {markers.position.shape}"
            raise InputError(msg)
        displacement, covariance = np.empty_like(self.position), np.empty((*self.position.shape, 3))
        status, fault = (np.empty(displacement.shape[:2], np.uint8) for _ in range(2))
        _displace(
            (markers.position, markers.covariance, markers.status, markers.fault),
            (self.position, self.covariance),
            (displacement, covariance, status, fault),
        )
        changed = {
            "status": status,
            "fault": fault,
            "covariance": covariance,
            "reference": self.position,
            "displacement": displacement,
            "reference_id": self.id,
            "reference_stamp_ns": self.stamp_ns,
            "reference_faults": self.faults,
            "systematics": self.systematics,
        }
        return Surface(**(vars(markers) | changed))


@kernel
def _displace(markers: Known, reference: tuple[Array, Array], out: Known) -> None:
    """Fill out: displacement, covariance, status and fault (rows, cols, ...).

    markers: position, covariance, status and fault; reference: position and covariance.
    """
    position, covariance, status, fault = markers
    for i in range(status.shape[0]):
        for j in range(status.shape[1]):
            out[2][i, j], out[3][i, j] = status[i, j], fault[i, j]
            for a in range(3):
                out[0][i, j, a] = position[i, j, a] - reference[0][i, j, a]
                for b in range(3):
                    out[1][i, j, a, b] = covariance[i, j, a, b] + reference[1][i, j, a, b]
            # One view alone may know no depth; then there is no displacement in depth either.
            if math.isnan(out[0][i, j, 0]) or math.isnan(out[0][i, j, 1]):
                out[0][i, j], out[1][i, j], out[2][i, j] = math.nan, math.nan, MISSING
                if status[i, j] != MISSING:
                    out[3][i, j] = NO_REFERENCE


def _best_known(markers: Sequence[Markers3D]) -> NDArray[np.float64]:
    """Positions (F, rows, cols, 3), without those predicted that another frame has measured."""
    measured = np.stack([item.status == Status.MEASURED for item in markers])
    left_out = measured.any(axis=0) & ~measured
    return np.where(left_out[..., None], np.nan, np.stack([item.position for item in markers]))


def _require_markers(known: NDArray[np.bool_]) -> None:
    """Raise CalibrationError where too few are known in any frame; known (F, rows, cols)."""
    share = float(known.any(axis=0).mean())
    if share < LEAST_MARKERS:
        msg = f"reference: found {share:.0%} of the markers, expected {LEAST_MARKERS:.0%}"
        raise CalibrationError(msg)


def _at_rest(stack: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which markers (F, rows, cols) of which frames are at rest with the others.

    Raises CalibrationError where more moves than a bad frame, or a bad marker, explains.
    """
    ever = seen.any(axis=0)
    middle = np.full((*ever.shape, 2), np.nan)
    middle[ever] = np.nanmedian(stack[:, ever, :2], axis=0)
    off = np.linalg.norm(stack[..., :2] - middle, axis=-1)
    # Frames that show nothing have no vote, and a frame is judged by what others show as well.
    voters = int(np.count_nonzero(seen.any(axis=(1, 2))))
    outvoted = voters >= LEAST_TO_OUTVOTE
    often = seen & (np.count_nonzero(seen, axis=0) >= LEAST_TO_OUTVOTE)
    used: NDArray[np.bool_] = seen.copy()
    if outvoted:
        typical = [
            float(np.median(o[s])) if s.any() else 0.0 for o, s in zip(off, often, strict=True)
        ]
        shown, dents = seen.any(axis=(1, 2)), np.zeros(len(stack))
        dents[shown], least = dents_of_frames(stack[shown])
        bad = (np.array(typical) > STILL_LIMIT) | (dents > least)
        if np.count_nonzero(bad) <= max(1, voters // FRAMES_PER_BAD_ONE):
            used[bad] = False
        elif (dents > least).any():
            msg = (
                f"reference: found {np.count_nonzero(dents > least)} of {voters} frames in which "
                f"neighbouring markers are off the other frames by up to {dents.max() * 1e6:.0f} "
                f"um, expected a gel at rest (at most {least * 1e6:.0f} um)"
            )
            raise CalibrationError(msg)
    moved = float(np.median(np.max(off, axis=0, where=used, initial=0.0)[used.any(axis=0)]))
    if moved > STILL_LIMIT:
        msg = (
            f"reference: found markers moving by {moved * 1e6:.0f} um, "
            f"expected a gel at rest (at most {STILL_LIMIT * 1e6:.0f} um)"
        )
        raise CalibrationError(msg)
    if outvoted:
        used &= off <= STILL_LIMIT
    return used


def _known_mean(stack: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over frames (F, ...) of what is not NaN; NaN where there is nothing."""
    count = np.isfinite(stack).sum(axis=0)
    return np.where(count > 0, np.nansum(stack, axis=0) / np.maximum(count, 1), np.nan)


def _mean_pixels(
    markers: Sequence[Markers3D], used: NDArray[np.bool_]
) -> dict[str, NDArray[np.float64]] | None:
    """Mean corners of the markers that are used (F, rows, cols), by view; None without images."""
    seen = [item.pixels for item in markers if item.pixels is not None]
    if len(seen) < len(markers):
        return None
    return {
        view: _known_mean(np.where(used[..., None], [item[view] for item in seen], np.nan))
        for view in seen[0]
    }


def _covariance_of_mean(
    markers: Sequence[Markers3D], used: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """(rows, cols, 3, 3) m^2: errors of different frames are independent; NaN where unknown."""
    total = np.zeros(markers[0].covariance.shape)
    known, count = np.zeros(total.shape), used.sum(axis=0)[..., None, None]
    for item, rows in zip(markers, used, strict=True):
        stated = np.isfinite(item.covariance) & rows[..., None, None]
        total += np.where(stated, item.covariance, 0.0)
        known += stated
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known > 0, total / known / count, np.nan)


def surface_at_rest(reference: Reference, shape: GridShape) -> Surface:
    """The surface with all markers where the reference has them; no virtual markers.

    Its covariance is that of the reference's positions.
    """
    position = reference.position
    known = np.isfinite(position[..., :2]).all(axis=-1)
    return Surface(
        shape=shape,
        reference=position,
        position=position,
        displacement=position - position,
        status=np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8),
        fault=np.where(known, MarkerFault.NONE, MarkerFault.NO_REFERENCE).astype(np.uint8),
        covariance=reference.covariance,
        ray_gap=np.full(shape.corners, np.nan),
        **no_virtual_markers(shape),
        reference_id=reference.id,
        reference_stamp_ns=reference.stamp_ns,
        reference_faults=reference.faults,
        systematics=reference.systematics,
    )


def laid_on_known_surface(surface: Surface, known: PatternSurface) -> Surface:
    """The surface with its markers at the height of the known one, displacement along it.

    For drawing alone: no height was measured.  A surface with any depth of its own stays as it is.
    """
    if np.isfinite(surface.position[..., 2]).any():
        return surface
    position, reference = _laid(surface.position, known), _laid(surface.reference, known)
    return replace(
        surface, position=position, reference=reference, displacement=position - reference
    )


def _laid(points: NDArray[np.float64], known: PatternSurface) -> NDArray[np.float64]:
    return np.concatenate([points[..., :2], known.height(points[..., :2])[..., None]], axis=-1)
