"""Where simulated frames go: what a bag and a folder of images have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.scenes.simulation import SimulatedFrame

__all__ = ["FrameOutput", "WrittenFrame"]


@dataclass(frozen=True)
class WrittenFrame:
    """What the video shows of a frame that was written.

    image (H, W) uint8.  corners_m, displacement (rows, cols, 3) m, NaN where missing.
    force_position (M, 3) m, force (M, 3) N, wrench (6,) N and N m, contact_area m^2.
    """

    image: NDArray[np.uint8]
    corners_m: NDArray[np.float64]
    displacement: NDArray[np.float64]
    force_position: NDArray[np.float64]
    force: NDArray[np.float64]
    wrench: NDArray[np.float64]
    contact_area: float


class FrameOutput(Protocol):
    """Takes the frames of one scene in order."""

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""

    def close(self) -> None:
        """Make what was written readable for others; nothing may be appended afterwards."""

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written, once it is closed."""
