"""`load` opens datasets, tables and arrays, and says in a line what is not ours."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from cmp_tactile_processing import load
from cmp_tactile_processing.errors import InputError

FRAMES, ROWS, COLS = 3, 4, 5


def made_shard(first_sample: int) -> xr.Dataset:
    """Two samples: one of two frames, one of one frame."""
    generator = np.random.default_rng(first_sample)
    grid = ("frame", "row", "col", "component")
    return xr.Dataset(
        {
            "image": (("frame", "y", "x"), generator.integers(0, 255, (FRAMES, 6, 8), np.uint8)),
            "displacement": (
                grid,
                generator.normal(size=(FRAMES, ROWS, COLS, 3)).astype(np.float32),
                {"units": "m"},
            ),
            "wrench": (("frame", "wrench_component"), generator.normal(size=(FRAMES, 6))),
            "indenter": ("frame", ["sphere", "cube", f"bolt_{first_sample}.stl"]),
            "contact": ("frame", [True, False, True]),
        },
        {"sample": ("frame", np.array([0, 0, 1], np.int32) + first_sample)},
        {"title": "presses", "rate_hz": 30.0},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A dataset of two shards."""
    found = tmp_path / "presses"
    found.mkdir()
    (found / "dataset.yaml").write_text("version: 1\n")
    for first in (0, 2):
        made_shard(first).to_netcdf(found / f"samples_{first:06d}.nc", engine="h5netcdf")
    return found


def test_a_dataset_is_opened_lazily_shard_after_shard(folder: Path):
    found = load(folder)
    assert found["sample"].values.tolist() == [0, 0, 1, 2, 2, 3]
    assert all(found[name].chunks for name in ("image", "displacement", "wrench"))
    assert found["displacement"].attrs["units"] == "m"
    assert found.attrs["rate_hz"] == 30.0
    for name in ("image", "displacement", "contact", "indenter"):
        expected = np.concatenate([made_shard(first)[name].values for first in (0, 2)])
        np.testing.assert_array_equal(found[name].values, expected)
        np.testing.assert_array_equal(found[name][4].values, expected[4])
        np.testing.assert_array_equal(found[name][1:5:2].values, expected[1:5:2])
    assert found["contact"].dtype == bool
    table = found["wrench"].to_pandas()
    assert list(table.columns) == ["fx", "fy", "fz", "mx", "my", "mz"]


def test_one_shard_is_opened_by_its_file(folder: Path):
    assert load(folder / "samples_000002.nc")["sample"].values.tolist() == [2, 2, 3]


def test_a_shard_that_is_half_written_is_named(folder: Path):
    shard = folder / "samples_000002.nc"
    shard.write_bytes(shard.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"samples_000002.nc: found no whole netCDF file \("):
        load(folder)


def test_shards_of_two_datasets_are_refused(folder: Path):
    shard = folder / "samples_000002.nc"
    other = made_shard(2).isel(row=slice(2))
    shard.unlink()
    other.to_netcdf(shard, engine="h5netcdf")
    with pytest.raises(
        InputError,
        match=r"samples_000002.nc: displacement: found \(2, 5, 3\), expected \(4, 5, 3\) as in",
    ):
        load(folder)


def test_what_is_not_ours_is_named_with_what_is_expected(tmp_path: Path):
    with pytest.raises(InputError, match="found no such file or folder, expected a folder of"):
        load(tmp_path / "absent")
    with pytest.raises(InputError, match="found an empty folder, expected a folder of"):
        load(tmp_path)
    (tmp_path / "dataset.yaml").touch()
    with pytest.raises(InputError, match=r"found dataset\.yaml without samples_"):
        load(tmp_path)
    other = tmp_path / "other.txt"
    other.touch()
    with pytest.raises(InputError, match=r"found a \.txt file, expected"):
        load(other)
    table = tmp_path / "other.csv"
    table.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"other\.csv: cannot be read as NAME_wrench\.csv"):
        load(table)
    arrays = tmp_path / "other.npz"
    np.savez(arrays, a=1)
    with pytest.raises(InputError, match=r"other\.npz: found .*stamp_ns.*, expected NAME\.npz"):
        load(arrays)
