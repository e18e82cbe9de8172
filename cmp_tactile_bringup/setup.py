from pathlib import Path

from setuptools import find_packages, setup

package_name = "cmp_tactile_bringup"


def shared_files(*folders: str) -> list[tuple[str, list[str]]]:
    """Every file below the folders, to be installed under share/ with its folder kept."""
    files = [f for folder in folders for f in sorted(Path(folder).rglob("*")) if f.is_file()]
    parents = sorted({f.parent for f in files})
    return [
        (f"share/{package_name}/{parent.as_posix()}", [str(f) for f in files if f.parent == parent])
        for parent in parents
    ]


setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={package_name: ["py.typed", "report/templates/*.jinja"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        # Of executables in lib, `ros2 run` alone knows; colcon puts this folder into PATH.
        ("bin", ["bin/cmp_tactile"]),
        *shared_files("launch", "config", "rviz", "foxglove"),
    ],
    install_requires=["setuptools", "jinja2", "joblib>=1.4", "mcap", "typer>=0.9"],
    # What `cmp_tactile process` needs for --scheduler and --parquet, and `export`.
    extras_require={
        "cluster": ["distributed"],
        "export": ["h5netcdf", "pyarrow"],
        "parquet": ["pyarrow"],
        "video": ["av"],
    },
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Component container, launch files, configuration and the cmp_tactile command.",
    entry_points={
        "console_scripts": [
            "component_container = cmp_tactile_bringup.container.executables:component_container",
            "standalone = cmp_tactile_bringup.container.executables:standalone",
            "cmp_tactile = cmp_tactile_bringup.command:main",
        ],
    },
)
