"""Results of cases on disk, each under a hash of all that it follows from.

joblib.Memory looks at the source of the function itself; a case also rests on the modules of this
package that it imports, on the simulator, on scenes and on libraries.
"""

from __future__ import annotations

import ast
import json
import logging
import os
import sys
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.description import packaged_sensors
from cmp_tactile_simulation.recording.run import simulator_version
from cmp_tactile_simulation.scenes.file import packaged_scenes
from paper.experiment import Arrays, Case

LOGGER = logging.getLogger(__name__)

FOLDER = Path(__file__).parent
# Libraries on which the numbers in results depend.
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "scikit-fem")
ABOUT = "about"


@dataclass(frozen=True)
class Kept:
    """A result and what it took, s: on the clock and of the processor."""

    arrays: Arrays
    wall: float
    processor: float


def fingerprint(case: Case, *, fast: bool) -> str:
    """Changes with function, arguments, sources, scenes, sensors, and whether the run is fast."""
    work = case.work
    sources = [_code(path) for path in modules_behind(work.__module__).values()]
    name = f"{work.__module__}.{work.__qualname__}"
    libraries = [_version(library) for library in LIBRARIES]
    facts = repr(case.arguments), fast, simulator_version(), libraries, _descriptions()
    return str(joblib.hash((name, sources, facts)))


def modules_behind(module: str, folder: Path = FOLDER) -> dict[str, Path]:
    """The module and all modules of the package that it imports, also through others; sorted.

    Imports within functions count as well.  folder: of the package.
    """
    found: dict[str, Path] = {}
    ahead = [module]
    while ahead:
        name = ahead.pop()
        path = _file(name, folder) or (_own_file(name) if name == module else None)
        if path is not None and name not in found:
            found[name] = path
            ahead += _imported(ast.parse(path.read_bytes()))
    return dict(sorted(found.items()))


def _file(name: str, folder: Path) -> Path | None:
    package, *parts = name.split(".")
    files = (folder.joinpath(*parts, "__init__.py"), folder.joinpath(*parts).with_suffix(".py"))
    return next((file for file in files if package == "paper" and file.is_file()), None)


def _own_file(name: str) -> Path:
    return Path(str(sys.modules[name].__file__))


def _imported(tree: ast.Module) -> Iterator[str]:
    """Names that may be modules; of `from a import b`, both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _code(path: Path) -> str:
    return _code_of_version(path, path.stat().st_mtime_ns)


@cache
def _code_of_version(path: Path, _changed_ns: int) -> str:
    """Without comments.  Many cases rest on the same file, which may change while they run."""
    return ast.unparse(ast.parse(path.read_bytes()))


def _descriptions() -> list[str]:
    """Hashes of all packaged scenes, their meshes, and sensor descriptions."""
    scenes = packaged_scenes().values()
    meshes = {mesh for scene in scenes for mesh in scene.parent.glob("*.stl")}
    paths = sorted({*scenes, *meshes, *packaged_sensors().values()})
    return [path.name + str(joblib.hash(path.read_bytes())) for path in paths]


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "absent"


class Store:
    """The results in a folder, one file for a case.  fast: those of the fast run."""

    def __init__(self, folder: Path, *, fast: bool = False) -> None:
        self._folder, self._fast = folder, fast

    def path(self, experiment: str, case: Case) -> Path:
        """The file of a case's result."""
        return self._folder / experiment / f"{case.name}.npz"

    def read(self, experiment: str, case: Case) -> Kept | None:
        """What was kept of a case; None where there is nothing, or nothing that still holds."""
        arrays = read(self.path(experiment, case))
        if arrays is None:
            return None
        about = json.loads(str(arrays.pop(ABOUT)))
        if about["fingerprint"] != fingerprint(case, fast=self._fast):
            return None
        return Kept(arrays, about["wall"], about["processor"])

    def load(self, experiment: str, case: Case) -> Arrays:
        """What was written of a case last, whether it still holds or not."""
        arrays = read(self.path(experiment, case)) or {}
        return {name: array for name, array in arrays.items() if name != ABOUT}

    def write(self, experiment: str, case: Case, kept: Kept, found: str) -> None:
        """Keep a result under its fingerprint."""
        about = {"fingerprint": found, "wall": kept.wall, "processor": kept.processor}
        write(self.path(experiment, case), {**kept.arrays, ABOUT: np.array(json.dumps(about))})


def read(path: Path) -> dict[str, Any] | None:
    """Arrays of a file; None, with a line in the log, for one that is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged:
            LOGGER.warning("%s: cannot be used, is computed again: %s is damaged", path, damaged)
            return None
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used, is computed again: %s", path, error)
        return None


def write(path: Path, arrays: Arrays) -> None:
    """Keep arrays; readers see the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}.partial")
    try:
        # numpy.savez takes no array of the name "file".
        with zipfile.ZipFile(beside, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def as_arrays(result: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Numbers and texts as arrays; TypeError for what is neither, nor an array of them."""
    arrays = {name: np.asarray(value) for name, value in result.items()}
    for name, array in arrays.items():
        if array.dtype.hasobject:
            kind = type(result[name]).__name__
            msg = f"{name}: found {kind}, expected a number, a text or an array"
            raise TypeError(msg)
    return arrays
