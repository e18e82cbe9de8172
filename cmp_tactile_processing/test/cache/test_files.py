"""Files that several processes share: written whole, locked, with digests that last."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from command_output import output_of

from cmp_tactile_processing.cache.files import (
    atomic_path,
    default_cache_dir,
    expanded_path,
    folder_without_home,
    locked,
    own_folder,
    partial_folder,
    split_paths,
    write_whole,
)
from cmp_tactile_processing.errors import InputError, OutputError


def test_a_file_is_replaced_whole_and_keeps_its_permissions(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    with atomic_path(link) as beside:
        beside.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert target.stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "target"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_after_an_error_the_old_file_stays_and_nothing_else(tmp_path, error):
    (tmp_path / "target").write_text("old")

    def write_half():
        with atomic_path(tmp_path / "target") as beside:
            beside.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(OutputError, match="absent/file: cannot be written: No such file"):
        write_whole(tmp_path / "absent" / "file", "text")


def test_a_partial_folder_is_new_and_leaves_nothing(tmp_path):
    path = tmp_path / "new" / "results"
    killed = path.with_name(".results.partial")
    killed.mkdir(parents=True)
    (killed / "half").touch()
    with partial_folder(path) as beside:
        assert not list(beside.iterdir())
        (beside / "whole").touch()
        with pytest.raises(TimeoutError), partial_folder(path, wait_s=0.0):
            pass
        beside.replace(path)
    with pytest.raises(OutputError, match="new: its disk: No space left"), partial_folder(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "source")
    assert [item.name for item in path.parent.iterdir()] == ["results"]
    assert [item.name for item in path.iterdir()] == ["whole"]


def test_a_lock_is_held_by_one_waited_for_and_removed(tmp_path):
    path = tmp_path / "lock"
    held = threading.Event()

    def hold():
        with locked(path):
            held.set()
            time.sleep(0.2)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    with pytest.raises(TimeoutError, match="lock"), locked(path, 0.0):
        pass
    began = time.monotonic()
    with locked(path):
        assert time.monotonic() - began > 0.05
    thread.join()
    assert not path.exists()


def test_the_lock_of_a_process_that_was_killed_is_free(tmp_path):
    code = (
        "import os, sys; from pathlib import Path;"
        "from cmp_tactile_processing.cache.files import locked\n"
        "with locked(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    child = subprocess.run([sys.executable, "-c", code, str(tmp_path / "lock")], check=False)
    assert child.returncode == -9
    assert (tmp_path / "lock").exists()
    with locked(tmp_path / "lock", 0.0):
        pass


def test_a_folder_that_others_can_write_is_refused(tmp_path):
    own_folder(tmp_path / "new" / "own")
    assert (tmp_path / "new" / "own").stat().st_mode & 0o777 == 0o700
    tmp_path.chmod(0o777)
    with pytest.raises(PermissionError, match="mode 777; use chmod go-w"):
        own_folder(tmp_path)


def test_folder_follows_the_xdg_specification(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "cmp_tactile"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for ignored in ("relative/path", "", None):
        if ignored is None:
            monkeypatch.delenv("XDG_CACHE_HOME")
        else:
            monkeypatch.setenv("XDG_CACHE_HOME", ignored)
        assert default_cache_dir() == tmp_path / "home" / ".cache" / "cmp_tactile"


def test_a_user_without_a_home_has_a_cache_folder_too(monkeypatch, tmp_path):
    """`docker run --user 2000:0` (LMCache 4597): no entry in passwd, and no HOME."""
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 543210)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for planted in (False, True):
        folder_without_home.cache_clear()
        if planted:
            # Another user made a link of that name, to be able to change what this one keeps.
            (tmp_path / f"cmp_tactile_{os.geteuid()}").rmdir()
            (tmp_path / f"cmp_tactile_{os.geteuid()}").symlink_to(tmp_path / "theirs")
            (tmp_path / "theirs").mkdir()
        folder = default_cache_dir()
        assert tmp_path in folder.parents
        assert not folder.parent.is_symlink()
        assert folder.parent.stat().st_mode & 0o777 == 0o700
    folder_without_home.cache_clear()


def test_a_tilde_stands_for_a_home_folder_that_is_there(monkeypatch, tmp_path):
    """Report of the kind: Aider-AI/aider 4078; tried: RuntimeError of a file `~$x.mcap`."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert expanded_path("~/bag") == tmp_path / "bag"
    assert expanded_path("a/~b") == Path("a/~b")
    assert expanded_path("~$x.mcap") == Path("~$x.mcap")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("os.getuid", lambda: 543210)
    with pytest.raises(InputError, match="~/bag: found no home folder"):
        expanded_path("~/bag")


def test_a_colon_separates_paths_or_belongs_to_one_that_is_there(monkeypatch, tmp_path):
    """Reports: EricBerendsen/dvbinspector 58, gitbutlerapp/gitbutler 9204; tried: refused."""
    monkeypatch.chdir(tmp_path)
    for name in ("run 10:30:00", "bag"):
        Path(name).touch()
    for paths in (["run 10:30:00"], ["bag", "run 10:30:00", "grasp", "bag"], ["none", "bag"], []):
        assert split_paths(":".join(paths)) == [Path(path) for path in paths]


def test_importing_writes_nothing(tmp_path):
    code = "import cmp_tactile_processing, os; print(os.environ['NUMBA_CACHE_DIR'])"
    used = output_of(
        "-c", code, XDG_CACHE_HOME=str(tmp_path), NUMBA_CACHE_DIR=None, AMENT_PREFIX_PATH=None
    )
    assert used.startswith(str(tmp_path / "cmp_tactile" / "compiled"))
    assert not list(tmp_path.iterdir())
