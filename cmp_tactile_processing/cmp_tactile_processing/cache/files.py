"""Files that several processes share: the cache folder, atomic writes, locks, digests."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import platformdirs
from filelock import FileLock

from cmp_tactile_processing.errors import InputError, OutputError

READ_BYTES = 1 << 20
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def default_cache_dir() -> Path:
    """$XDG_CACHE_HOME/cmp_tactile, or ~/.cache/cmp_tactile.

    A user without a home (`docker run --user 2000`) has a folder below that of temporary files.
    """
    return _user_folder(platformdirs.user_cache_path)


def config_dir() -> Path:
    """$XDG_CONFIG_HOME/cmp_tactile, or ~/.config/cmp_tactile; without a home as for the cache."""
    return _user_folder(platformdirs.user_config_path)


def _user_folder(path_for: Callable[[str], Path]) -> Path:
    with contextlib.suppress(RuntimeError):
        folder = path_for("cmp_tactile")
        # Old versions return a relative path where there is no home folder.
        if folder.is_absolute():
            return folder
    return folder_without_home() / "cmp_tactile"


def check_free(paths: Iterable[Path], *, overwrite: bool) -> None:
    """Raise OutputError for the first path that is there already, unless it may be replaced."""
    there = next((path for path in paths if path.exists()), None)
    if there is not None and not overwrite:
        msg = f"{there}: exists already; --overwrite replaces it"
        raise OutputError(msg)


def expanded_path(path: str | Path) -> Path:
    """A path with `~` and `~user` replaced by the home folder.

    Office programs name their lock files `~$NAME`: as in a shell, `~` stands for itself before what
    is no user.  Raises InputError for `~` alone where there is no home folder.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        if Path(path).parts[0] == "~":
            msg = f"{path}: found no home folder for ~, expected HOME to be set"
            raise InputError(msg) from None
        return Path(path)


def packaged_files(package: str, pattern: str) -> dict[str, Path]:
    """Files of a package by their name without suffix.  pattern: such as "config/*.yaml".

    They are in the share folder of the installed package, the first in AMENT_PREFIX_PATH first, in
    that of a wheel, or in the checkout.
    """
    above = Path(__file__).resolve().parents
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    # A wheel, as pip installs it into an environment, or by --target into a folder.
    prefixes += [*map(str, above[5:6]), str(above[2])]
    folders = [Path(prefix) / "share" / package for prefix in prefixes if prefix]
    found: dict[str, Path] = {}
    for folder in (*folders, above[3] / package):
        for path in sorted(folder.glob(pattern)):
            found.setdefault(path.stem, path)
    return found


def split_paths(text: str) -> list[Path]:
    """Paths and packaged names, separated as the folders of PATH are.

    A colon may also belong to the name of a file, as in a time of day: then the file is there.
    """
    found = []
    parts = [part for part in text.split(os.pathsep) if part.strip()]
    while parts:
        joined = [os.pathsep.join(parts[: count + 1]) for count in range(len(parts))]
        there = (count for count, path in enumerate(joined, 1) if expanded_path(path).exists())
        count = next(there, 1)
        found.append(expanded_path(joined[count - 1]))
        parts = parts[count:]
    return found


@functools.cache
def folder_without_home() -> Path:
    """A folder of this user's among temporary files, where others may have made one of its name."""
    folder = Path(tempfile.gettempdir()) / f"cmp_tactile_{os.geteuid()}"
    with contextlib.suppress(OSError):
        if not folder.is_symlink():
            own_folder(folder)
            return folder
    return Path(tempfile.mkdtemp(prefix="cmp_tactile_"))


@contextlib.contextmanager
def atomic_path(path: Path, mode: int | None = None) -> Iterator[Path]:
    """An empty file beside `path`, which takes its place once it is written and on the disk.

    Readers see the old or the new file.  After an error the old one stays, and nothing else.
    A link is followed.  mode: permissions; None: those of a file that was there.
    """
    target = path.resolve()
    beside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    beside.touch(exist_ok=False)
    try:
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        if mode is not None:
            beside.chmod(mode)
        elif target.exists():
            shutil.copymode(target, beside)
        beside.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file as `atomic_path` does; text is UTF-8.

    Raises OutputError, and leaves what was there, where the file cannot be written.
    """
    try:
        with atomic_path(path) as beside:
            beside.write_bytes(content.encode() if isinstance(content, str) else content)
    except (OSError, UnicodeEncodeError) as error:
        # Without the name of the file beside it.
        reason = (isinstance(error, OSError) and error.strerror) or error
        msg = f"{path}: cannot be written: {reason}"
        raise OutputError(msg) from None


@contextlib.contextmanager
def partial_folder(path: Path, wait_s: float = math.inf) -> Iterator[Path]:
    """A new folder beside `path` for what is to be there whole or not at all: move it when it is.

    At the end the folder and what is left in it are removed, and at the beginning what a killed
    process left.  Another process that has the folder is waited for, wait_s at most.
    Raises OutputError where the disk is full, other OSErrors as they are.
    """
    beside = path.with_name(f".{path.name}.partial")
    beside.parent.mkdir(parents=True, exist_ok=True)
    with locked(beside.with_suffix(".lock"), wait_s):
        shutil.rmtree(beside, ignore_errors=True)
        try:
            beside.mkdir()
            yield beside
        except OSError as error:
            # A copy to a full disk names what it reads.
            if error.errno not in NO_ROOM:
                raise
            msg = f"{path.parent}: its disk: {error.strerror or error}; nothing was written"
            raise OutputError(msg) from error
        finally:
            shutil.rmtree(beside, ignore_errors=True)


@contextlib.contextmanager
def locked(path: Path, wait_s: float = math.inf) -> Iterator[None]:
    """Hold a lock between processes; it ends with the process, and its file is removed.

    Raises TimeoutError where another process still holds it after wait_s.
    """
    with FileLock(path, timeout=wait_s):
        try:
            yield
        finally:
            # Since 3.20.4 filelock tries again where the file that it has locked is gone.
            path.unlink(missing_ok=True)


def digest(content: str | bytes) -> str:
    """SHA-256 in hexadecimal digits; of text, that of UTF-8."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def files_digest(files: Iterable[tuple[str, Path]]) -> str:
    """SHA-256 over names and contents of files, in their order; files may be large."""
    total = hashlib.sha256()
    for name, path in files:
        total.update(f"{name}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            while data := file.read(READ_BYTES):
                total.update(data)
    return total.hexdigest()


def own_folder(folder: Path) -> None:
    """Make a folder for this user alone.

    Raises OSError where it cannot be made, PermissionError where others can write into it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if reason := why_foreign(folder.stat()):
        raise PermissionError(f"{reason}: not used as a cache")


def why_foreign(status: os.stat_result) -> str:
    """Why a folder is not this user's alone; empty where it is.

    What root owns is trusted, and so is the user's own group, in which nobody else is as a rule.
    """
    if status.st_uid not in (os.geteuid(), 0):
        return f"belongs to user {status.st_uid}"
    others = stat.S_IWOTH | (0 if status.st_gid == os.getegid() else stat.S_IWGRP)
    if status.st_mode & others:
        return f"can be written by others (mode {stat.S_IMODE(status.st_mode):o}; use chmod go-w)"
    return ""
