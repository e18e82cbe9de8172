"""Compiled functions that give the same bits in every process: taken from numba's cache.

A process that has just compiled functions with fast mathematics may run other copies of them than
those that it caches, and its results differ in the seventh digit from those of all processes that
come after it.  So compiling is left to a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import cmp_tactile_processing
from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.terminal.machine import processor_name
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import digest, locked
from cmp_tactile_processing.python_command import python_command

__all__ = ["compile_elsewhere"]

SAID = "compiling, once per version of the software"


def compile_elsewhere(sensor: Path, tell: Callable[[str, float], None]) -> None:
    """Have all that the pipeline of a sensor runs compiled by another process, if it is not yet.

    Raises OutputError where that process fails.
    """
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return  # nothing is kept: numba says so itself
    done = folder / f"pipeline-{_what_is_compiled()}"
    if done.exists():
        return
    with locked(done.with_suffix(".lock")):
        if not done.exists():
            tell(SAID, 0.0)
            command = python_command("cmp_tactile_processing.prepare", str(sensor))
            found = subprocess.run(command, capture_output=True, text=True, check=False)
            if found.returncode:
                msg = f"{sensor}: the pipeline cannot be built: {found.stderr[-1000:]}"
                raise OutputError(msg)
            done.touch()


def _what_is_compiled() -> str:
    """Changes with sources, Python and type of processor, for each of which numba compiles anew."""
    sources = source_digest(Path(cmp_tactile_processing.__file__).parent)
    facts = f"{sources}\0{sys.version}\0{processor_name()}\0{version('numba')}"
    return digest(facts)[:16]
