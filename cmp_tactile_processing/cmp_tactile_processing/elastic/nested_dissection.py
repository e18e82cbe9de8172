"""The order in which a lattice of columns is best eliminated: small regions first, seams last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Region", "dissected"]

# Regions of so many elements or fewer, along both sides, are not cut any further.
LEAF_ELEMENTS = 2


@dataclass(frozen=True)
class Region:
    """Lattice columns that are eliminated together, once the regions `children` are.

    columns: numbers ix * ny + iy.  children: numbers of earlier regions; what these and the
    columns of a region are coupled to lies in later regions alone.
    """

    columns: NDArray[np.intp]
    children: tuple[int, ...]


def dissected(elements: tuple[int, int]) -> Sequence[Region]:
    """Regions of the columns of nodes under elements x by elements y second-order hexahedra.

    The seam between two halves is one column of nodes wide, and is what is left of them when
    both are eliminated; each half is cut likewise across its longer side (nested dissection,
    George 1973).
    """
    nx, ny = (2 * count + 1 for count in elements)
    unclaimed = np.ones((nx, ny), dtype=bool)
    numbers = np.arange(nx * ny).reshape(nx, ny)
    regions: list[Region] = []

    def claim(x: slice, y: slice) -> NDArray[np.intp]:
        claimed = numbers[x, y][unclaimed[x, y]]
        unclaimed[x, y] = False
        return claimed

    def cut(x: tuple[int, int], y: tuple[int, int]) -> int:
        """The number of the region of the elements x[0]..x[1] by y[0]..y[1]."""
        whole = [slice(2 * start, 2 * stop + 1) for start, stop in (x, y)]
        widths = x[1] - x[0], y[1] - y[0]
        if max(widths) <= LEAF_ELEMENTS:
            regions.append(Region(claim(*whole), ()))
        elif widths[0] >= widths[1]:
            middle = sum(x) // 2
            columns = claim(slice(2 * middle, 2 * middle + 1), whole[1])
            children = cut((x[0], middle), y), cut((middle, x[1]), y)
            regions.append(Region(columns, children))
        else:
            middle = sum(y) // 2
            columns = claim(whole[0], slice(2 * middle, 2 * middle + 1))
            children = cut(x, (y[0], middle)), cut(x, (middle, y[1]))
            regions.append(Region(columns, children))
        return len(regions) - 1

    cut((0, elements[0]), (0, elements[1]))
    return regions
