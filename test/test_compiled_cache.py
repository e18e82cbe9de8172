"""Compiled functions of older sources are not used."""

import os
import subprocess
import sys
from pathlib import Path

from command_output import output_of

import cmp_tactile_processing
import cmp_tactile_simulation
from cmp_tactile_processing.cache.compiled import (
    KEPT,
    _remove_oldest,
    compiled_digest,
    source_digest,
)


def test_the_folder_depends_on_every_source(tmp_path):
    (tmp_path / "kernel.py").write_text("a = 1\n")
    (tmp_path / "caller.py").write_text("from kernel import a\n")
    before = source_digest(tmp_path)
    (tmp_path / "kernel.py").write_text("a = 2\n")
    assert source_digest(tmp_path) != before


def test_numba_uses_it_also_when_it_is_loaded_first(tmp_path):
    code = (
        "import numba, cmp_tactile_simulation.contact.laws as k;print(k.response.stats.cache_path)"
    )
    used = output_of("-c", code, XDG_CACHE_HOME=str(tmp_path), NUMBA_CACHE_DIR=None)
    assert used.startswith(str(tmp_path / "cmp_tactile" / "compiled"))


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
    assert "is not used as a cache: compiled functions are not kept" in run.stderr
    used = Path(run.stdout.strip())
    assert used.parent == tmp_path
    assert used.name.startswith("cmp_tactile_")
    assert not used.exists()


def test_compiling_is_reported_once_and_only_where_something_is_compiled(tmp_path):
    (tmp_path / "kernels.py").write_text(
        "from numba import njit\n"
        "one = njit('f8(f8)', cache=True)(lambda x: x + 1)\n"
        "two = njit('f8(f8)', cache=True)(lambda x: x + 2)\n"
    )
    code = (
        "from cmp_tactile_processing.cache.compiled import when_compiling\n"
        "with when_compiling(lambda: print('compiling')):\n"
        "    import kernels\n"
    )
    path = os.pathsep.join([str(tmp_path), *sys.path])
    cache = str(tmp_path / "cache")
    printed = [output_of("-c", code, NUMBA_CACHE_DIR=cache, PYTHONPATH=path) for _ in range(2)]
    assert printed == ["compiling\n", ""]


def test_a_process_without_the_simulator_compiles_for_one_with_it(tmp_path):
    code = "import os, sys, {}; print(os.environ['NUMBA_CACHE_DIR'], 'numba' in sys.modules)"
    cache = str(tmp_path)
    folders = {
        output_of("-c", code.format(package), XDG_CACHE_HOME=cache, NUMBA_CACHE_DIR=None)
        for package in ("cmp_tactile_processing", "cmp_tactile_simulation")
    }
    assert len(folders) == 1


def test_a_link_to_the_sources_leads_to_the_same_compiled_functions(tmp_path):
    """As a build folder holds it; else everything would be compiled twice."""
    code = (
        "import cmp_tactile_processing.stereo.triangulation as a;"
        "import cmp_tactile_simulation.contact.laws as b;"
        "print(a.__file__, b.__file__)"
    )
    found = set()
    for linked in (False, True):
        places = []
        for package in (cmp_tactile_processing, cmp_tactile_simulation):
            source = Path(package.__path__[0])
            link = tmp_path / source.name
            if linked:
                link.symlink_to(source)
            places.append(str(tmp_path if linked else source.parent))
        found.add(output_of("-c", code, PYTHONPATH=os.pathsep.join(places + sys.path)))
    assert len(found) == 1


def test_old_versions_are_removed(tmp_path):
    for age in range(KEPT + 3):
        folder = tmp_path / f"version{age}"
        folder.mkdir()
        os.utime(folder, (1e9 - age, 1e9 - age))
    _remove_oldest(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {f"version{k}" for k in range(KEPT)}
