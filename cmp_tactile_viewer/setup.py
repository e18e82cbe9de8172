from setuptools import find_packages, setup

package_name = "cmp_tactile_viewer"

node_classes = {"web_viewer": "WebViewer"}

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
    install_requires=["setuptools", "viser>=1.1,<1.2", "websockets"],
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Shows vision-based tactile sensors live in a browser.",
    entry_points={
        "console_scripts": [f"{node} = {package_name}.nodes.{node}:main" for node in node_classes],
        "cmp_tactile_components": [
            f"{package_name}::{cls} = {package_name}.nodes.{node}:{cls}"
            for node, cls in node_classes.items()
        ],
    },
)
