"""Compiled functions of older sources are not used."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_output import output_of

from cmp_tactile_processing.cache.compiled import (
    DIGEST_FILE,
    INSTALLED,
    compiled_digest,
    installing,
)

# Says "compiled" where the function has to be compiled for a value of this type.
KERNEL = """
from numba import njit

two = njit(cache=True)(lambda x: x + 1)
one = njit(cache=True)(lambda x: two(x))
"""
CALL = """
import sys
import cmp_tactile_processing
from cmp_tactile_processing.cache.compiled import when_compiling
sys.path.insert(0, {folder!r})
with when_compiling(lambda _, share: share or print("compiled")):
    from kernels import one
    one({value})
"""


def test_a_cache_of_another_user_is_not_used(tmp_path):
    """What numba keeps is code."""
    code = (
        "import os; os.geteuid = lambda: os.getuid() + 1;"
        "import cmp_tactile_processing; print(os.environ['NUMBA_CACHE_DIR'])"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    if os.getuid() == 0:
        # What root owns is trusted.
        compiled = tmp_path / "cmp_tactile" / "compiled"
        compiled.mkdir(parents=True)
        folder = compiled_digest()
        (compiled / folder).mkdir()
        os.chown(compiled / folder, 1234, 1234)
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert "not used as a cache" in run.stderr
    used = Path(run.stdout.strip())
    assert used.parent == tmp_path
    assert used.name.startswith("cmp_tactile_")
    assert not used.exists()


@pytest.fixture
def call(tmp_path):
    """Calls a compiled function in a process: "compiled" where it had to be compiled, or nothing.

    As a user with this cache folder, of packages that are installed below this prefix.
    """
    (tmp_path / "kernels.py").write_text(KERNEL)

    def called(cache, prefix="", value="1.0", **variables):
        # A process would take the NUMBA_CACHE_DIR of this one for the user's choice.
        user = {"XDG_CACHE_HOME": str(cache), "AMENT_PREFIX_PATH": str(prefix)}
        code = CALL.format(folder=str(tmp_path), value=value)
        return output_of("-c", code, **user, **{"NUMBA_CACHE_DIR": None, **variables}).strip()

    return called


@pytest.fixture
def installed(call, tmp_path):
    """A prefix with that function compiled into it, as the build does."""
    prefix = tmp_path / "prefix"
    with installing(prefix) as folder:
        assert call(tmp_path / "builder", NUMBA_CACHE_DIR=str(folder)) == "compiled"
    return prefix


def test_every_user_takes_what_was_compiled_when_the_packages_were_installed(
    call, installed, tmp_path
):
    """Another user, a container or a home that cannot be written compiled for minutes, in silence.

    numba/numba 4032 and 7248, LMCache 4597: in a container, as a user without a home, numba finds
    no folder for its cache.
    """
    assert call(tmp_path / "one") == "compiled"
    for cache in (tmp_path / "two", "/proc/cannot/be/written"):
        assert call(cache, installed) == ""
    before = {path: path.read_bytes() for path in installed.rglob("*") if path.is_file()}
    # What is newer goes into the user's own folder, beside what came with the packages.
    assert call(tmp_path / "two", installed, value="1") == "compiled"
    for value in ("1", "1.0"):
        assert call(tmp_path / "two", installed, value=value) == ""
    assert {path: path.read_bytes() for path in installed.rglob("*") if path.is_file()} == before


def test_what_is_half_installed_of_other_sources_or_writable_by_all_is_not_used(
    call, installed, tmp_path
):
    record = installed / INSTALLED / DIGEST_FILE
    digest = record.read_text()
    record.write_text("of other sources")
    assert call(tmp_path / "one", installed) == "compiled"
    record.unlink()
    assert call(tmp_path / "two", installed) == "compiled"
    record.write_text(digest)
    record.parent.chmod(0o777)
    assert call(tmp_path / "three", installed) == "compiled"


def test_what_was_compiled_from_other_sources_is_removed_before(tmp_path, monkeypatch):
    """A caller in an unchanged file would keep the old code of the function that has changed."""
    for digest, left in (("one", 0), ("one", 1), ("other", 0)):
        monkeypatch.setattr(
            "cmp_tactile_processing.cache.compiled.compiled_digest", lambda d=digest: d
        )
        with installing(tmp_path) as folder:
            assert len(list(folder.iterdir())) == left
            (folder / "kernel.nbi").touch()
    digests = iter(("other", "edited meanwhile"))
    monkeypatch.setattr(
        "cmp_tactile_processing.cache.compiled.compiled_digest", lambda: next(digests)
    )
    with installing(tmp_path):
        pass
    assert not (tmp_path / INSTALLED / DIGEST_FILE).exists()
