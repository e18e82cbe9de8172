"""The picture of a deformed pattern.

In: a deformed surface, ink, camera settings.
Out: frames, and where corners and gridlines truly are.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np

# Random numbers of a scene: a stream for each purpose, none of which another draws too.


@unique
class Purpose(IntEnum):
    """What the numbers are for."""

    FRAME_NOISE = 1
    PRINT_EDGES = 2
    PRINT_BLOBS = 3
    GLARE = 4
    CLUTTER = 5
    SCENERY = 6
    COVER = 7
    CHANGED_RIG = 8
    SAMPLE = 9
    VARIANT = 10


def random_stream(purpose: Purpose, seed: int, frame: int = 0) -> np.random.Generator:
    """The stream of a purpose, from its beginning.  seed, frame: 0 to 2^32 - 1."""
    return np.random.default_rng([purpose, seed, frame])
