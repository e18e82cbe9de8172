"""Which version of the sources is at work, told from their content."""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from cmp_tactile_processing.cache.compiled import source_digest

__all__ = ["simulator_version"]

PACKAGES = ("cmp_tactile_simulation", "cmp_tactile_processing")


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
