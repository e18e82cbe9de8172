"""Shards of a dataset: their truth, the same bytes however they are made, resuming, failures."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import xarray
import yaml

from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.sensor.description import load_sensor, write_sensor_description
from cmp_tactile_simulation.dataset import shards
from cmp_tactile_simulation.dataset.recipe import Recipe, read_recipe
from cmp_tactile_simulation.dataset.shards import begin, left_out, make_shard

HISTORY = [
    {"name": "touch", "frames": 1, "depth": 0.0},
    {"name": "press", "frames": 2},
    {"name": "slide", "frames": 2, "shear": 1.0},
    {"name": "lift", "frames": 1, "lift": 0.0005},
]
FRICTION = 0.4
# Forces are written as float32.
RELATIVE = 1e-6


@pytest.fixture(scope="module")
def recipe(small_scene, tmp_path_factory) -> Recipe:
    """Histories of a small sensor; one in a few leaves the patch of contact nodes."""
    folder = tmp_path_factory.mktemp("recipe")
    write_sensor_description(folder / "small.yaml", small_scene().sensor)
    content: dict[str, Any] = {
        "version": 1,
        "name": "small",
        "sensor": "small.yaml",
        "samples": 12,
        "seed": 1,
        "indenters": [{"type": "sphere", "radius": {"uniform": [0.006, 0.009]}}],
        "friction": FRICTION,
        "place": [{"choice": [0.0, 0.0, 0.0, 0.0115]}, 0.0],
        "depth": {"uniform": [2e-4, 5e-4]},
        "shear": 4e-4,
        "shear_deg": {"uniform": [-180, 180]},
        "history": HISTORY,
        "contact_nodes": 14,
        "pixel_samples": 1,
    }
    path = folder / "small_recipe.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return read_recipe(path)


@pytest.fixture(scope="module")
def made(recipe, tmp_path_factory) -> Path:
    """The whole dataset, its shards made from the last to the first."""
    folder = tmp_path_factory.mktemp("data") / "small"
    for shard in reversed(begin(recipe, folder, resume=False)):
        make_shard(recipe, shard)
    return folder


def read(folder: Path) -> xarray.Dataset:
    files = sorted(folder.glob("samples_*.nc"))
    return xarray.concat([xarray.open_dataset(file) for file in files], "frame", join="override")


def test_frames_are_those_of_the_history(made, recipe):
    data = read(made)
    count = recipe.samples - len(list(left_out(made)))
    assert data.sizes["frame"] == count * recipe.frames
    phases = ["touch", "press", "press", "slide", "slide", "lift"]
    assert data.phase.values.tolist() == count * phases
    assert data.step.values.tolist() == count * list(range(6))
    assert data.image.dtype == np.uint8
    assert data.image.shape[1:] == (192, 256)


def test_truth_obeys_mechanics(made):
    data = read(made)
    total = data.node_force.sum(("node_row", "node_col")).values
    wrench = data.wrench.values
    np.testing.assert_allclose(total, wrench[:, :3], atol=RELATIVE * np.abs(wrench).max() * 10)
    slide = data.isel(frame=data.phase.values == "slide")
    force = slide.wrench.values
    assert (force[:, 2] < 0).all()
    # Coulomb: normals of nodes lean by up to a / R = 0.2 from the mean one, in all directions.
    assert (slide.traction_ratio.values <= FRICTION * (1 + 0.2**2 / 2)).all()
    assert slide.traction_ratio.values.max() > 0.95 * FRICTION
    lifted = data.isel(frame=data.phase.values == "lift")
    assert not lifted.wrench.values.any()
    assert not lifted.contact.values.any()
    # The pose says how deep the ball is: all that touches lies on it.
    pressed = data.isel(frame=data.phase.values == "press")
    assert (pressed.displacement.min(("row", "col"))[:, 2] < 0).all()


def test_the_same_bytes_whenever_a_shard_is_made(made, recipe, tmp_path):
    folder = tmp_path / "again"
    for shard in begin(recipe, folder, resume=False):
        make_shard(recipe, shard)
    names = sorted(path.name for path in made.iterdir())
    assert sorted(path.name for path in folder.iterdir()) == names
    for name in names:
        assert (folder / name).read_bytes() == (made / name).read_bytes(), name


def test_what_cannot_be_pressed_is_left_out_and_named(made, recipe):
    missing = dict(left_out(made))
    assert 0 < len(missing) < recipe.samples
    assert all("contact patch" in why for why in missing.values())
    kept = set(read(made).sample.values.tolist())
    assert kept == set(range(recipe.samples)) - set(missing)


def test_resume_makes_what_is_missing_and_no_more(made, recipe, tmp_path):
    folder = tmp_path / "resumed"
    first, *others = begin(recipe, folder, resume=False)
    make_shard(recipe, first)
    assert begin(recipe, folder, resume=True) == others
    (folder / others[0].file.name).write_bytes(b"killed while it was written")
    for shard in begin(recipe, folder, resume=True):
        make_shard(recipe, shard)
    for path in made.glob("samples_*"):
        assert (folder / path.name).read_bytes() == path.read_bytes()
    assert begin(recipe, folder, resume=True) == []


def test_a_dataset_grows_with_more_samples_of_its_recipe(recipe, tmp_path):
    def with_samples(count: int) -> Recipe:
        content = {**recipe.file.content, "samples": count}
        return replace(recipe, samples=count, file=replace(recipe.file, content=content))

    folder = tmp_path / "grown"
    (only,) = begin(with_samples(1), folder, resume=False)
    make_shard(with_samples(1), only)
    larger = begin(with_samples(12), folder, resume=True)
    # The file of sample 0 has room for more.
    assert larger[0].first == 0
    with pytest.raises(OutputError, match="samples"):
        begin(with_samples(2), folder, resume=True)


def test_folders_that_cannot_be_used_are_named(made, recipe, tmp_path):
    with pytest.raises(OutputError, match="exists already"):
        begin(recipe, made, resume=False)
    with pytest.raises(OutputError, match=r"recipe\.yaml"):
        begin(recipe, tmp_path, resume=True)
    other = replace(recipe, file=replace(recipe.file, content={**recipe.file.content, "seed": 9}))
    with pytest.raises(OutputError, match="seed"):
        begin(other, made, resume=True)


def test_a_changed_mesh_or_sensor_is_refused(recipe, tmp_path):
    def read_again() -> Recipe:
        return read_recipe(tmp_path / "meshes.yaml")

    shutil.copy(recipe.sensor_file.path, tmp_path / "small.yaml")
    trimesh.creation.box((4e-3, 4e-3, 2e-3)).export(tmp_path / "box.stl")
    content = {**recipe.file.content, "indenters": [{"meshes": "box.stl"}]}
    (tmp_path / "meshes.yaml").write_text(yaml.safe_dump(content))
    folder = tmp_path / "data"
    shards_before = begin(read_again(), folder, resume=False)
    assert begin(read_again(), folder, resume=True) == shards_before
    trimesh.creation.box((4e-3, 5e-3, 2e-3)).export(tmp_path / "box.stl")
    with pytest.raises(OutputError, match=r"meshes\.yaml: box\.stl: found another content"):
        begin(read_again(), folder, resume=True)
    sensor = (tmp_path / "small.yaml").read_text()
    (tmp_path / "small.yaml").write_text(sensor.replace("young: ", "young: 1"))
    with pytest.raises(OutputError, match=r"meshes\.yaml: box\.stl, small\.yaml: found another"):
        begin(read_again(), folder, resume=True)


def test_a_full_disk_leaves_what_was_written(recipe, tmp_path, monkeypatch):
    folder = tmp_path / "full"
    first, *others = begin(recipe, folder, resume=False)
    for shard in others:
        make_shard(recipe, shard)

    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "write_samples", no_room)
    with pytest.raises(OutputError, match=r"No space left on device; --resume"):
        make_shard(recipe, first)
    assert not first.file.exists()
    assert not first.table.exists()
    assert not list(folder.glob("*partial*"))
    assert begin(recipe, folder, resume=True) == [first]
    assert load_sensor(str(folder / "sensor_000.yaml")).pattern == recipe.sensor.pattern
