from setuptools import setup

package_name = "cv_bridge"

setup(
    name=package_name,
    version="0.2.0",
    packages=[package_name],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="cmp_tactile maintainers",
    maintainer_email="maintainers@cmp-tactile.example",
    license="Apache-2.0",
    description="Stand-in for the Python class CvBridge of cv_bridge.",
)
