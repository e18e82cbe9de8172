"""The build machine's paths are replaced, wherever they stand, and nothing else is."""

import pytest

from cmp_tactile_setup.virtual_environment import repair_prefix

EXPORT = """\
set_target_properties(std_msgs::std_msgs__rosidl_generator_py PROPERTIES
  INTERFACE_INCLUDE_DIRECTORIES "{python};{numpy}"
)
"""


def export_of_wheel(tag):
    python = f"/opt/python/cp{tag}-cp{tag}"
    version = f"python{tag[0]}.{tag[1:]}"
    return EXPORT.format(
        python=f"{python}/include/{version}",
        numpy=f"{python}/lib/{version}/site-packages/numpy/_core/include",
    )


@pytest.fixture
def prefix(tmp_path):
    for package in ("std_msgs", "fastdds", "rclpy"):
        (tmp_path / "share" / package / "cmake").mkdir(parents=True)
    (tmp_path / "share" / "rclpy" / "cmake" / "rclpyConfig.cmake").write_text("/opt/python/x\n")
    return tmp_path


@pytest.mark.parametrize("tag", ["310", "311", "312", "313"])
def test_include_folders_of_every_wheel(prefix, tag):
    export = prefix / "share" / "std_msgs" / "cmake" / "pyExport.cmake"
    export.write_text(export_of_wheel(tag))
    assert repair_prefix(prefix, "/usr/include/py", "/venv/numpy") == [export]
    assert export.read_text() == EXPORT.format(python="/usr/include/py", numpy="/venv/numpy")
    assert repair_prefix(prefix, "/usr/include/py", "/venv/numpy") == []


def test_a_folder_name_is_not_read_as_a_pattern(prefix):
    export = prefix / "share" / "std_msgs" / "cmake" / "pyExport.cmake"
    export.write_text(export_of_wheel("311"))
    repair_prefix(prefix, r"/home/\1/include", r"/home/\g<0>/numpy")
    assert r'"/home/\1/include;/home/\g<0>/numpy"' in export.read_text()


def test_tinyxml2_is_linked_from_the_wheel_that_bundles_it(prefix):
    targets = prefix / "share" / "fastdds" / "cmake" / "fastdds-shared-targets.cmake"
    targets.write_text('INTERFACE_LINK_LIBRARIES "fastcdr;dl;/usr/lib64/libtinyxml2.so;rt"\n')
    libraries = prefix / "lib" / "python3.11" / "site-packages" / "ros_fastdds.libs"
    libraries.mkdir(parents=True)
    (libraries / "libtinyxml2-1592532c.so.6.0.0").touch()
    repair_prefix(prefix, "/usr/include/py", "/venv/numpy")
    assert f"dl;{libraries / 'libtinyxml2-1592532c.so.6.0.0'};rt" in targets.read_text()
