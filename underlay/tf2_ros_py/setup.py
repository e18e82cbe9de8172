from setuptools import setup

package_name = "tf2_ros_py"

setup(
    name=package_name,
    version="0.2.0",
    packages=["tf2_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Stand-in for broadcasters, buffer and listener of tf2_ros in Python.",
)
