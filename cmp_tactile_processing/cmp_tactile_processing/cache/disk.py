"""Arrays that take long to compute, kept in the user's cache folder.

Nothing is taken from a cache that another user has written, or may have.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["cached_arrays", "default_cache_dir", "own_contents"]

LOGGER = logging.getLogger(__name__)

Arrays = dict[str, NDArray[np.float64]]


def default_cache_dir() -> Path:
    """$XDG_CACHE_HOME/cmp_tactile, or ~/.cache/cmp_tactile."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The XDG specification tells to ignore a relative path.
    return (base if base.is_absolute() else Path.home() / ".cache") / "cmp_tactile"


def why_foreign(status: os.stat_result) -> str:
    """Why a file or folder is not this user's alone; empty where it is.

    What root owns is trusted, and so is the user's own group, in which nobody else is as a rule.
    """
    if status.st_uid not in (os.geteuid(), 0):
        return f"belongs to user {status.st_uid}"
    others = stat.S_IWOTH | (0 if status.st_gid == os.getegid() else stat.S_IWGRP)
    if status.st_mode & others:
        return f"can be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    return ""


def own_folder(folder: Path) -> str:
    """Make a folder for this user alone, or close one of this user's that others could write.

    Returns why others could write there until now, so that what it holds may be theirs; else
    nothing.  Raises OSError where it cannot be made, PermissionError where another user owns it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    reason = why_foreign(status)
    if reason and status.st_uid != os.geteuid():
        msg = f"{reason}, is not used as a cache"
        raise PermissionError(msg)
    if reason:
        folder.chmod(status.st_mode & 0o700)
    return reason


def own_contents(folder: Path) -> None:
    """As `own_folder`; empty where others may have written anything that it holds."""
    reason = own_folder(folder)
    # Nobody else gets into a folder that was made here.
    if not reason and folder.stat().st_mode & 0o011:
        reason = next(filter(None, map(_why_foreign_file, folder.rglob("*"))), "")
    if reason:
        LOGGER.warning("%s: %s: closed to others, begins empty", folder, reason)
        shutil.rmtree(folder)
        folder.mkdir(mode=0o700)


def _why_foreign_file(path: Path) -> str:
    try:
        reason = why_foreign(path.stat()) if path.is_file() else ""
    except FileNotFoundError:  # renamed or removed meanwhile
        return ""
    return reason and f"{path.name} {reason}"


def cached_arrays(
    folder: Path | None,
    name: str,
    key: Mapping[str, Any],
    shapes: Mapping[str, tuple[int, ...]],
    build: Callable[[], Arrays],
) -> Arrays:
    """The float64 arrays of `build`, from the cache where it holds them for this key.

    key: all that the arrays depend on, in a form that JSON takes.  shapes: of every array.
    A damaged or stale file is built anew with a line in the log; a folder that cannot be
    written costs a warning, not the result.
    """
    text = json.dumps(key, sort_keys=True)
    folder = default_cache_dir() if folder is None else Path(folder)
    path = folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    try:
        if reason := own_folder(folder):
            LOGGER.warning("%s: %s: closed to others", folder, reason)
    except OSError as error:
        LOGGER.warning("%s: not cached, will be built again next time: %s", folder, error)
        return build()
    try:
        return _read(path, shapes)
    except (FileNotFoundError, PermissionError):
        pass  # where it cannot be written either, that is told below
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used, is built anew: %s", path, error)
    arrays = build()
    try:
        _write(path, arrays)
    except OSError as error:
        LOGGER.warning("%s: not cached, will be built again next time: %s", path, error)
    return arrays


def _read(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Arrays:
    with path.open("rb") as file:
        if reason := why_foreign(os.fstat(file.fileno())):
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
    """Write beside the file and rename, so that nobody ever sees half of it."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            with zipfile.ZipFile(file, "w") as archive:
                for name, array in arrays.items():
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(
                            member, np.ascontiguousarray(array), (1, 0), allow_pickle=False
                        )
            file.close()
            Path(file.name).replace(path)
        except BaseException:
            Path(file.name).unlink()
            raise
