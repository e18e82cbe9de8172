"""Repair of the build machine's paths that the ROS 2 wheels carry in their CMake files."""

from __future__ import annotations

import re
from pathlib import Path

_PYTHON_INCLUDE = re.compile(r"/opt/python/[^/;\"]+/include/python3\.\d+")
_NUMPY_INCLUDE = re.compile(
    r"/opt/python/[^/;\"]+/lib/python3\.\d+/site-packages/numpy/_core/include"
)
_TINYXML2 = re.compile(r"/usr/lib64/libtinyxml2\.so")


def repair_text(text: str, python_include: str, numpy_include: str, tinyxml2: str) -> str:
    """The text of a CMake file with the build machine's paths replaced by this machine's."""
    text = _NUMPY_INCLUDE.sub(lambda _: numpy_include, text)
    text = _PYTHON_INCLUDE.sub(lambda _: python_include, text)
    return _TINYXML2.sub(lambda _: tinyxml2, text)


def repair_prefix(prefix: Path, python_include: str, numpy_include: str) -> list[Path]:
    """Repair `share/*/cmake/*.cmake` below `prefix`; returns the files that were changed.

    A second call changes nothing. Each file is replaced in one step, so that an interruption
    leaves the old or the new file, never half of one.
    """
    tinyxml2 = _installed_tinyxml2(prefix)
    changed = []
    for path in sorted(prefix.glob("share/*/cmake/*.cmake")):
        before = path.read_text(encoding="utf-8")
        after = repair_text(before, python_include, numpy_include, tinyxml2)
        if after != before:
            temporary = path.with_suffix(".cmake.new")
            temporary.write_text(after, encoding="utf-8")
            temporary.replace(path)
            changed.append(path)
    return changed


def _installed_tinyxml2(prefix: Path) -> str:
    """The library as the wheel bundles it, or its bare name for the linker to find."""
    bundled = sorted(prefix.glob("lib/python3.*/site-packages/*.libs/libtinyxml2*.so*"))
    return str(bundled[0]) if bundled else "tinyxml2"
