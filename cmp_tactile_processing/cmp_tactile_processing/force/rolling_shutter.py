"""What a force changes while a camera reads out a frame, row by row.

The rows of a contact are exposed up to half the readout time before or after the frame's middle.
"""

from __future__ import annotations

import math

import numpy as np

from cmp_tactile_processing.measured import ForceField

# Of a value that is somewhere within a range of 1, each place as likely.
STD_OF_RANGE = 1 / math.sqrt(12)
# What speeds up evenly from rest is at the end twice as fast as on average.
FASTEST = 2.0


class RollingShutter:
    """Adds to the error bars of one sensor's force fields what changed during the readout.

    The change since the frame before tells how fast the force changes: as of a movement that began
    there.
    """

    def __init__(self, readout_time: float) -> None:
        """readout_time: from the first row to the last, s; 0: all rows at once."""
        self._readout_time = readout_time
        self._before: tuple[ForceField, int] | None = None

    def reset(self) -> None:
        """Forget the frame before."""
        self._before = None

    def add(self, field: ForceField, stamp_ns: int | None) -> ForceField:
        """The field of the frame that was taken then, with wider error bars where it moves."""
        before = self._before
        known = stamp_ns is not None and np.isfinite(field.wrench).all()
        self._before = (field, stamp_ns) if known and stamp_ns is not None else None
        if not self._readout_time or before is None or self._before is None:
            return field
        since = (self._before[1] - before[1]) * 1e-9
        if since <= 0:
            return field
        share = FASTEST * STD_OF_RANGE * self._readout_time / since
        wrench = share * (field.wrench - before[0].wrench)
        nodes = share * (field.force - before[0].force)
        return field.with_errors(np.outer(wrench, wrench), nodes)
