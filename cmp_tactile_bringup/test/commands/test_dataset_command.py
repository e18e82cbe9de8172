"""`cmp_tactile dataset`: the same files with any number of processes, and after an interruption."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from command_output import run

CONTENT: dict[str, Any] = {
    "version": 1,
    "name": "tiny",
    "sensor": "sample_rig",
    "samples": 130,
    "seed": 4,
    "indenters": [{"type": "sphere", "radius": {"uniform": [0.003, 0.006]}}],
    # At the rim of the patch, and in the middle.
    "place": [{"choice": [0.0, 0.012]}, 0.0],
    "depth": {"uniform": [0.0, 1e-4]},
    "contact_nodes": 12,
    "pixel_samples": 1,
}


@pytest.fixture(scope="module")
def recipe(tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump(CONTENT))
    return path


@pytest.fixture(scope="module")
def made(recipe, tmp_path_factory) -> Path:
    folder: Path = tmp_path_factory.mktemp("data") / "tiny"
    assert run("dataset", str(recipe), "-o", str(folder), "--jobs", "1") == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_several_processes_make_the_same_files(made, recipe, tmp_path, capsys):
    folder = tmp_path / "several"
    assert run("dataset", str(recipe), "-o", str(folder), "--jobs", "2") == 0
    assert contents(folder) == contents(made)
    out, err = capsys.readouterr()
    assert "of 130 samples" in out
    assert "load(" in out
    assert "contact patch" in err


def test_resume_makes_only_what_is_missing(made, recipe, tmp_path):
    folder = tmp_path / "resumed"
    assert run("dataset", str(recipe), "-o", str(folder), "--samples", "64") == 0
    before = {path: path.stat().st_mtime_ns for path in folder.glob("samples_000000.*")}
    assert run("dataset", str(recipe), "-o", str(folder), "--resume") == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    samples = {name: data for name, data in contents(made).items() if name.startswith("samples")}
    assert {name: contents(folder)[name] for name in samples} == samples


def test_a_folder_that_exists_and_a_changed_recipe_are_refused(made, recipe, tmp_path, capsys):
    before = contents(made)
    assert run("dataset", str(recipe), "-o", str(made)) == 1
    changed = tmp_path / "tiny.yaml"
    changed.write_text(yaml.safe_dump({**CONTENT, "depth": 2e-4}))
    assert run("dataset", str(changed), "-o", str(made), "--resume") == 1
    exists, differs = capsys.readouterr().err.strip().splitlines()
    assert "exists already" in exists
    assert "tiny.yaml: depth" in differs
    assert contents(made) == before


def test_recipes_are_listed(capsys):
    assert run("dataset") == 0
    names = [text.split()[0] for text in capsys.readouterr().out.splitlines()]
    assert names == ["objects", "presses", "slides"]


def test_a_wrong_recipe_is_one_line_for_each_error(tmp_path, capsys):
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump({**CONTENT, "depth": {"uniform": [2e-4, 1e-4]}, "frction": 1}))
    assert run("dataset", str(path), "-o", str(tmp_path / "out")) == 1
    first, second = sorted(capsys.readouterr().err.strip().splitlines())
    assert "depth.uniform" in first + second
    assert "did you mean 'friction'" in first + second
    assert not (tmp_path / "out").exists()
