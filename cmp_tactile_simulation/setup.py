from pathlib import Path

from setuptools import find_packages, setup

package_name = "cmp_tactile_simulation"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={package_name: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (
            "share/ament_index/resource_index/rclcpp_components",
            [f"resource/rclcpp_components/{package_name}"],
        ),
        (f"share/{package_name}", ["package.xml"]),
        (
            f"share/{package_name}/scenes",
            sorted(str(path) for path in Path("scenes").glob("*") if path.is_file()),
        ),
        (
            f"share/{package_name}/recipes",
            sorted(str(path) for path in Path("recipes").glob("*") if path.is_file()),
        ),
        (
            f"share/{package_name}/grasps",
            sorted(str(path) for path in Path("grasps").glob("*") if path.is_file()),
        ),
    ],
    # Only what has no rosdep key; package.xml names the rest.
    install_requires=["setuptools", "h5netcdf", "scikit-fem", "threadpoolctl", "trimesh"],
    extras_require={"mujoco": ["mujoco>=3.3"]},
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Simulator of vision-based tactile sensors: elastomer, contact, mirror optics.",
    entry_points={
        "console_scripts": [
            f"grasp_simulator = {package_name}.nodes.grasp_simulator:main",
        ],
        "cmp_tactile_components": [
            f"{package_name}::GraspSimulator = {package_name}.nodes.grasp_simulator:GraspSimulator",
        ],
        "cmp_tactile_frame_sources": [
            f"simulated = {package_name}.live.source:SimulatedSource.from_options",
        ],
    },
)
