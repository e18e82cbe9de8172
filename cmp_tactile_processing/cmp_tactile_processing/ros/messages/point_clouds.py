"""Organised PointCloud2 messages with one vector per point."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

__all__ = ["organised_cloud"]

# Points begin at multiples of four bytes, as readers like them.
ALIGNMENT = 4
FIELD_TYPES = {"<f4": PointField.FLOAT32, "u1": PointField.UINT8}


def organised_cloud(
    header: Header,
    positions: NDArray[np.float64],
    vectors: NDArray[np.float64],
    vector_fields: tuple[str, str, str],
    status: NDArray[np.uint8] | None = None,
) -> PointCloud2:
    """Cloud of height rows and width cols with fields x, y, z and the three vector fields.

    positions, vectors: (rows, cols, 3) in the frame of the header.  status (rows, cols), where
    given, becomes the field `status`, uint8.  NaN stays, and makes the cloud not dense.
    """
    columns: list[NDArray[Any]] = [*np.moveaxis(positions, -1, 0), *np.moveaxis(vectors, -1, 0)]
    names, formats = ["x", "y", "z", *vector_fields], ["<f4"] * len(columns)
    if status is not None:
        names, formats, columns = [*names, "status"], [*formats, "u1"], [*columns, status]
    sizes = [np.dtype(form).itemsize for form in formats]
    offsets = [int(start) for start in np.cumsum([0, *sizes[:-1]])]
    step = -(-sum(sizes) // ALIGNMENT) * ALIGNMENT
    rows, cols = positions.shape[:2]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    points: NDArray[Any] = np.zeros((rows, cols), layout)
    for name, column in zip(names, columns, strict=True):
        points[name] = column
    data = array.array("B")
    data.frombytes(points.tobytes())
    return PointCloud2(
        header=header,
        height=rows,
        width=cols,
        fields=[
            PointField(name=name, offset=offset, datatype=FIELD_TYPES[form], count=1)
            for name, offset, form in zip(names, offsets, formats, strict=True)
        ],
        is_bigendian=False,
        point_step=step,
        row_step=cols * step,
        data=data,
        is_dense=bool(np.isfinite(positions).all() and np.isfinite(vectors).all()),
    )
