"""Arrays that take long to compute, kept in the user's cache folder.

Nothing is taken from a folder that another user can write.
"""

from __future__ import annotations

import json
import logging
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
# What reading a damaged or stale file raises.
UNUSABLE = (OSError, EOFError, ValueError, KeyError, MemoryError, zipfile.BadZipFile)


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
        files.own_folder(folder)
    except OSError as error:
        LOGGER.warning("%s: not cached, will be built again next time: %s", folder, error)
        return build()
    try:
        return _read(path, shapes)
    except (FileNotFoundError, PermissionError):
        pass  # where it cannot be written either, that is reported below
    except UNUSABLE as error:
        LOGGER.warning("%s: cannot be used and is built again: %s", path, error)
    with ExitStack() as until_written:
        with suppress(OSError):
            until_written.enter_context(files.locked(path.with_suffix(".lock")))
        # Another process may have built it while this one waited.
        with suppress(*UNUSABLE):
            return _read(path, shapes)
        arrays = build()
        try:
            _write(path, arrays)
        except OSError as error:
            LOGGER.warning("%s: not cached, will be built again next time: %s", path, error)
        return arrays


def _read(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Arrays:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in shapes}
    for name, array in arrays.items():
        if (array.shape, array.dtype) != (shapes[name], np.dtype(np.float64)):
            msg = f"{name}: found {array.dtype} {array.shape}, expected float64 {shapes[name]}"
            raise ValueError(msg)
        if not np.isfinite(array).all():
            msg = f"{name}: found values that are not finite"
            raise ValueError(msg)
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    with files.atomic_path(path, 0o600) as beside, beside.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type,unused-ignore]
