"""What results were made from: recording, sensor description, software, options.

The same identity means the same bytes of results, however they are made, on processors of one type.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.jobs import Job, Options
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import digest, files_digest

__all__ = ["content_digest", "difference", "identity_of", "recording_state", "software_version"]

# Packages whose sources the results depend on, and libraries whose numbers or files they contain.
PACKAGES = ("cmp_tactile_processing", "cmp_tactile_driver", "cmp_tactile_simulation")
LIBRARIES = ("numpy", "scipy", "numba", "mcap", "rosbags", "pyarrow")
WORDS = {
    "recording": "another recording",
    "sensor": "another sensor description",
    "software": "another version of the software",
    "options": "other options",
}


def identity_of(job: Job, options: Options, recording: str = "") -> dict[str, Any]:
    """The identity of a job's results, as JSON has it.

    recording: digest of its content; where not known, the whole recording is read for it.
    """
    values = asdict(options)
    values["end_s"] = None if math.isinf(options.end_s) else options.end_s
    return {
        "recording": recording or content_digest(Path(job.source)),
        "sensor": digest(Path(job.sensor).read_bytes()),
        "software": software_version(),
        "options": values,
    }


def difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """In what two identities differ, in words; empty where they do not."""
    told = [words for key, words in WORDS.items() if found.get(key) != expected[key]]
    return " and ".join(told)


def content_digest(source: Path) -> str:
    """SHA-256 over names and contents of a file, or of the files of a folder.

    Raises OutputError where there is nothing to read.
    """
    files = list(_files(source))
    if not files:
        msg = f"{source}: found no file, expected a recording"
        raise OutputError(msg)
    return files_digest(files)


def recording_state(source: Path) -> list[list[str | int]]:
    """Name, size and time of change (ns) of each file: while all stay, so does the content."""
    state: list[list[str | int]] = []
    for name, path in _files(source):
        facts = path.stat()
        state.append([name, facts.st_size, facts.st_mtime_ns])
    return state


@lru_cache(maxsize=1)
def software_version() -> str:
    """Changes with all that results are computed and written with."""
    parts = [f"{name} {_digest(name)}" for name in PACKAGES]
    parts.append(f"cmp_tactile_bringup {_digest('cmp_tactile_bringup')}")
    parts += [f"{name} {_version(name)}" for name in LIBRARIES]
    parts.append(f"opencv {_opencv()}")
    return ", ".join(parts)


def _files(source: Path) -> Iterator[tuple[str, Path]]:
    if source.is_file():
        yield source.name, source
        return
    for path in sorted(source.iterdir()):
        # No recording has hidden files or folders; results may have been put there.
        if path.is_file() and not path.name.startswith("."):
            yield path.name, path


def _digest(package: str) -> str:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        msg = f"{package}: found no folder of its sources, expected an installed package"
        raise ModuleNotFoundError(msg)
    return source_digest(Path(spec.origin).parent)


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "absent"


def _opencv() -> str:
    import cv2

    return cv2.__version__
