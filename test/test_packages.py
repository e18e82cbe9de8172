"""What the packages say of themselves is true: dependencies, components, versions, licence."""

import ast
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
PYTHON_PACKAGES = (
    "cmp_tactile_bringup",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_simulation",
)
PACKAGES = (*PYTHON_PACKAGES, "cmp_tactile_msgs")
UNDERLAY = ("composition_interfaces", "cv_bridge", "tf2_msgs", "tf2_ros_py")

ROSDEP_KEYS = {
    "PIL": "python3-pil",
    "cv2": "python3-opencv",
    "ezdxf": "python3-ezdxf",
    "h5py": "python3-h5py",
    "jinja2": "python3-jinja2",
    "jsonschema": "python3-jsonschema",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pandas": "python3-pandas",
    "pytest": "python3-pytest",
    "reportlab": "python3-reportlab",
    "rich": "python3-rich",
    "typer": "python3-typer",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tf2_ros": "tf2_ros_py",
    "xarray": "python3-xarray",
    "yaml": "python3-yaml",
}
# No package of its own is asked for: numba stands on one version of it.
# Version 1 of pydantic, which some systems have, comes without pydantic_core.
COME_WITH = {
    "dask": "distributed",
    "llvmlite": "numba",
    "pydantic": "pydantic_core",
}
# setup.py names these, because rosdep has no key for them.
WITHOUT_ROSDEP_KEY = {
    "linuxpy": "linuxpy",
    "distributed": "distributed",
    "filelock": "filelock",
    "h5netcdf": "h5netcdf",
    "joblib": "joblib",
    "mcap": "mcap",
    "mujoco": "mujoco",
    "platformdirs": "platformdirs",
    "pyarrow": "pyarrow",
    "pydantic_core": "pydantic",
    "ruamel": "ruamel.yaml",
    "simplejpeg": "simplejpeg",
    "skfem": "scikit-fem",
    "threadpoolctl": "threadpoolctl",
    "trimesh": "trimesh",
    "zstandard": "zstandard",
}
# The simulator is used through the driver and through the command of cmp_tactile_bringup.
WITHOUT_COMMANDS = {"cmp_tactile_simulation"}
# In test/plugins, for the tests of all packages.
SHARED_BY_TESTS = {path.stem for path in (ROOT / "test" / "plugins").iterdir()}
# Used by name, in launch files and by those who open the RViz configuration.
NEEDED_WITHOUT_IMPORT = {"ros2launch", "rviz2"}


def manifest(package):
    folder = ROOT / package if (ROOT / package).is_dir() else ROOT / "underlay" / package
    return ET.parse(folder / "package.xml").getroot()  # noqa: S314


def dependencies(package, *tags):
    return {str(element.text) for tag in tags for element in manifest(package).findall(tag)}


def imported(folder):
    """Top-level names that the Python files below a folder import, but for the standard library."""
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            found = {name.partition(".")[0] for name in names} - sys.stdlib_module_names
            yield from (COME_WITH.get(name, name) for name in found)


def keys_of_imports(package, *folders):
    names = {name for folder in folders for name in imported(ROOT / package / folder)}
    names -= {package, *WITHOUT_ROSDEP_KEY, *SHARED_BY_TESTS}
    return {ROSDEP_KEYS.get(name, name) for name in names}


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_what_a_package_imports_is_what_it_depends_on(package):
    declared = dependencies(package, "depend", "exec_depend") - NEEDED_WITHOUT_IMPORT
    assert keys_of_imports(package, package, "launch") == declared
    of_tests = dependencies(package, "depend", "exec_depend", "test_depend")
    assert keys_of_imports(package, "test") <= of_tests
    setup = (ROOT / package / "setup.py").read_text(encoding="utf-8")
    for name in set(imported(ROOT / package / package)) & WITHOUT_ROSDEP_KEY.keys():
        assert re.search(rf'"{WITHOUT_ROSDEP_KEY[name]}["<>=]', setup)


def test_the_command_is_installed_where_a_sourced_workspace_finds_it():
    """Beside its entry point, which `ros2 run` finds: colcon puts `bin` into PATH, not `lib`."""
    folder = ROOT / "cmp_tactile_bringup"
    setup = (folder / "setup.py").read_text(encoding="utf-8")
    assert '("bin", ["bin/cmp_tactile"])' in setup
    assert '"cmp_tactile = cmp_tactile_bringup.command:main"' in setup
    command = [str(folder / "bin" / "cmp_tactile"), "--help"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "Usage: cmp_tactile [OPTIONS] COMMAND" in done.stdout


def requirements(name):
    lines = (ROOT / "setup" / name).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_setup_installs_the_libraries_that_a_package_imports(package):
    """With the wheels, of a version that was tested, and beside a ROS 2 that is there."""
    libraries = {name for name, key in ROSDEP_KEYS.items() if key.startswith("python3-")}
    wanted = {*imported(ROOT / package / package)} & (libraries | WITHOUT_ROSDEP_KEY.keys())
    lines = [line.split("# import ") for line in requirements("requirements-with-ros.txt")]
    beside = {module: re.split(r"[<>=\s]", line, maxsplit=1)[0] for line, module in lines}
    assert wanted <= beside.keys()
    pinned = {line.partition("==")[0] for line in requirements("requirements-libraries.txt")}
    assert {beside[module] for module in wanted} <= pinned


@pytest.mark.parametrize("package", [*PACKAGES, *UNDERLAY])
def test_manifest(package):
    root = manifest(package)
    assert root.get("format") == "3"
    assert root.findtext("name") == package
    assert root.findtext("version") == manifest("cmp_tactile_msgs").findtext("version")
    assert root.findtext("license") == "Apache-2.0"
    maintainer = root.find("maintainer")
    assert maintainer is not None
    assert maintainer.get("email") == "maintainers@cmp-tactile.example"
    named = [(item.tag, item.text) for item in root if item.tag.endswith("depend")]
    assert len(set(named)) == len(named)
    if package in PYTHON_PACKAGES:
        installed = importlib.metadata.distribution(package.replace("_", "-"))
        assert installed.version == root.findtext("version")


def test_the_citation_names_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == manifest("cmp_tactile_msgs").findtext("version")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{citation['version']}]" in changes


def component_entry_points():
    found = importlib.metadata.entry_points(group="cmp_tactile_components")
    return sorted(found, key=lambda entry_point: entry_point.name)


@pytest.mark.parametrize("package", ["cmp_tactile_driver", "cmp_tactile_processing"])
def test_the_ament_index_lists_the_components(package):
    """As `ros2 component types` reads it: a line each, the class in front of the semicolon."""
    resource = ROOT / package / "resource" / "rclcpp_components" / package
    listed = [line.partition(";")[0] for line in resource.read_text().splitlines()]
    names = {e.name for e in component_entry_points() if e.name.startswith(f"{package}::")}
    assert sorted(listed) == sorted(names)
    assert listed


@pytest.mark.ros
@pytest.mark.parametrize("package", sorted(set(PYTHON_PACKAGES) - WITHOUT_COMMANDS))
def test_every_command_has_a_main(package):
    distribution = importlib.metadata.distribution(package.replace("_", "-"))
    commands = [e for e in distribution.entry_points if e.group == "console_scripts"]
    assert commands
    for command in commands:
        assert callable(command.load()), command.name
