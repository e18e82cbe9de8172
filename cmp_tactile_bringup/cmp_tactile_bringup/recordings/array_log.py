"""Collects arrays frame by frame on disk, and makes one NPZ file of them."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import atomic_path

__all__ = ["ArrayLog"]

COPY_BYTES = 1 << 20


class ArrayLog:
    """Appends rows of named arrays; memory does not grow with their number.

    A context manager: the file appears, whole, when it is left without an error, and not before.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = path.with_name(f".{path.name}.partial")
        self._files: dict[str, IO[bytes]] = {}
        self._rows: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._count = 0

    def __enter__(self) -> ArrayLog:
        if self._folder.exists():
            shutil.rmtree(self._folder)
        self._folder.mkdir(parents=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for file in self._files.values():
            file.close()
        try:
            if kind is None:
                self._assemble()
        finally:
            shutil.rmtree(self._folder)

    def append(self, row: Mapping[str, NDArray[Any]]) -> None:
        """Add one row; names, shapes and types must be those of the first row."""
        if not self._rows:
            for name, values in row.items():
                self._rows[name] = (values.dtype, values.shape)
                self._files[name] = (self._folder / f"{name}.raw").open("wb")
        found = {name: (values.dtype, values.shape) for name, values in row.items()}
        if found != self._rows:
            msg = f"found arrays {found}, expected {self._rows}"
            raise ValueError(msg)
        for name, values in row.items():
            self._files[name].write(np.ascontiguousarray(values).tobytes())
        self._count += 1

    def _assemble(self) -> None:
        with (
            atomic_path(self._path) as beside,
            zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        ):
            for name, (dtype, shape) in self._rows.items():
                header = {
                    "descr": np.lib.format.dtype_to_descr(dtype),
                    "fortran_order": False,
                    "shape": (self._count, *shape),
                }
                with (
                    archive.open(f"{name}.npy", "w", force_zip64=True) as target,
                    (self._folder / f"{name}.raw").open("rb") as source,
                ):
                    np.lib.format.write_array_header_1_0(target, header)
                    shutil.copyfileobj(source, target, COPY_BYTES)
