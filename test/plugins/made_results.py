"""Bags of what a running sensor publishes, of made surfaces, forces and images."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import made_bags
import numpy as np
from made_forces import made_field

from cmp_tactile_processing.measured import ForceField, ForceFlag, GridShape, Surface
from cmp_tactile_processing.ros.messages.definitions import bag_messages, simulation_typestore

SHAPE, PITCH_M = GridShape(4, 5, 0), 1e-3
# The nodes of a force field need not be where the markers are.
NODE_ROWS, NODE_COLS, NODE_PITCH_M = 3, 4, 1.3e-3
Row = tuple[str, int, Any]


def lattice(rows: int, cols: int, pitch_m: float) -> np.ndarray:
    """Points (rows, cols, 3) m, centred."""
    x, y = ((np.arange(n) - (n - 1) / 2) * pitch_m for n in (cols, rows))
    return np.stack([*np.meshgrid(x, y), np.zeros((rows, cols))], axis=-1)


def surface(number: int) -> Surface:
    """Of a frame: all markers moved by as many um along x, and one was not seen."""
    reference = lattice(SHAPE.rows, SHAPE.cols, PITCH_M)
    position = reference + (number * 1e-6, 0, 0)
    position[1, 2] = np.nan
    return Surface.from_positions(SHAPE, reference, position)


def force(number: int) -> ForceField:
    """Of a frame: its number in mN at each node along -z; frame 2 must not be used."""
    forces = np.zeros((NODE_ROWS * NODE_COLS, 3))
    forces[:, 2] = -1e-3 * number
    wrench = np.array([*forces.sum(axis=0), 0.1, 0.2, 0.3]) + 1e-4
    return made_field(
        NODE_ROWS,
        NODE_COLS,
        position=lattice(NODE_ROWS, NODE_COLS, NODE_PITCH_M).reshape(-1, 3),
        force=forces,
        wrench=wrench,
        flags=ForceFlag.POOR_FIT if number == 2 else ForceFlag.NONE,
    )


def rows(
    count: int, sensor: str = "rig", *, images: bool = True, prefix: str = "", offset_ns: int = 0
) -> Iterator[Row]:
    """Messages of so many frames at 20 Hz; prefix: truth/ for those of a simulator."""
    make = bag_messages()
    shown = made_bags.frames(count)
    for number, stamp_ns in enumerate(made_bags.stamps(count)):
        header = make.header(stamp_ns + offset_ns, f"{sensor}_gel_frame")
        place = f"/{sensor}/{prefix}"
        stamp = stamp_ns + offset_ns
        yield f"{place}surface", stamp, make.surface(surface(number), header)
        yield f"{place}force_field", stamp, make.force_field(force(number), header)
        if images:
            yield f"/{sensor}/image_raw", stamp, made_bags.image(shown[number], stamp)


def write(path: Path, messages: Iterable[Row]) -> Path:
    """A bag of messages in the order in which they were received."""
    ordered = sorted(messages, key=lambda row: row[1])
    return made_bags.write_rows(path, ordered, store=simulation_typestore())
