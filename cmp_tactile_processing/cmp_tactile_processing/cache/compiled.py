"""Keeps compiled functions apart by the sources that they were compiled from.

Numba takes a compiled function for good as long as its own file is unchanged, even when another
file has changed of which functions were compiled into it.
"""

from __future__ import annotations

import atexit
import gc
import importlib.util
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cmp_tactile_processing.cache import files
from cmp_tactile_processing.processes import OnProgress

LOGGER = logging.getLogger(__name__)

# Compiled functions of so many versions of the sources are kept; the oldest are removed.
KEPT = 6
# New objects between two collections of garbage while numba compiles, which makes millions.
SELDOM = 200_000
# Below a prefix of AMENT_PREFIX_PATH: what the build compiled, and of which sources.
INSTALLED = Path("share", "cmp_tactile_processing", "compiled")
DIGEST_FILE = "sources"
COMPILING = "compiling, once per version"
PACKAGES = ("cmp_tactile_processing", "cmp_tactile_simulation")


def source_digest(package: Path) -> str:
    """Digest of the Python sources in a package's folder and below, without its ROS nodes."""
    places = ((path.relative_to(package), path) for path in sorted(package.rglob("*.py")))
    return files.files_digest((p.as_posix(), path) for p, path in places if p.parts[0] != "nodes")[
        :16
    ]


def compiled_digest() -> str:
    """Digest of the sources of all installed packages that compile functions."""
    found = (importlib.util.find_spec(name) for name in PACKAGES)
    return "-".join(
        source_digest(Path(spec.origin).parent) for spec in found if spec and spec.origin
    )


def use_cache_of_these_sources() -> None:
    """Point numba's cache at a folder of the sources of all packages that compile functions.

    One folder for all of them: functions of the processing core are compiled into those of the
    simulator, and a process with the simulator takes what one without it has compiled.
    For what is compiled from now on; a $NUMBA_CACHE_DIR that the user set is left as it is.
    What was compiled when the packages were installed is linked into it: numba writes into each
    folder that it reads from, so that it could not share that of another user.
    """
    root = files.default_cache_dir() / "compiled"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen is not None and Path(chosen).parent != root:
        return
    digest = compiled_digest()
    folder = root / digest
    installed = _installed(digest)
    try:
        # What numba keeps is code, which is run.
        if installed is not None or not _is_safely_made_later(folder):
            files.own_folder(folder)
            folder.touch()
            _remove_oldest(folder.parent)
    except OSError as error:
        # Foreign is what was found without an error of the system.
        if installed is None or error.errno is None:
            LOGGER.warning("%s: %s: compiled functions are not kept", folder, error)
        with suppress(OSError):  # numba says so itself where it cannot write
            folder = Path(tempfile.mkdtemp(prefix="cmp_tactile_"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if installed is not None:
        with suppress(OSError):
            _link_contents(installed, folder)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def _installed(digest: str) -> Path | None:
    """The folder with what was compiled from these sources when they were installed."""
    owner = Path(__file__).stat().st_uid
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        folder = Path(prefix) / INSTALLED
        try:
            status = folder.stat()
            is_of_them = (folder / DIGEST_FILE).read_text(encoding="utf-8") == digest
        except OSError:
            continue
        # Who can write the sources can have any code run, but nobody else.
        if is_of_them and status.st_uid == owner and not status.st_mode & stat.S_IWOTH:
            return folder
    return None


def _link_contents(installed: Path, folder: Path) -> None:
    """Links to all installed files, once; numba puts what is newer in their place."""
    record = folder / DIGEST_FILE
    state = f"{installed} {(installed / DIGEST_FILE).stat().st_mtime_ns}"
    with suppress(OSError):
        if record.read_text(encoding="utf-8") == state:
            return
    for path in installed.glob("*/*.nb[ci]"):
        link = folder / path.parent.name / path.name
        link.parent.mkdir(exist_ok=True)
        link.unlink(missing_ok=True)
        with suppress(FileExistsError):  # another process does the same
            link.symlink_to(path)
    record.write_text(state, encoding="utf-8")


@contextmanager
def installing(prefix: Path) -> Iterator[Path]:
    """The folder below an installation's prefix that numba is to fill, for all users of it.

    It is used from the end of the block on, unless that is left by an exception or the sources
    have changed meanwhile.  What was compiled from others before is removed.
    """
    folder, digest = prefix / INSTALLED, compiled_digest()
    record = folder / DIGEST_FILE
    if not record.exists() or record.read_text(encoding="utf-8") != digest:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    record.unlink(missing_ok=True)
    yield folder
    if compiled_digest() == digest:
        files.write_whole(record, digest)


def _is_safely_made_later(folder: Path) -> bool:
    """Whether numba can make this folder when it compiles, and nobody else before it."""
    if folder.exists():
        return False
    parent = next(path for path in folder.parents if path.exists())
    return os.access(parent, os.W_OK | os.X_OK) and not files.why_foreign(parent.stat())


def log_compiling(what: str, share: float) -> None:
    """An OnProgress with one line in the log."""
    if not share:
        LOGGER.warning("%s: about a minute (`make build` does it for all users)", what)


@contextmanager
def when_compiling(progress: OnProgress = log_compiling) -> Iterator[None]:
    """Report it as soon as numba compiles a function that it has in no cache, and the end of that.

    Garbage is collected seldom from then on: an eighth of the time went into that.
    """
    from numba.core import event

    class Listener(event.Listener):
        reported = False

        def on_start(self, event: Any) -> None:  # noqa: ARG002
            if not self.reported:
                self.reported = True
                gc.set_threshold(SELDOM)
                progress(COMPILING, 0.0)

        def on_end(self, event: Any) -> None:
            pass

    usual, listener = gc.get_threshold(), Listener()
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        gc.set_threshold(*usual)
        if listener.reported:
            progress(COMPILING, 1.0)


def _remove_oldest(folder: Path) -> None:
    versions = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in versions[KEPT:]:
        shutil.rmtree(path, ignore_errors=True)
