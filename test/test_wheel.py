"""The core installs as a wheel into an empty environment, and the README's example runs there.

Reports of the kind, which the packaged sensors of our wheel had too: serpent-tools 271, pyramids
163, matminer 178 (YAML files are there in the checkout and not where a wheel is installed).
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from documents import blocks

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_simulation.recording.truth import read_truth

ROOT = Path(__file__).resolve().parent.parent
CORE = ROOT / "cmp_tactile_processing"
PRESSED = 25
BEFORE = """\
import numpy as np
frames = np.load("frames.npy")
frames_at_rest, frame = frames[:2], frames[2]
"""
AFTER = """\
print(*result.force.wrench[:3], int((result.surface.status == 1).sum()))
"""


def run(*command, **options):
    return subprocess.run(
        list(map(str, command)), check=True, capture_output=True, text=True, **options
    ).stdout


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Python of a new environment in which the wheel is installed, with what it asks for."""
    uv = Path(sys.executable).with_name("uv")
    if not uv.exists():
        pytest.skip("uv is not in this environment")
    folder = tmp_path_factory.mktemp("wheel")
    left_out = shutil.ignore_patterns("build", "*.egg-info", "test", "__pycache__")
    shutil.copytree(CORE, folder / "sources", ignore=left_out)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    run(*pip, "--wheel-dir", folder, folder / "sources")
    (wheel,) = folder.glob("*.whl")
    run(uv, "venv", "--python", sys.executable, folder / "environment")
    python = folder / "environment" / "bin" / "python"
    locked = ROOT / "setup" / "locked-kilted.txt"
    run(uv, "pip", "install", "--python", python, "--constraint", locked, wheel)
    return python


def compiled_for(environment, folder):
    """A cache folder for the wheel with what the checkout's same sources were compiled to.

    Numba names a folder by that of the sources, and checks that those are unchanged.
    """
    (package,) = environment.parents[1].glob("lib/python*/site-packages/cmp_tactile_processing")
    for sources in package.rglob("*/"):
        ours = CORE / package.name / sources.relative_to(package)
        compiled = Path(os.environ["NUMBA_CACHE_DIR"], cache_name(ours))
        if compiled.is_dir():
            shutil.copytree(compiled, folder / cache_name(sources))
    return folder


def cache_name(sources):
    return f"{sources.name}_{hashlib.sha1(str(sources).encode()).hexdigest()}"  # noqa: S324


def test_the_example_of_the_readme_runs_on_the_wheel(environment, packaged_grasp, tmp_path):
    example = blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python")[0]
    shutil.copy(packaged_grasp / "sensor.yaml", tmp_path / "my_sensor.yaml")
    frames = [frame.image for frame in BagReader(packaged_grasp).frames()]
    np.save(tmp_path / "frames.npy", np.stack([*frames[:2], frames[PRESSED]]))
    (tmp_path / "example.py").write_text(BEFORE + example + AFTER, encoding="utf-8")
    # Nothing of this checkout, and no ROS.
    compiled = compiled_for(environment, tmp_path / "compiled")
    kept = {"PATH": os.defpath, "HOME": str(tmp_path), "NUMBA_CACHE_DIR": str(compiled)}
    printed = run(environment, "example.py", cwd=tmp_path, env=kept)
    *force, corners = map(float, printed.split())
    true = read_truth(packaged_grasp).wrench[PRESSED, :3]
    assert corners == 400
    # What the force stage reaches on another mesh than the simulator's, and noise.
    assert force == pytest.approx(true, abs=0.01 * abs(true[2]) + 0.01)


def test_the_wheel_has_the_packaged_sensors_and_no_node(environment, tmp_path):
    code = (
        "from cmp_tactile_processing.sensor.description import packaged_sensors\n"
        "import importlib.util, cmp_tactile_processing\n"
        "print(*packaged_sensors(), importlib.util.find_spec('cmp_tactile_processing.nodes'))"
    )
    printed = run(environment, "-c", code, cwd=tmp_path, env={"PATH": os.defpath})
    *sensors, nodes = printed.split()
    assert sensors == sorted(path.stem for path in (CORE / "config").glob("*.yaml"))
    assert nodes == "None"
