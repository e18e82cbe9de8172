"""Results of cases on disk, each under a fingerprint of all that it follows from."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.library import packaged_sensors
from cmp_tactile_simulation.recording.output_folder import simulator_version
from cmp_tactile_simulation.scenes.library import packaged_scenes
from paper.experiment import Arrays, Case
from paper.sources import sources_digest

__all__ = ["Kept", "Store", "as_arrays", "fingerprint"]

LOGGER = logging.getLogger(__name__)

# Libraries whose numbers results contain.
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "scikit-fem")
ABOUT = "about.json"


@dataclass(frozen=True)
class Kept:
    """A result and what it took, s: on the clock and of the processor."""

    arrays: Arrays
    wall: float
    processor: float


def fingerprint(case: Case, *, fast: bool) -> str:
    """Changes with function, arguments, sources, scenes, sensors, and whether the run is fast."""
    work = case.work
    told = (
        f"{work.__module__}.{work.__qualname__}",
        repr(case.arguments),
        fast,
        simulator_version(),
        sources_digest(work),
        _descriptions_digest(),
        [(name, _version(name)) for name in LIBRARIES],
    )
    return hashlib.sha256(repr(told).encode()).hexdigest()[:32]


def _descriptions_digest() -> str:
    """Of all packaged scenes, their meshes, and sensor descriptions."""
    scenes = packaged_scenes().values()
    meshes = {mesh for scene in scenes for mesh in scene.parent.glob("*.stl")}
    digest = hashlib.sha256()
    for path in sorted({*scenes, *meshes, *packaged_sensors().values()}):
        digest.update(f"{path.name}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


class Store:
    """The results in a folder, one file for a case.  fast: those of the fast run."""

    def __init__(self, folder: Path, *, fast: bool = False) -> None:
        self._folder = folder
        self._fast = fast

    def path(self, experiment: str, case: Case) -> Path:
        """The file of a case's result."""
        return self._folder / experiment / f"{case.name}.npz"

    def read(self, experiment: str, case: Case) -> Kept | None:
        """What was kept of a case; None where there is nothing, or nothing that still holds.

        A file that cannot be read is told of in the log.
        """
        path = self.path(experiment, case)
        try:
            found, kept = _read(path)
            return kept if found == fingerprint(case, fast=self._fast) else None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            LOGGER.warning("%s: cannot be used, is computed anew: %s", path, error)
            return None

    def load(self, experiment: str, case: Case) -> Kept:
        """What was written of a case last, whether it still holds or not.

        Raises OSError or ValueError for a file that cannot be read.
        """
        return _read(self.path(experiment, case))[1]

    def write(self, experiment: str, case: Case, kept: Kept, found: str) -> None:
        """Keep a result under its fingerprint; readers see the old file or the new one."""
        about = {"fingerprint": found, "wall": kept.wall, "processor": kept.processor}
        _write(self.path(experiment, case), kept.arrays, about)

    def remove(self, experiment: str, case: Case) -> None:
        """Forget a result."""
        self.path(experiment, case).unlink(missing_ok=True)


def as_arrays(result: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Numbers and texts as arrays.

    Raises TypeError for what is neither, nor an array of them.
    """
    arrays = {}
    for name, value in result.items():
        array = np.asarray(value)
        if array.dtype.hasobject:
            msg = f"{name}: found {type(value).__name__}, expected a number, a text or an array"
            raise TypeError(msg)
        arrays[name] = array
    return arrays


def _read(path: Path) -> tuple[str, Kept]:
    """Fingerprint and result."""
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
        if damaged is not None:
            msg = f"{damaged} is damaged"
            raise ValueError(msg)
        about = json.loads(archive.read(ABOUT))
        arrays = {}
        for name in archive.namelist():
            if name != ABOUT:
                with archive.open(name) as member:
                    array = np.lib.format.read_array(member, allow_pickle=False)
                arrays[name.removesuffix(".npy")] = array
    return about["fingerprint"], Kept(arrays, float(about["wall"]), float(about["processor"]))


def _write(path: Path, arrays: Arrays, about: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".partial")
    try:
        with beside.open("wb") as file:
            with zipfile.ZipFile(file, "w") as archive:
                for key, array in arrays.items():
                    with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
                archive.writestr(ABOUT, json.dumps(about))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "absent"
