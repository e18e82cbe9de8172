"""The files of a dataset: shards of samples as netCDF 4 (HDF5), and what is beside them.

A shard is written whole or not at all, and the same samples give the same bytes.
"""

from __future__ import annotations

import csv
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np

from cmp_tactile_processing.cache.files import atomic_path, digest, write_whole
from cmp_tactile_processing.errors import CmpTactileError, OutputError
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml
from cmp_tactile_processing.tables import DATASET_FILE, LABELS, VARIABLES
from cmp_tactile_simulation.dataset.recipe import Recipe
from cmp_tactile_simulation.dataset.sampling import Sample, Sampler, described, draw, variant_file
from cmp_tactile_simulation.simulator import SimulatedFrame

FORMAT_VERSION = 1
RECIPE_FILE, LEFT_OUT = "recipe.yaml", "left_out"
# Of a shard, which is some 20 MB then, unless one sample has more.
SHARD_FRAMES = 32
# Noise leaves deflate nothing to find beyond its first level.
COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": False}
COORDINATES = ("sample", "step", "phase", "stamp_ns")


@dataclass(frozen=True)
class Shard:
    """A part of a dataset: samples first to end - 1, in `folder`."""

    folder: Path
    first: int
    end: int

    def __str__(self) -> str:
        return str(self.file)

    @property
    def is_complete(self) -> bool:
        """Whether all of its samples were made or left out."""
        return self.table.exists() and len(_rows(self.table)) == self.end - self.first

    @property
    def file(self) -> Path:
        """The samples; absent where all were left out."""
        return self.folder / f"samples_{self.first:06d}.nc"

    @property
    def table(self) -> Path:
        """What was drawn, and which samples were left out and why; written last."""
        return self.folder / f"samples_{self.first:06d}.csv"


def shards_of(recipe: Recipe, folder: Path) -> list[Shard]:
    """All parts of the dataset."""
    each = max(1, SHARD_FRAMES // recipe.frames)
    firsts = range(0, recipe.samples, each)
    return [Shard(folder, first, min(first + each, recipe.samples)) for first in firsts]


def sensor_file(variant: int) -> str:
    """Name of a variant's sensor description."""
    return f"sensor_{variant:03d}.yaml"


def begin(recipe: Recipe, folder: Path, *, resume: bool) -> list[Shard]:
    """Make the dataset's folder; the shards that are still to be made.

    resume: go on in a folder of the same recipe.
    Raises OutputError for a folder that exists, or is of another recipe, sensor or mesh.
    """
    text = dump_yaml(recipe.file.content)
    if not resume:
        if folder.exists() and any(folder.iterdir()):
            expected = "expected a new folder, or --resume to go on with it"
            msg = f"{folder}: exists already, {expected}"
            raise OutputError(msg)
        folder.mkdir(parents=True, exist_ok=True)
        for variant in range(recipe.variants):
            write_whole(folder / sensor_file(variant), dump_yaml(variant_file(recipe, variant)))
        write_whole(folder / "sensor.yaml", recipe.sensor_file.text)
        write_whole(folder / RECIPE_FILE, text)
        write_whole(folder / DATASET_FILE, dump_yaml(_facts(recipe)))
    else:
        _check_same(recipe, folder)
    return [shard for shard in shards_of(recipe, folder) if not shard.is_complete]


def _facts(recipe: Recipe) -> dict[str, Any]:
    return {
        "version": FORMAT_VERSION,
        "name": recipe.name,
        "title": recipe.title or recipe.name,
        "samples": recipe.samples,
        "frames_per_sample": recipe.frames,
        "sensor": recipe.sensor.name,
        "variants": recipe.variants,
        "rate_hz": recipe.rate,
        "digests": _digests(recipe),
    }


def _digests(recipe: Recipe) -> dict[str, str]:
    """Of the sensor's content and of each mesh, by the names that the recipe has for them."""
    folder = recipe.file.path.parent
    meshes = sorted({path for item in recipe.indenters for path in item.meshes})
    sensor = {str(recipe.file.content["sensor"]): digest(dump_yaml(recipe.sensor_file.content))}
    return sensor | {relpath(path, folder): digest(path.read_bytes()) for path in meshes}


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in {*before, *now} if before.get(key) != now.get(key))


def _check_same(recipe: Recipe, folder: Path) -> None:
    """OutputError where the folder is none of this recipe."""
    path = folder / RECIPE_FILE
    if not path.is_file():
        msg = f"{folder}: found no {RECIPE_FILE}, expected the folder of a dataset to resume"
        raise OutputError(msg)
    before, now = read_yaml(path).content, recipe.file.content
    changed = _changed(before, now)
    # More samples of the same recipe are the same samples and some more.
    if changed and (changed != ["samples"] or recipe.samples < before["samples"]):
        msg = (
            f"{recipe.file.path}: {', '.join(changed)}: found another value than in {path}, "
            "expected the recipe that the dataset was begun with; make a new folder"
        )
        raise OutputError(msg)
    digests = read_yaml(folder / DATASET_FILE).content.get("digests", {})
    if other := _changed(digests, _digests(recipe)):
        msg = (
            f"{recipe.file.path}: {', '.join(other)}: found another content than when the dataset "
            "was begun, expected the same files; restore them, or make a new folder"
        )
        raise OutputError(msg)
    if changed:
        write_whole(path, dump_yaml(now))
        write_whole(folder / DATASET_FILE, dump_yaml(_facts(recipe)))


def make_shard(recipe: Recipe, shard: Shard) -> int:
    """Simulate the samples of a shard and write them; returns how many were left out.

    Raises OutputError where the files cannot be written.
    """
    sampler = Sampler(recipe)
    rows: list[dict[str, Any]] = []
    made: list[tuple[Sample, list[SimulatedFrame]]] = []
    samples = [draw(recipe, number) for number in range(shard.first, shard.end)]
    # Each variant's simulator is made once.
    for sample in sorted(samples, key=lambda item: item.variant):
        why = ""
        try:
            made.append((sample, sampler.frames(sample)))
        except CmpTactileError as error:
            why = str(error)
        rows.append({**described(sample), LEFT_OUT: why})
    made.sort(key=lambda item: item[0].number)
    rows.sort(key=lambda row: int(row["sample"]))
    try:
        if made:
            with atomic_path(shard.file) as beside:
                write_samples(beside, recipe, made)
        with atomic_path(shard.table) as beside:
            _write_table(beside, rows)
    except OSError as error:
        msg = f"{shard.folder}: cannot be written: {error.strerror or error}; --resume goes on"
        raise OutputError(msg) from error
    return sum(bool(row[LEFT_OUT]) for row in rows)


def write_samples(
    path: Path, recipe: Recipe, made: Sequence[tuple[Sample, list[SimulatedFrame]]]
) -> None:
    """Write the frames of some samples as one netCDF file."""
    # Without xarray, which takes as long to be imported as 20 samples take to be made.
    import h5netcdf
    import h5py

    images = [frame.image for _, found in made for frame in found]
    with h5netcdf.File(path, "w") as file:
        for name, (dims, array, attributes) in _arrays(made).items():
            for dimension, size in zip(dims, array.shape, strict=True):
                file.dimensions.setdefault(dimension, size)
            packed = {**COMPRESSION, "chunks": (1, *array.shape[1:])} if array.ndim > 1 else {}
            values = array.astype(h5py.string_dtype()) if array.dtype.kind == "U" else array
            variable = file.create_variable(name, dims, values.dtype, data=values, **packed)
            variable.attrs.update(attributes)
        height, width = images[0].shape
        file.dimensions.update(y=height, x=width)
        image = file.create_variable(
            "image", ("frame", "y", "x"), np.uint8, chunks=(1, height, width), compression="gzip"
        )
        image.attrs.update(VARIABLES["image"].attrs)
        facts = {"title": recipe.title or recipe.name, "rate_hz": recipe.rate, "frame": "gel"}
        coordinates = " ".join(COORDINATES)
        file.attrs.update({**facts, "sensor": recipe.sensor.name, "coordinates": coordinates})
    # Camera noise leaves no words to find: entropy coding alone is as small, and much quicker.
    with h5py.File(path, "a") as file:
        chunks = file["image"].id
        for number, picture in enumerate(images):
            deflate = zlib.compressobj(strategy=zlib.Z_HUFFMAN_ONLY)
            chunk = deflate.compress(np.ascontiguousarray(picture).data) + deflate.flush()
            chunks.write_direct_chunk((number, 0, 0), chunk)


def _arrays(made: Sequence[tuple[Sample, list[SimulatedFrame]]]) -> dict[str, Any]:
    """Of each variable but the image: dimensions, values and attributes."""
    frames = [(sample, frame) for sample, found in made for frame in found]
    rows = [_values(sample, frame) for sample, frame in frames]
    arrays: dict[str, Any] = {
        name: (
            ("frame", *VARIABLES[name].dims),
            np.stack([row[name] for row in rows]),
            VARIABLES[name].attrs,
        )
        for name in rows[0]
    }
    # As xarray knows flags.
    arrays["contact"][2]["dtype"] = "bool"
    steps = [step for _, found in made for step in range(len(found))]
    arrays["sample"] = ("frame",), np.array([sample.number for sample, _ in frames], np.int32), {}
    arrays["step"] = ("frame",), np.array(steps, np.int32), {}
    arrays["phase"] = ("frame",), np.array([frame.phase for _, frame in frames]), {}
    arrays["stamp_ns"] = ("frame",), np.array([frame.stamp_ns for _, frame in frames], np.int64), {}
    arrays |= {name: ((name,), np.array(labels), {}) for name, labels in LABELS.items()}
    return arrays


def _values(sample: Sample, frame: SimulatedFrame) -> dict[str, Any]:
    """Of a frame, by names of VARIABLES."""
    surface, force, truth = frame.surface, frame.force, frame.truth
    nodes = force.rows, force.cols
    unseen = np.full((*surface.shape.corners, 2), np.nan)
    seen = {name: grid.corners_frame for name, grid in frame.grids.items()}
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame.pose.rotation, frame.pose.position
    values: dict[str, Any] = {
        "position": surface.position,
        "displacement": truth.displacement,
        "corners_px": np.stack([seen.get(view, unseen) for view in LABELS["view"]]),
        "node_position": force.position.reshape(*nodes, 3),
        "node_force": force.force.reshape(*nodes, 3),
        "traction": truth.traction.reshape(*nodes, 3),
        "wrench": force.wrench,
        "contact_area": force.contact_area,
        "slip_ratio": force.slip.slip_ratio,
        "traction_ratio": force.slip.traction_ratio,
        "pose": pose,
        "friction": sample.friction,
    }
    return {
        **{name: np.asarray(value, np.float32) for name, value in values.items()},
        "contact": truth.contact.reshape(nodes).astype(np.int8),
        "slip_state": np.int8(force.slip_state),
        "indenter": sample.indenter,
        "sensor": sensor_file(sample.variant),
    }


def _write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A row for each sample; columns in the order in which they first come."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def left_out(folder: Path) -> Iterator[tuple[int, str]]:
    """Numbers of the samples of a dataset that were left out, and why."""
    for table in sorted(folder.glob("samples_*.csv")):
        yield from ((int(row["sample"]), row[LEFT_OUT]) for row in _rows(table) if row[LEFT_OUT])


def _rows(table: Path) -> list[dict[str, str]]:
    with table.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
