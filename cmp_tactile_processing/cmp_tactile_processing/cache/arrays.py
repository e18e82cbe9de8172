"""Arrays that take long to compute, kept in the user's cache folder.

Nothing is taken from a cache that another user has written, or may have.
"""

from __future__ import annotations

import json
import logging
import os
import zipfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache import files

LOGGER = logging.getLogger(__name__)

Arrays = dict[str, NDArray[np.float64]]


def cached_arrays(
    folder: Path | None,
    name: str,
    key: Mapping[str, Any],
    shapes: Mapping[str, tuple[int, ...]],
    build: Callable[[], Arrays],
) -> Arrays:
    """The float64 arrays of `build`, from the cache where it holds them for this key.

    key: all that the arrays depend on, in a form that JSON takes.  shapes: of every array.
    A damaged or stale file is built again with a line in the log; a folder that cannot be
    written costs a warning, not the result.  Of several processes one builds, the others wait.
    """
    text = json.dumps(key, sort_keys=True)
    folder = files.default_cache_dir() if folder is None else Path(folder)
    path = folder / f"{name}-{files.digest(text)[:32]}.npz"
    try:
        if reason := files.own_folder(folder):
            LOGGER.warning("%s: %s: closed to others", folder, reason)
    except OSError as error:
        LOGGER.warning("%s: not cached, will be built again next time: %s", folder, error)
        return build()
    try:
        return _read(path, shapes)
    except (FileNotFoundError, PermissionError):
        pass  # where it cannot be written either, that is reported below
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used, is built again: %s", path, error)
    with ExitStack() as until_written:
        with suppress(OSError):
            until_written.enter_context(files.locked(path.with_suffix(".lock")))
        # Another process may have built it while this one waited.
        with suppress(OSError, ValueError, KeyError, zipfile.BadZipFile):
            return _read(path, shapes)
        arrays = build()
        try:
            _write(path, arrays)
        except OSError as error:
            LOGGER.warning("%s: not cached, will be built again next time: %s", path, error)
        return arrays


def _read(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Arrays:
    with path.open("rb") as file:
        if reason := files.why_foreign(os.fstat(file.fileno())):
            raise ValueError(reason)
        archive = zipfile.ZipFile(file)
        return {name: _read_array(archive, name, shape) for name, shape in shapes.items()}


def _read_array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """One array; its header is compared before any memory is allocated for it."""
    with archive.open(f"{name}.npy") as member:
        version = np.lib.format.read_magic(member)
        if version != (1, 0):
            msg = f"{name}: found npy version {version}, expected (1, 0)"
            raise ValueError(msg)
        found, fortran, dtype = np.lib.format.read_array_header_1_0(member)
        if (found, fortran, dtype) != (shape, False, np.dtype(np.float64)):
            msg = f"{name}: found {dtype} {found}, expected float64 {shape}"
            raise ValueError(msg)
        data = member.read()  # to the end, so that the archive's checksum is compared
    array = np.frombuffer(data, dtype=np.float64).reshape(shape)
    if not np.isfinite(array).all():
        msg = f"{name}: found values that are not finite"
        raise ValueError(msg)
    return array


def _write(path: Path, arrays: Arrays) -> None:
    with files.atomic_path(path, 0o600) as beside, zipfile.ZipFile(beside, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(
                    member, np.ascontiguousarray(array), (1, 0), allow_pickle=False
                )
