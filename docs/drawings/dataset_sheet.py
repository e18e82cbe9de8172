"""Draws docs/images/dataset.webp: the first 24 samples of a dataset with their pressure.

`setup/run python3 docs/drawings/dataset_sheet.py presses docs/images/dataset.webp`
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import xarray
from PIL import Image

ROWS, COLS, SMALLER, INSET_PX = 4, 6, 4, 80
QUALITY = 80


def tile(sample: xarray.Dataset) -> np.ndarray:
    """The camera frame, smaller, with indenter, normal force, and pressure at the nodes."""
    picture = cv2.cvtColor(sample.image.values[::SMALLER, ::SMALLER], cv2.COLOR_GRAY2RGB)
    pressure = -sample.traction.values[::-1, :, 2]
    scaled = np.uint8(255 * np.clip(pressure / pressure.max(), 0, 1))
    coloured = cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    inset = cv2.resize(coloured, (INSET_PX, INSET_PX), interpolation=cv2.INTER_NEAREST)
    picture[-INSET_PX:, :INSET_PX] = inset
    text = f"{sample.indenter.values} {-float(sample.wrench[2]):.2f} N"
    cv2.putText(
        picture, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 200, 0), 1, cv2.LINE_AA
    )
    return picture


def main() -> None:
    """Run from the command line."""
    folder, target = map(Path, sys.argv[1:])
    first = min(folder.glob("samples_*.nc"))
    with xarray.open_dataset(first, engine="h5netcdf") as data:
        tiles = [tile(data.isel(frame=number)) for number in range(ROWS * COLS)]
    rows = [np.hstack(tiles[row * COLS : (row + 1) * COLS]) for row in range(ROWS)]
    Image.fromarray(np.vstack(rows)).save(target, quality=QUALITY)


if __name__ == "__main__":
    main()
