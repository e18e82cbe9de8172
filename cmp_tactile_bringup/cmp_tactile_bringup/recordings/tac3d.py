"""Recordings of Tac3D sensors: a folder of arrays for each, as the vendor's recorder writes them.

Lengths in them are mm, forces N, moments N mm, times s.  Marker (0, 0) is the one of largest y and
x; the gel frame has it the other way round, and begins at the gel's apex.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.library import RecordingError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface

Array = NDArray[np.float64]

POSITIONS, DISPLACEMENTS, FORCES = "3D_Positions", "3D_Displacements", "3D_Forces"
RESULTANT, MOMENT, STAMPS, INDEX = (
    "3D_ResultantForce",
    "3D_ResultantMoment",
    "sendTimestamp",
    "index",
)
REQUIRED = (POSITIONS, DISPLACEMENTS, STAMPS)
MILLI = 1e-3
# Markers are so far apart, mm; else lengths are in another unit.
PITCH_MM = 0.1, 20.0
# The surface is flat where its radius is larger, m.
LARGEST_RADIUS_M = 1.0
SPHERE_STEPS = 4


@dataclass(frozen=True)
class Tac3dRecording:
    """A recording of one sensor, turned into the gel frame.

    serial: of the sensor.  stamp_ns (n,).  lost: frames that are missing in between.
    reference (rows, cols, 3) m: markers at rest.  displacement (n, rows, cols, 3) m, NaN where a
    marker was not measured.  force (n, rows, cols, 3) N, wrench (n, 6) N and N m about the gel
    frame's origin: what the sensor itself says, NaN where it does not.
    """

    serial: str
    stamp_ns: NDArray[np.int64]
    lost: int
    reference: Array
    displacement: Array
    force: Array
    wrench: Array

    @property
    def pitch(self) -> float:
        """Mean distance of neighbouring markers at rest, m."""
        along_x = np.diff(self.reference[..., 0], axis=1)
        along_y = np.diff(self.reference[..., 1], axis=0)
        return float(np.mean([along_x.mean(), along_y.mean()]))

    def described(self, sensor: SensorDescription) -> SensorDescription:
        """The description with pitch and surface of this very sensor, from its markers at rest."""
        x, y, z = self.reference.reshape(-1, 3).T
        # Depth of a sphere below its apex: q = s / 2R + s^2 / 8R^3, s = x^2 + y^2.
        s, bend = x**2 + y**2, 0.0
        for _ in range(SPHERE_STEPS):
            terms = np.column_stack([np.ones_like(s), s / 2 + s**2 * bend**2 / 8])
            bend = float(-np.linalg.lstsq(terms, z, rcond=None)[0][1])
        surface = PatternSurface()
        if bend > 1 / LARGEST_RADIUS_M:
            surface = PatternSurface("sphere_cap", round(1 / bend, 5))
        pattern = replace(sensor.pattern, pitch=round(self.pitch, 7), surface=surface)
        return replace(sensor, name=self.serial, pattern=pattern)


def tac3d_folders(folder: Path) -> list[Path]:
    """The recordings of single sensors in a folder, or the folder itself where it is one.

    Raises RecordingError where there is none.
    """
    if (folder / f"{POSITIONS}.npy").exists():
        return [folder]
    found = sorted(path.parent for path in folder.glob(f"*/{POSITIONS}.npy"))
    if not found:
        there = ", ".join(sorted(path.name for path in folder.glob("*"))[:6]) or "nothing"
        msg = f"{folder}: found {there}, expected {POSITIONS}.npy, or folders of sensors with it"
        raise RecordingError(msg)
    return found


def read_tac3d(folder: Path) -> Tac3dRecording:
    """The recording of one sensor.

    Raises RecordingError, which names file, found and expected, where an array is missing, cannot
    be read, or has another shape or unit.
    """
    names = (*REQUIRED, FORCES, RESULTANT, MOMENT, INDEX)
    arrays = {name: _load(folder, name) for name in names}
    frames, markers = _checked_shapes(folder, arrays)
    side = round(markers**0.5)
    if side**2 != markers:
        raise _error(folder, POSITIONS, f"{markers} markers", "a square number, as 400")
    order = np.argsort(arrays[STAMPS].ravel(), kind="stable")
    stamps = np.rint(arrays[STAMPS].ravel()[order] * 1e9).astype(np.int64)
    new = np.append(True, np.diff(stamps) > 0)
    order, stamps = order[new], stamps[new]

    def on_grid(name: str) -> Array:
        values = arrays[name].reshape(frames, side, side, 3)[order]
        return np.asarray(values[:, ::-1, ::-1])

    moved = on_grid(DISPLACEMENTS)
    rest = np.nanmedian(on_grid(POSITIONS) - moved, axis=0)
    _check_rest(folder, rest)
    middle = side // 2
    origin = rest.mean(axis=(0, 1))
    origin[2] = rest[middle - 1 : middle + 1, middle - 1 : middle + 1, 2].mean()
    force, moment = arrays[RESULTANT].reshape(-1, 3)[order], arrays[MOMENT].reshape(-1, 3)[order]
    about = moment - np.cross(origin, force)
    index = arrays[INDEX].ravel()[order]
    return Tac3dRecording(
        serial=folder.resolve().name,
        stamp_ns=stamps,
        lost=int(np.nan_to_num(index[-1] - index[0] + 1 - len(index))),
        reference=MILLI * (rest - origin),
        displacement=MILLI * moved,
        force=on_grid(FORCES),
        wrench=np.hstack([force, MILLI * about]),
    )


def _load(folder: Path, name: str) -> Array:
    """An array; NaN for one that need not be there and is not."""
    path = folder / f"{name}.npy"
    if not path.exists() and name not in REQUIRED:
        return np.full(0, np.nan)
    try:
        # What an array of objects holds would be run.
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except FileNotFoundError:
        raise _error(folder, name, "no such file", "that of a recording") from None
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise _error(folder, name, f"a file that is no array ({error})", "numbers") from None


def _checked_shapes(folder: Path, arrays: dict[str, Array]) -> tuple[int, int]:
    """Numbers of frames and markers; what is not there is filled with NaN."""
    shape = arrays[POSITIONS].shape
    if len(shape) != 3 or shape[2] != 3 or not shape[0]:
        raise _error(folder, POSITIONS, f"shape {shape}", "(frames, markers, 3)")
    frames, markers = shape[:2]
    sizes = {POSITIONS: 3 * markers, DISPLACEMENTS: 3 * markers, FORCES: 3 * markers}
    sizes |= {RESULTANT: 3, MOMENT: 3, STAMPS: 1, INDEX: 1}
    for name, values in arrays.items():
        size = frames * sizes[name]
        if not values.size:
            arrays[name] = np.full(size, np.nan)
        elif values.size != size or len(values) != frames:
            expected = f"{frames} frames of {sizes[name]} numbers, as {POSITIONS} has them"
            raise _error(folder, name, f"shape {values.shape}", expected)
    if not np.isfinite(arrays[STAMPS]).all() or arrays[STAMPS].min() < 0:
        raise _error(folder, STAMPS, "times that are negative or no numbers", "s from 0 on")
    return frames, markers


def _check_rest(folder: Path, rest: Array) -> None:
    """Whether markers at rest are mm apart, with x and y as this reader takes them."""
    steps = rest[:, 1:, 0] - rest[:, :-1, 0], rest[1:, :, 1] - rest[:-1, :, 1]
    least, greatest = (float(limit(np.nan_to_num(np.concatenate([step.ravel() for step in steps]))))
                       for limit in (np.min, np.max))  # fmt: skip
    low, high = PITCH_MM
    if least < low or greatest > high:
        found = f"neighbours that are {least:.4g} to {greatest:.4g} apart along x and y"
        expected = f"{low:g} to {high:g} mm, x and y falling from the first marker to the last"
        raise _error(folder, POSITIONS, found, expected)


def _error(folder: Path, name: str, found: str, expected: str) -> RecordingError:
    return RecordingError(f"{folder / name}.npy: found {found}, expected {expected}")


@dataclass(frozen=True)
class Agreement:
    """How two forces over time agree, along x, y and z.

    correlation (3,); scale: of ours that comes nearest to theirs, all axes together; left (3,) N:
    root mean square of the difference then; frames: that were compared.
    """

    correlation: Array
    scale: float
    left: Array
    frames: int


def agreement(ours: Array, theirs: Array) -> Agreement | None:
    """Of forces (n, 3) N; None where there are fewer than two frames with both."""
    known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    ours, theirs = ours[known], theirs[known]
    if len(ours) < 2 or not ours.any():
        return None
    scale = float(np.vdot(ours, theirs) / np.vdot(ours, ours))
    left = np.sqrt(np.mean((scale * ours - theirs) ** 2, axis=0))
    return Agreement(_correlations(ours, theirs), scale, left, len(ours))


def _correlations(ours: Array, theirs: Array) -> Array:
    """Along each axis (3,), NaN where one of the two does not change."""
    ours, theirs = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    sizes = np.sqrt((ours**2).sum(axis=0) * (theirs**2).sum(axis=0))
    return np.asarray((ours * theirs).sum(axis=0) / np.where(sizes > 0, sizes, np.nan))
