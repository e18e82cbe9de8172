from setuptools import find_packages, setup

package_name = "cmp_tactile_driver"

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
    ],
    # Only what has no rosdep key; package.xml names the rest.
    install_requires=["setuptools", "linuxpy", "mcap", "zstandard"],
    extras_require={"tac3d": ["PyTac3D"]},
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Frame sources and driver nodes of vision-based tactile sensors.",
    entry_points={
        "console_scripts": [
            "camera_driver = cmp_tactile_driver.nodes.camera_driver:main",
            "recorder = cmp_tactile_driver.nodes.recorder:main",
            "replay = cmp_tactile_driver.nodes.replay:main",
            "tac3d_source = cmp_tactile_driver.nodes.tac3d_source:main",
        ],
        "cmp_tactile_frame_sources": [
            f"bag = {package_name}.bags.recording:recorded_source",
            f"images = {package_name}.bags.recording:recorded_source",
            f"v4l2 = {package_name}.v4l2.pair:open_cameras",
            f"video = {package_name}.bags.recording:recorded_source",
        ],
        "cmp_tactile_results": [f"bag = {package_name}.bags.arrays:read_bag"],
        "cmp_tactile_components": [
            f"{package_name}::CameraDriver = {package_name}.nodes.camera_driver:CameraDriver",
            f"{package_name}::Recorder = {package_name}.nodes.recorder:Recorder",
            f"{package_name}::Replay = {package_name}.nodes.replay:Replay",
        ],
    },
)
