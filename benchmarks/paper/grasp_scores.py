"""How far the force of a grasp is off, stage by stage, and where a method loses its numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.experiment import Arrays

__all__ = ["LIMIT", "STAGES", "GraspScore", "StageError", "frames_of"]

# Of the error of a force, share of the largest true force: set before anything was measured.
LIMIT = 0.05
# The paper's stages, and before and after them, by the phases of the scene.
STAGES = {
    "before": ("rest",),
    "clamping": ("close", "drag"),
    "disturbance": ("knock", "hold", "knock back"),
    "release": ("open",),
    "after": ("rest again",),
}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StageError:
    """Of the resultant force, shares of the peak; NaN where no frame of the stage gave a force."""

    rms: float
    largest: float


def frames_of(phase: NDArray[np.str_], stage: str) -> NDArray[np.intp]:
    """Frames of a stage."""
    return np.flatnonzero(np.isin(phase, STAGES[stage]))


@dataclass(frozen=True)
class GraspScore:
    """Of one method; S draws of the noise, F frames.

    force, moment (S, F): distance of the measured from the true resultant, as a share of the
    largest true one; NaN where the method gave none.  wrong, found (S, F): shares of the visible
    markers.  wrench (S, F, 6).  flags (S, F): what the force stage itself warns of.
    """

    phase: NDArray[np.str_]
    wrench: Array
    force: Array
    moment: Array
    wrong: Array
    found: Array
    flags: NDArray[np.int_]

    @classmethod
    def from_arrays(cls, arrays: Arrays, key: str) -> GraspScore:
        """From the result of `film_grasp`."""
        true, wrench = arrays["true_wrench"], arrays[f"{key}.wrench"]
        return cls(
            arrays["phase"],
            wrench,
            _share(wrench[..., :3], true[:, :3]),
            _share(wrench[..., 3:], true[:, 3:]),
            arrays[f"{key}.wrong"],
            arrays[f"{key}.found"],
            arrays[f"{key}.flags"],
        )

    def of_stage(self, stage: str) -> StageError:
        """Over all frames and draws of a stage."""
        error = self.force[:, frames_of(self.phase, stage)]
        error = error[np.isfinite(error)]
        if not error.size:
            return StageError(float("nan"), float("nan"))
        return StageError(float(np.sqrt(np.mean(error**2))), float(error.max()))

    @property
    def bad(self) -> NDArray[np.bool_]:
        """(F,) frames in which a draw has a wrong number, no force or one beyond LIMIT."""
        error = np.where(np.isfinite(self.force), self.force, np.inf)
        return np.asarray(((self.wrong > 0) | (error > LIMIT)).any(axis=0))

    @property
    def frames_wrong(self) -> int:
        """Frames in which a draw has wrong numbers."""
        return int((self.wrong > 0).any(axis=0).sum())

    @property
    def warned(self) -> int:
        """Bad frames in which the force stage warns, in every draw."""
        return int((self.bad & (self.flags != 0).all(axis=0)).sum())

    @property
    def first_bad(self) -> int | None:
        """The first of the bad frames."""
        return int(np.argmax(self.bad)) if self.bad.any() else None

    @property
    def good_again(self) -> int | None:
        """The frame from which on none is bad; None where none was or the last one still is."""
        if not self.bad.any() or self.bad[-1]:
            return None
        return int(np.flatnonzero(self.bad)[-1]) + 1

    @property
    def noise(self) -> Array:
        """Standard deviation of Fx, Fy, Fz (3,) N while the bar is held still."""
        held = self.wrench[:, self.phase == "hold", :3]
        return np.asarray(np.nanstd(held, axis=1).mean(axis=0))

    @property
    def at_rest(self) -> float:
        """The largest force that is measured where nothing touches, N."""
        free = np.linalg.norm(self.wrench[:, frames_of(self.phase, "before"), :3], axis=-1)
        return float(np.nanmax(free))


def _share(measured: Array, true: Array) -> Array:
    peak = np.linalg.norm(true, axis=-1).max()
    return np.asarray(np.linalg.norm(measured - true, axis=-1) / peak)
