"""Which version of the sources is at work, told from their content."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

__all__ = ["simulator_version", "source_digest"]

PACKAGES = ("cmp_tactile_simulation", "cmp_tactile_processing")


def source_digest(package: Path) -> str:
    """Digest of the Python sources in a package's folder and below, without its ROS nodes."""
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package)
        if place.parts[0] != "nodes":
            content.update(f"{place.as_posix()}\0{path.stat().st_size}\0".encode())
            content.update(path.read_bytes())
    return content.hexdigest()[:16]


@lru_cache(maxsize=1)
def simulator_version() -> str:
    """Changes with all that the frames of a scene are computed with, but for the libraries."""
    return "-".join(source_digest(_folder(name)) for name in PACKAGES)


def _folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        msg = f"{package}: found no folder of its sources, expected an installed package"
        raise ModuleNotFoundError(msg)
    return Path(spec.origin).parent
