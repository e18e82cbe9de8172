"""Keeps compiled functions apart by the sources that they were compiled from.

Numba takes a compiled function for good as long as its own file is unchanged, even when another
file has changed whose functions were compiled into it.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from cmp_tactile_processing.disk_cache import default_cache_dir
from cmp_tactile_simulation.source_version import source_digest

__all__ = ["use_cache_of_these_sources"]

# Versions of the sources whose compiled functions are kept; the oldest are removed.
KEPT = 6


def use_cache_of_these_sources() -> None:
    """Point numba's cache at a folder of these sources; $NUMBA_CACHE_DIR is left as it is."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    folder = default_cache_dir() / "compiled" / source_digest(Path(__file__).parent)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder.touch()
        _remove_oldest(folder.parent)
    except OSError:
        return  # numba says so itself where it cannot write


def _remove_oldest(folder: Path) -> None:
    versions = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in versions[KEPT:]:
        shutil.rmtree(path, ignore_errors=True)
