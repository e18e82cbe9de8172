from pathlib import Path

from setuptools import find_packages, setup

package_name = "cmp_tactile_processing"

node_classes = {
    "view_splitter": "ViewSplitter",
    "gridline_tracker": "GridlineTracker",
    "stereo_triangulator": "StereoTriangulator",
    "force_reconstructor": "ForceReconstructor",
    "surface_visualizer": "SurfaceVisualizer",
}

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={package_name: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (
            "share/ament_index/resource_index/rclcpp_components",
            [f"resource/rclcpp_components/{package_name}"],
        ),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", sorted(map(str, Path("config").glob("*.yaml")))),
    ],
    # Only what has no rosdep key; package.xml names the rest.
    install_requires=["setuptools", "scikit-fem", "simplejpeg", "threadpoolctl"],
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="From frames of a continuous marker pattern to grid, surface and force.",
    entry_points={
        "console_scripts": [f"{node} = {package_name}.nodes.{node}:main" for node in node_classes],
        "cmp_tactile_components": [
            f"{package_name}::{cls} = {package_name}.nodes.{node}:{cls}"
            for node, cls in node_classes.items()
        ],
    },
)
