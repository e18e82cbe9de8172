"""Keeps compiled functions apart by the sources that they were compiled from.

Numba takes a compiled function for good as long as its own file is unchanged, even when another
file has changed of which functions were compiled into it.
"""

from __future__ import annotations

import atexit
import importlib.util
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cmp_tactile_processing.cache import files

LOGGER = logging.getLogger(__name__)

# Compiled functions of so many versions of the sources are kept; the oldest are removed.
KEPT = 6
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
    """
    root = files.default_cache_dir() / "compiled"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen is not None and Path(chosen).parent != root:
        return
    folder = root / compiled_digest()
    try:
        # What numba keeps is code, which is run.
        if not _is_safely_made_later(folder):
            files.own_contents(folder)
            folder.touch()
            _remove_oldest(folder.parent)
    except PermissionError as error:
        LOGGER.warning("%s: %s: compiled functions are not kept", folder, error)
        folder = Path(tempfile.mkdtemp(prefix="cmp_tactile_"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    except OSError:
        pass  # numba says so itself where it cannot write
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def _is_safely_made_later(folder: Path) -> bool:
    """Whether numba can make this folder when it compiles, and nobody else before it."""
    if folder.exists():
        return False
    parent = next(path for path in folder.parents if path.exists())
    return os.access(parent, os.W_OK | os.X_OK) and not files.why_foreign(parent.stat())


@contextmanager
def when_compiling(report: Callable[[], None]) -> Iterator[None]:
    """Call `report` once, as soon as numba compiles a function that it has in no cache."""
    from numba.core import event

    class Listener(event.Listener):
        reported = False

        def on_start(self, event: Any) -> None:  # noqa: ARG002
            if not self.reported:
                self.reported = True
                report()

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


def _remove_oldest(folder: Path) -> None:
    versions = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in versions[KEPT:]:
        shutil.rmtree(path, ignore_errors=True)
