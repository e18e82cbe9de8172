"""The disk cache: hits, keys, damaged files, folders that cannot be written, two at once."""

from __future__ import annotations

import logging
import os
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cmp_tactile_processing.cache.arrays import cached_arrays

KEY = {"version": 1, "size": [0.02, 0.03]}
SHAPES = {"first": (3, 2), "second": (4,)}


class Builder:
    """Counts how often the arrays are built."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"first": np.arange(6.0).reshape(3, 2), "second": np.linspace(0, 1, 4)}


def get(folder, build, key=KEY):
    arrays = cached_arrays(folder, "model", key, SHAPES, build)
    for name, expected in Builder()().items():
        np.testing.assert_array_equal(arrays[name], expected)


def only_file(folder) -> Path:
    (path,) = folder.iterdir()
    return path


def test_second_time_is_a_hit_and_another_key_is_another_file(tmp_path, caplog):
    build = Builder()
    get(tmp_path, build)
    get(tmp_path, build)
    assert build.calls == 1
    assert only_file(tmp_path).suffix == ".npz"
    get(tmp_path, build, {**KEY, "version": 2})
    assert build.calls == 2
    assert len(list(tmp_path.iterdir())) == 2
    assert not caplog.records


def truncate(path):
    path.write_bytes(path.read_bytes()[:-40])


def empty(path):
    path.write_bytes(b"")


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("first.npy").header_offset
    content[start + 30 + len("first.npy") + 20 + 128 + 5] ^= 1  # within the array's data
    path.write_bytes(bytes(content))


def other_shape(path):
    np.savez(path, first=np.zeros((3, 3)), second=np.zeros(4))


def huge_header(path):
    """A header that asks for 8 PB: must be refused before memory is allocated."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("first.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
        np.lib.format.write_array_header_1_0(member, header)


def pickled(path):
    np.savez(path, first=np.array([{}], dtype=object), second=np.zeros(4))


def not_finite(path):
    np.savez(path, first=np.full((3, 2), np.nan), second=np.zeros(4))


@pytest.mark.parametrize(
    "damage", [truncate, empty, flip_a_bit, other_shape, huge_header, pickled, not_finite]
)
def test_damaged_file_is_built_again_with_one_line(tmp_path, caplog, damage):
    build = Builder()
    get(tmp_path, build)
    damage(only_file(tmp_path))
    get(tmp_path, build)
    assert build.calls == 2
    (record,) = caplog.records
    assert "is built again" in record.getMessage()
    assert str(only_file(tmp_path)) in record.getMessage()
    get(tmp_path, build)
    assert build.calls == 2


def test_folder_that_cannot_be_written_costs_one_warning(tmp_path, caplog):
    """A file where the folder should be: even root cannot write there."""
    (tmp_path / "file").write_text("")
    build = Builder()
    get(tmp_path / "file" / "cache", build)
    assert build.calls == 1
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "not cached" in record.getMessage()


def test_a_folder_that_others_can_write_is_not_used(tmp_path, caplog):
    tmp_path.chmod(0o777)
    build = Builder()
    for _ in range(2):
        get(tmp_path, build)
    assert build.calls == 2
    assert "can be written by others (mode 777" in caplog.records[0].getMessage()
    assert not list(tmp_path.iterdir())


def as_another_user(monkeypatch):
    """What this user owns seems to be another's from now on."""
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1234)
    owner = SimpleNamespace(st_uid=os.getuid() + 1, st_mode=0o40755, st_gid=0)
    monkeypatch.setattr(Path, "stat", lambda *_, **__: owner)


def test_a_folder_of_another_user_is_not_used(tmp_path, caplog, monkeypatch):
    build = Builder()
    get(tmp_path, build)
    with monkeypatch.context() as patch:
        as_another_user(patch)
        get(tmp_path, build)
    (record,) = caplog.records
    assert f"belongs to user {os.getuid() + 1}: not used as a cache" in record.getMessage()
    assert build.calls == 2


def test_of_two_at_once_one_builds_while_the_other_waits(tmp_path):
    build = Builder()

    def build_slowly():
        time.sleep(0.3)
        return build()

    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(get, tmp_path, build_slowly) for _ in range(2)]:
            future.result()
    assert build.calls == 1
    assert only_file(tmp_path).suffix == ".npz"
