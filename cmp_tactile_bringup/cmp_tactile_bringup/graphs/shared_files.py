"""Finds the files that the package installs under share/: graphs and RViz settings."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from cmp_tactile_bringup.errors import GraphError

__all__ = ["find_config", "share_folder"]

PACKAGE = "cmp_tactile_bringup"


def share_folder() -> Path:
    """share/cmp_tactile_bringup, or the source tree where the package is not installed."""
    try:
        return Path(get_package_share_directory(PACKAGE))
    except (LookupError, OSError):
        return Path(__file__).resolve().parents[2]


def find_config(name_or_path: str) -> Path:
    """A graph file by path, or a packaged one by name ("replay"); GraphError for neither."""
    folder = share_folder() / "config"
    # A link that leads nowhere is left of a file that an earlier version installed.
    packaged = {path.stem: path for path in sorted(folder.glob("*.yaml")) if path.is_file()}
    if name_or_path in packaged:
        return packaged[name_or_path]
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path
    msg = f"{name_or_path}: found no such file, expected a path or one of {', '.join(packaged)}"
    raise GraphError(msg)
