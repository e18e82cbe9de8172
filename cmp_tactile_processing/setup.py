import sys
from pathlib import Path

from setuptools import find_packages, setup

package_name = "cmp_tactile_processing"

node_classes = {
    "view_splitter": "ViewSplitter",
    "gridline_tracker": "GridlineTracker",
    "stereo_triangulator": "StereoTriangulator",
    "force_reconstructor": "ForceReconstructor",
    "surface_visualizer": "SurfaceVisualizer",
    "grasp_state": "GraspStateEstimator",
    "wrench_broadcaster": "WrenchBroadcaster",
}

# Only what has no rosdep key; package.xml names the rest.
requirements = [
    "filelock>=3.20.4",
    "platformdirs>=4",
    "pydantic>=2.9",
    "ruamel.yaml>=0.18",
    "scikit-fem>=10",
    "simplejpeg>=1.7",
    "threadpoolctl>=3",
]
excluded = ["test", "test.*"]
index = [
    ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
    (
        "share/ament_index/resource_index/rclcpp_components",
        [f"resource/rclcpp_components/{package_name}"],
    ),
    (f"share/{package_name}", ["package.xml"]),
]
entry_points = {
    "console_scripts": [f"{node} = {package_name}.nodes.{node}:main" for node in node_classes],
    "cmp_tactile_components": [
        f"{package_name}::{cls} = {package_name}.nodes.{node}:{cls}"
        for node, cls in node_classes.items()
    ],
}
if "bdist_wheel" in sys.argv or "dist_info" in sys.argv:
    # A wheel is the core without ROS, and pip installs what it needs.
    requirements += [
        "numba>=0.59",
        "numpy>=1.24",
        "opencv-contrib-python-headless<5",
        "scipy>=1.11",
    ]
    excluded += [
        f"{package_name}.{room}{below}" for room in ("nodes", "ros") for below in ("", ".*")
    ]
    index, entry_points = [], {}

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=excluded),
    package_data={package_name: ["py.typed", "calibration/findings.yaml"]},
    data_files=[
        *index,
        (f"share/{package_name}/config", sorted(map(str, Path("config").glob("*.yaml")))),
    ],
    install_requires=["setuptools", *requirements],
    # What `load` needs; `distributed` brings dask.
    extras_require={"data": ["distributed", "h5netcdf", "pandas", "pyarrow", "xarray"]},
    python_requires=">=3.10",
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="From frames of a continuous marker pattern to grid, surface and force.",
    entry_points=entry_points,
)
