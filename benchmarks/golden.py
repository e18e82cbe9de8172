"""Store every array that the software computes for fixed inputs, and compare bit by bit later.

    setup/run python3 benchmarks/golden.py --write golden.npz    # before a change of the code
    setup/run python3 benchmarks/golden.py --check golden.npz    # after it; 1 if anything differs

Inputs: the sample frames (--data), with both gridline detectors; some frames of a packaged scene,
with their pictures and true forces; the bag of this scene, through `cmp_tactile process`. Only
public names are used, so modules may move. Each run makes new caches of models and compiled code.
$NUMBA_CACHE_DIR keeps the compiled code.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

Arrays = dict[str, np.ndarray]

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
DETECTORS = ("saddle_lattice", "contour_stitching")
SCENE = "ball:10mm"
# From the fifth frame on the ball approaches, from the tenth on it touches.
SCENE_FRAMES = 14
REFERENCE_FRAMES = 3
FRAME_NS = 33_333_333
SHOWN = 60


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--write", metavar="FILE", type=Path, help="store the arrays (NPZ)")
    action.add_argument("--check", metavar="FILE", type=Path, help="compare with stored arrays")
    parser.add_argument(
        "--data", type=Path, default=DATA, help="folder of sample frames (default: %(default)s)"
    )
    parser.add_argument(
        "--relative",
        metavar="R",
        type=float,
        default=0.0,
        help="allow differences of R times the largest number of the array (default: 0). Another "
        "processor or compiler version rounds sums differently, by some 1e-12",
    )
    given = parser.parse_args(arguments)
    began = time.monotonic()
    found = collect(given.data)
    print(f"{len(found)} arrays, {sum(a.size for a in found.values())} elements", end=", ")
    print(f"{time.monotonic() - began:.0f} s")
    if given.write:
        np.savez_compressed(given.write, **found)
        return 0
    with np.load(given.check, allow_pickle=False) as kept:
        lines = differences(dict(kept), found, given.relative)
    print("\n".join(lines[:SHOWN]))
    if len(lines) > SHOWN:
        print(f"... and {len(lines) - SHOWN} more")
    print(f"{len(lines)} arrays differ" if lines else "all arrays are equal")
    return 1 if lines else 0


def differences(kept: Arrays, found: Arrays, relative: float = 0.0) -> list[str]:
    """A line for each array that is missing, new or different."""
    lines = [f"{name}: missing" for name in kept.keys() - found.keys()]
    lines += [f"{name}: new" for name in found.keys() - kept.keys()]
    for name in kept.keys() & found.keys():
        if difference := _difference(kept[name], found[name], relative):
            lines.append(f"{name}: {difference}")
    return sorted(lines)


def _difference(kept: np.ndarray, found: np.ndarray, relative: float) -> str:
    if (kept.shape, kept.dtype) != (found.shape, found.dtype):
        return f"{kept.dtype} {kept.shape} became {found.dtype} {found.shape}"
    if kept.tobytes() == found.tobytes():
        return ""
    if kept.dtype.kind not in "fiub":
        differ = kept != found
        before, after = kept[differ][0], found[differ][0]
        return f"{differ.sum()} of {differ.size} elements, {before} became {after}"
    a, b = kept.astype(np.float64), found.astype(np.float64)
    scale = float(np.abs(a[np.isfinite(a)]).max(initial=0.0))
    if np.allclose(b, a, rtol=0, atol=relative * scale, equal_nan=True) and relative:
        return ""
    differ = ~np.isclose(b, a, rtol=0, atol=0, equal_nan=True)
    if not differ.any():
        return "the sign of zeros or the bits of NaN"
    # NaN has no difference from a number.
    off = np.abs(a - b)[differ & np.isfinite(a) & np.isfinite(b)]
    count = f"{differ.sum()} of {differ.size} elements"
    return f"{count}, by {off.max(initial=0.0):.3g} at most (values to {scale:.3g})"


def collect(data: Path) -> Arrays:
    """All arrays by name."""
    found: Arrays = {}
    with tempfile.TemporaryDirectory(prefix="golden_") as folder:
        # Before the suite is imported, which chooses its caches then.
        os.environ["XDG_CACHE_HOME"] = folder
        work = Path(folder)
        for detector in DETECTORS:
            sensor = _with_detector(data / "sensor.yaml", detector, work)
            found |= _named(f"{detector}/still", _stills(sensor, data / "still"))
            found |= _named(f"{detector}/grasp", _grasp(sensor, data / "grasp"))
        found |= _named("scene", _scene(work))
        found |= _named("process", _processed(work))
    return found


def _named(prefix: str, items: Iterator[tuple[str, np.ndarray]]) -> Arrays:
    return {f"{prefix}/{name}": np.array(array) for name, array in items}


def _with_detector(file: Path, detector: str, folder: Path) -> Path:
    mapping = yaml.safe_load(file.read_text(encoding="utf-8"))
    mapping["tracking"] = {**mapping.get("tracking", {}), "detector": detector}
    changed = folder / f"{detector}.yaml"
    changed.write_text(yaml.safe_dump(mapping), encoding="utf-8")
    return changed


def _stills(sensor_file: Path, folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Each for itself, against the nominal surface."""
    from cmp_tactile_processing import Pipeline, SensorDescription, StereoRig

    sensor = SensorDescription.load(sensor_file)
    pipeline, rig = Pipeline(sensor), StereoRig(sensor)
    for path in _images(folder):
        pipeline.reset()
        result = pipeline.process(_read(path))
        yield from flat(result, path.stem)
        yield from flat(rig.triangulate(result.left, result.right), f"{path.stem}/markers_3d")


def _grasp(sensor_file: Path, folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    """One frame after the other, against the first, with slip and what the print showed."""
    from cmp_tactile_processing import Pipeline, SensorDescription

    frames = {path.stem: _read(path) for path in _images(folder)}
    pipeline = Pipeline(SensorDescription.load(sensor_file))
    pipeline.set_reference(list(frames.values())[:REFERENCE_FRAMES])
    yield from flat(pipeline.print_defects, "print_defects")
    for number, (name, frame) in enumerate(frames.items()):
        yield from flat(pipeline.process(frame, (number + 1) * FRAME_NS), name)


def _scene(work: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Pictures and truth, with the true forces, of a packaged scene."""
    folder = work / "pictures"
    _run("simulate", SCENE, "--format", "png", "--frames", SCENE_FRAMES, "--output", folder)
    yield from _files(folder)


def _processed(work: Path) -> Iterator[tuple[str, np.ndarray]]:
    """What the command makes of the scene's bag: arrays and tables."""
    bag, output = work / "bag", work / "processed"
    _run("simulate", SCENE, "--frames", SCENE_FRAMES, "--output", bag)
    _run("process", bag, "--arrays", "--output", output)
    yield from _files(output)


def _run(*arguments: object) -> None:
    command = ["cmp_tactile", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: failed:\n{done.stdout}{done.stderr}")


def _files(folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Contents of the images, arrays and tables in a folder, by their place and name in it."""
    read = {".png": _read_image, ".npz": _read_arrays, ".csv": _read_table}
    for path in sorted(item for item in folder.rglob("*") if item.suffix in read):
        for name, array in read[path.suffix](path):
            yield f"{path.relative_to(folder)}/{name}", array


def _read_image(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    yield "pixels", _read(path)


def _read_arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    with np.load(path, allow_pickle=False) as arrays:
        yield from arrays.items()


def _read_table(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    with path.open(encoding="utf-8", newline="") as file:
        for column in zip(*csv.reader(file), strict=True):
            yield column[0], _column(column[1:])


def _column(cells: Sequence[str]) -> np.ndarray:
    """Numbers where all are, so that a tolerance holds for them; else text."""
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return np.array(cells)


def flat(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays, numbers and texts in nested dataclasses, mappings and sequences, by their path."""
    if isinstance(value, Enum):
        value = value.name
    if value is None or isinstance(value, np.ndarray | np.generic | bool | int | float | str):
        yield name, np.asarray("None" if value is None else value)
        return
    for key, item in _items(value, name):
        yield from flat(item, f"{name}/{key}")


def _items(value: Any, name: str) -> Iterator[tuple[object, Any]]:
    if dataclasses.is_dataclass(value):
        yield from ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
    elif isinstance(value, Mapping):
        yield from value.items()
    elif hasattr(value, "_asdict"):
        yield from value._asdict().items()
    elif isinstance(value, Sequence):
        yield "length", len(value)
        yield from enumerate(value)
    else:
        msg = f"{name}: found {type(value).__name__}, expected arrays and what holds them"
        raise TypeError(msg)


def _images(folder: Path) -> list[Path]:
    images = sorted(folder.glob("*.png"))
    if not images:
        sys.exit(f"{folder}: found no images, expected the sample frames; see --data")
    return images


def _read(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


if __name__ == "__main__":
    sys.exit(main())
