"""Organised PointCloud2 messages with one vector per point."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

__all__ = ["organised_cloud"]

FLOAT32_BYTES = 4


def organised_cloud(
    header: Header,
    positions: NDArray[np.float64],
    vectors: NDArray[np.float64],
    vector_fields: tuple[str, str, str],
) -> PointCloud2:
    """Cloud of height rows and width cols with fields x, y, z and the three vector fields.

    positions, vectors: (rows, cols, 3) in the frame of the header.  NaN stays, and makes the
    cloud not dense.
    """
    values = np.concatenate([positions, vectors], axis=-1).astype("<f4")
    rows, cols, columns = values.shape
    data = array.array("B")
    data.frombytes(values.tobytes())
    return PointCloud2(
        header=header,
        height=rows,
        width=cols,
        fields=[
            PointField(name=name, offset=i * FLOAT32_BYTES, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate(("x", "y", "z", *vector_fields))
        ],
        is_bigendian=False,
        point_step=columns * FLOAT32_BYTES,
        row_step=cols * columns * FLOAT32_BYTES,
        data=data,
        is_dense=bool(np.isfinite(values).all()),
    )
