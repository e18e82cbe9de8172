"""Any result of cmp_tactile as an xarray dataset: simulated datasets, tables and arrays, bags.

Bags are read by packages above this one: an entry point of the group `cmp_tactile_results` loads to
a function from a path and the name of a sensor to `Arrays`, or to None for what is not its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import InputError, shortened
from cmp_tactile_processing.force.advice import UNUSABLE

if TYPE_CHECKING:
    import xarray as xr

ENTRY_POINT_GROUP = "cmp_tactile_results"
EXPECTED = (
    "a folder of `cmp_tactile dataset`, results of `cmp_tactile process` (NAME_wrench.csv, "
    "NAME_wrench.parquet, NAME.npz or their folder), or a bag with topics of cmp_tactile"
)
DATASET_FILE, SHARDS, TABLE = "dataset.yaml", "samples_*.nc", "_wrench.csv"
FRAMES_PER_CHUNK = 64
"""Frames that are read at once when values are asked for."""
WRENCH_COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
LABELS = {
    "component": ("x", "y", "z"),
    "wrench_component": WRENCH_COMPONENTS,
    "view": ("left", "right"),
    "pixel": ("u", "v"),
}
STAMP = {"units": "ns", "long_name": "stamp of the camera frame"}
Arrays = tuple[Mapping[str, Any], NDArray[np.int64], Mapping[str, Any]]
"""Arrays by names of VARIABLES, the first axis along the frames; stamps; attributes.

An image may be a `Stored`, which is read when it is used.
"""
_MARKERS, _NODES = ("row", "col"), ("node_row", "node_col")
_GEL = "gel"


@dataclass(frozen=True)
class Variable:
    """dims: of one frame.  frame: in which the components are."""

    dims: tuple[str, ...]
    units: str
    long_name: str
    frame: str = ""

    @property
    def attrs(self) -> dict[str, str]:
        """The attributes of the variable in a dataset."""
        named = {"units": self.units, "long_name": self.long_name, "frame": self.frame}
        return {key: text for key, text in named.items() if text}


VARIABLES = {
    "image": Variable(("y", "x"), "1", "camera frame"),
    "has_image": Variable((), "1", "1: the frame has an image; 0: the image is lost, and black"),
    "position": Variable((*_MARKERS, "component"), "m", "measured markers", _GEL),
    "displacement": Variable((*_MARKERS, "component"), "m", "displacement of the markers", _GEL),
    "corners_px": Variable(
        ("view", *_MARKERS, "pixel"), "px", "measured markers in the whole camera frame"
    ),
    "node_position": Variable((*_NODES, "component"), "m", "force nodes, gel at rest", _GEL),
    "node_force": Variable((*_NODES, "component"), "N", "force on the gel at each node", _GEL),
    "traction": Variable((*_NODES, "component"), "Pa", "node_force over the node's area", _GEL),
    "contact": Variable(_NODES, "1", "1: the node is in contact"),
    "wrench": Variable(("wrench_component",), "N, N m", "force and moment on the gel", _GEL),
    "wrench_std": Variable(("wrench_component",), "N, N m", "standard deviation of wrench", _GEL),
    "contact_area": Variable((), "m2", "area of all contacts"),
    "slip_state": Variable((), "1", "0 unknown, 1 no contact, 2 stick, 3 incipient, 4 full"),
    "slip_ratio": Variable((), "1", "share of the contact that slides"),
    "traction_ratio": Variable((), "1", "tangential over normal force"),
    "friction_coefficient": Variable((), "1", "friction of what slides"),
    "friction_std": Variable((), "1", "standard deviation of friction_coefficient"),
    "flags": Variable((), "1", "sum of the bits FLAG_* of ForceField.msg"),
    "usable": Variable((), "1", "1: no flag forbids the use of the force"),
    "stamp_fault": Variable((), "", "what is wrong with stamp and picture"),
    "pose": Variable(("pose_row", "pose_col"), "1, m", "T_gel_indenter", _GEL),
    "friction": Variable((), "1", "true coefficient of Coulomb"),
    "indenter": Variable((), "", "shape, or file of the mesh"),
    "sensor": Variable((), "", "file of the sensor description that made the frame"),
}


class Stored(Protocol):
    """An array on the disk, the first axis along the frames."""

    shape: tuple[int, ...]
    dtype: Any

    def read(self, numbers: NDArray[np.intp]) -> NDArray[Any]:
        """The values of the frames with these numbers."""


def load(path: str | Path, sensor: str = "", images: str | Path = "") -> xr.Dataset:
    """Open any result of cmp_tactile as an xarray dataset with a dimension `frame`.

    path: a folder of `cmp_tactile dataset`, results of `cmp_tactile process` (their folder,
    NAME.mcap, NAME_wrench.csv, NAME_wrench.parquet or NAME.npz), or any bag with our topics.
    sensor: namespace of its topics, if a bag has those of several sensors.
    images: the bag that results were computed from; its images join the frames of their stamps.
    Images, and all of a dataset, are read when they are used.  Names, dimensions and units are
    those of docs/datasets.md.  Raises CmpTactileError where there is nothing of ours.
    """
    place = expanded_path(path)
    if not place.exists():
        msg = f"{path}: found no such file or folder, expected {EXPECTED}"
        raise InputError(msg)
    found = _dataset(place)
    if found is None:
        found = _results(place)
    if found is None:
        found = _opened_elsewhere(place, sensor)
    if found is None:
        msg = f"{path}: found {_found_there(place)}, expected {EXPECTED}"
        raise InputError(msg)
    return _with_images(found, load(images, sensor), f"{images}") if images else found


def _with_images(dataset: xr.Dataset, recording: xr.Dataset, label: str) -> xr.Dataset:
    """The images of a recording at the stamps of the dataset; where there is none, see has_image.

    Raises InputError for the recording of something else.
    """
    stamps = recording["stamp_ns"].values
    order = np.argsort(stamps, kind="stable")
    at = np.searchsorted(stamps, dataset["stamp_ns"].values, sorter=order)
    at = order[np.minimum(at, len(stamps) - 1)]
    there = stamps[at] == dataset["stamp_ns"].values
    if "image" not in recording or not there.any():
        msg = f"{label}: found no image at any stamp of the results, expected their recording"
        raise InputError(msg)
    image, known = recording["image"][at], VARIABLES["has_image"]
    if "has_image" in recording:
        there &= recording["has_image"].values[at].astype(bool)
    has_image = ("frame", there.astype(np.uint8), known.attrs)
    joined: xr.Dataset = dataset.assign(image=image.variable, has_image=has_image)
    return joined


def _labelled(read: Arrays) -> xr.Dataset:
    import xarray as xr

    arrays, stamp_ns, attrs = dict(read[0]), read[1], dict(read[2])
    if "flags" in arrays and "usable" not in arrays:
        arrays["usable"] = ((arrays["flags"] & int(UNUSABLE)) == 0).astype(np.uint8)
    if "node_position" in arrays:
        # The same in all frames.
        arrays["node_position"] = arrays["node_position"][0]
    if "image" in arrays:
        arrays["image"] = _lazy(arrays["image"])
    data = {}
    for name, values in arrays.items():
        known, over = VARIABLES[name], () if name == "node_position" else ("frame",)
        dims = (*over, *known.dims, "channel")[: values.ndim]
        data[name] = (dims, values, known.attrs)
    found = xr.Dataset(data, {"stamp_ns": ("frame", stamp_ns, STAMP)}, attrs)
    return _with_labels(found)


def _lazy(stored: Stored) -> Any:
    """A dask array."""
    import dask.array

    # It states no types.
    from_array: Any = dask.array.from_array
    chunks = (FRAMES_PER_CHUNK, *stored.shape[1:])
    return from_array(_Sliced(stored), chunks, name=False, asarray=False)


class _Sliced:
    """Slices of what is stored, as dask takes them: reads no more frames than are asked for."""

    def __init__(self, stored: Stored) -> None:
        self._stored, self.shape, self.dtype = stored, stored.shape, stored.dtype
        self.ndim = len(self.shape)

    def __getitem__(self, key: Any) -> NDArray[Any]:
        frames, *rest = key if isinstance(key, tuple) else (key,)
        # dask may ask for one frame by its number.
        numbers = np.arange(self.shape[0])[frames]
        values = self._stored.read(numbers.reshape(-1)).reshape((*numbers.shape, *self.shape[1:]))
        return np.asarray(values[(slice(None),) * numbers.ndim + tuple(rest)])


def _with_labels(dataset: xr.Dataset) -> xr.Dataset:
    missing = {
        name: list(labels)
        for name, labels in LABELS.items()
        if name in dataset.dims and name not in dataset.coords
    }
    found: xr.Dataset = dataset.assign_coords(missing)
    return found


def _dataset(place: Path) -> xr.Dataset | None:
    """The shards of a dataset folder one after the other, or one shard."""
    if place.suffix == ".nc":
        return _shard(place)
    if not (place / DATASET_FILE).is_file():
        return None
    shards = sorted(place.glob(SHARDS))
    if not shards:
        msg = f"{place}: found {DATASET_FILE} without {SHARDS}, expected at least one shard"
        raise InputError(msg)
    first = _shard(shards[0])
    # h5netcdf takes 0.2 s to open a file with all its variables: the others are like the first.
    frames = [0, *np.cumsum([_frames_of(path, first) for path in shards])]
    data = {
        name: (item.dims, _lazy(_Shards(str(name), shards, frames, item)), item.attrs)
        for name, item in first.variables.items()
        if item.dims[:1] == ("frame",)
    }
    found: xr.Dataset = first.drop_dims("frame").assign(data)
    dataset: xr.Dataset = found.set_coords([name for name in first.coords if name in data])
    return dataset


class _Shards:
    """A variable of all shards; each file is open while it is read."""

    def __init__(
        self, name: str, paths: Sequence[Path], frames: Sequence[int], like: xr.Variable
    ) -> None:
        """frames: before each shard, and of all.  like: the variable in the first."""
        self._name, self._paths, self._frames = name, paths, np.array(frames)
        self.shape = (int(frames[-1]), *like.shape[1:])
        # The texts of another shard may be longer.
        self.dtype = np.dtype(object) if like.dtype.kind in "OSU" else like.dtype

    def read(self, numbers: NDArray[np.intp]) -> NDArray[Any]:
        import h5py

        values = np.empty((len(numbers), *self.shape[1:]), self.dtype)
        shards = np.searchsorted(self._frames, numbers, "right") - 1
        for shard in np.unique(shards):
            there = shards == shard
            wanted = numbers[there] - self._frames[shard]
            part = slice(int(wanted.min()), int(wanted.max()) + 1)
            with h5py.File(self._paths[shard], "r") as file:
                stored = file[self._name]
                stored = stored.asstr() if self.dtype.kind == "O" else stored
                values[there] = stored[part][wanted - part.start]
        return values


def _frames_of(path: Path, first: xr.Dataset) -> int:
    """How many are in a shard; InputError where its variables are not those of the first."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            found = {name: file[str(name)].shape for name in first.variables}
    except (OSError, KeyError) as error:
        raise _not_whole(path, error) from None
    for name, item in first.variables.items():
        own = item.dims[:1] == ("frame",)
        if found[name][own:] != item.shape[own:]:
            expected = f"{item.shape[own:]} as in {first.encoding['source']}"
            msg = f"{path}: {name}: found {found[name][own:]}, expected {expected}"
            raise InputError(msg)
    return int(next(found[name][0] for name, v in first.variables.items() if v.dims[0] == "frame"))


def _shard(path: Path) -> xr.Dataset:
    import xarray as xr

    try:
        found = xr.open_dataset(path, engine="h5netcdf", chunks={"frame": FRAMES_PER_CHUNK})
    except (OSError, ValueError, KeyError) as error:
        raise _not_whole(path, error) from None
    if "frame" not in found.dims:
        msg = f"{path}: found the dimensions {', '.join(map(str, found.dims))}, expected frame"
        raise InputError(msg)
    return _with_labels(found)


def _not_whole(path: Path, error: Exception) -> InputError:
    reason = shortened(str(error).partition("\n")[0])
    msg = f"{path}: found no whole netCDF file ({reason}), expected a shard as it was written"
    return InputError(msg)


def _results(place: Path) -> xr.Dataset | None:
    """Results of `cmp_tactile process`: a folder, a table or arrays."""
    if place.suffix == ".npz":
        return _arrays(place)
    if place.suffix in {".csv", ".parquet"}:
        return _table(place)
    tables = sorted(place.glob(f"*{TABLE}")) if place.is_dir() else []
    if len(tables) > 1:
        names = ", ".join(table.name.removesuffix(TABLE) for table in tables)
        msg = f"{place}: found the results of {names}, expected one: name the file NAME.mcap"
        raise InputError(msg)
    if not tables:
        return None
    table = _table(tables[0])
    bag = place / f"{tables[0].name.removesuffix(TABLE)}.mcap"
    found = _opened_elsewhere(bag, "") if bag.is_file() else None
    if found is None:
        return table
    # The frames of a bag are in the order of their stamps.
    table = table.isel(frame=np.argsort(table["stamp_ns"].values, kind="stable"))
    if not np.array_equal(table["stamp_ns"], found["stamp_ns"]):
        return found
    judged: xr.Dataset = found.assign({name: table[name] for name in ("usable", "stamp_fault")})
    return judged


def _table(path: Path) -> xr.Dataset:
    import pandas as pd

    columns = [f"{name}_N{'m' if name[0] == 'm' else ''}" for name in WRENCH_COMPONENTS]
    try:
        read = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
        plain = {
            "contact_area": read["contact_area_m2"],
            **{name: read[name] for name in VARIABLES if name in read and name != "stamp_fault"},
            "stamp_fault": read["stamp_fault"].astype(object).fillna(""),
            "usable": read["usable"].astype(np.uint8),
        }
        arrays = {
            "wrench": read[columns].to_numpy(),
            "wrench_std": read[[f"std_{name}" for name in columns]].to_numpy(),
            **{name: values.to_numpy() for name, values in plain.items()},
        }
        stamps = read["stamp_ns"].to_numpy()
    except (KeyError, ValueError, OSError) as error:
        reason = shortened(str(error).partition("\n")[0])
        msg = f"{path}: cannot be read as NAME{TABLE} of `cmp_tactile process`: {reason}"
        raise InputError(msg) from None
    return _labelled((arrays, stamps, {"source": str(path)}))


def _arrays(path: Path) -> xr.Dataset:
    """NAME.npz of `cmp_tactile process --arrays`."""
    try:
        with np.load(path) as file:
            stamps, variances = file["stamp_ns"], file["wrench_covariance"]
            count, cols = len(stamps), _node_cols(file["node_position"])
            arrays = {
                **{name: file[name] for name in VARIABLES if name in file},
                "node_position": file["node_position"].reshape(count, -1, cols, 3),
                "node_force": file["force"].reshape(count, -1, cols, 3),
                "contact": file["contact"].reshape(count, -1, cols),
                "wrench_std": np.sqrt(np.diagonal(variances, axis1=1, axis2=2)),
            }
    except (KeyError, ValueError, OSError) as error:
        msg = f"{path}: found {error}, expected NAME.npz of `cmp_tactile process --arrays`"
        raise InputError(msg) from None
    return _labelled((arrays, stamps, {"source": str(path)}))


def _node_cols(position: NDArray[Any]) -> int:
    """Nodes in a row, of their positions (frames, nodes, 3) row by row: x falls at its end."""
    ends = np.flatnonzero(np.diff(position[:1, :, 0]) < 0)
    return int(ends[0]) + 1 if len(ends) else int(position.shape[1])


def _opened_elsewhere(place: Path, sensor: str) -> xr.Dataset | None:
    for point in entry_points(group=ENTRY_POINT_GROUP):
        read: Arrays | None = point.load()(place, sensor)
        if read is not None:
            return _labelled(read)
    return None


def _found_there(place: Path) -> str:
    if place.is_file():
        return f"a {place.suffix or 'nameless'} file"
    names = sorted(item.name for item in place.iterdir() if not item.name.startswith("."))
    return shortened(", ".join(names)) or "an empty folder"
