"""What results are made from: recording, sensor description, software, options.

The same means the same bytes of results, however they are made, on processors of one type.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.offline.jobs import Job, Options
from cmp_tactile_bringup.terminal.output import installed_version
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import digest, files_digest

# The results depend on the sources of these packages, and contain what these libraries make.
PACKAGES = (
    "cmp_tactile_processing",
    "cmp_tactile_driver",
    "cmp_tactile_simulation",
    "cmp_tactile_bringup",
)
LIBRARIES = ("numpy", "scipy", "numba", "mcap", "rosbags", "pyarrow")


def made_from(
    job: Job, options: Options, record: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """What results are made from, as JSON has it: the identity and the state of the recording.

    record: of an earlier run; while names, sizes and times of the recording's files are those that
    it has, its digest of their content is taken for theirs.
    """
    # Before the content is read: a change meanwhile must not count as what was read.
    files = dict(_files_of(Path(job.source)))
    state = [[name, p.stat().st_size, p.stat().st_mtime_ns] for name, p in files.items()]
    if record is not None and record["recording_state"] == state:
        content = record["identity"].get("recording")
    else:
        content = files_digest(files.items())
    values = asdict(options)
    values["end"] = None if math.isinf(options.end) else options.end
    identity = {
        "recording": content,
        "sensor": digest(Path(job.sensor).read_bytes()),
        "software": software_version(),
        "options": values,
    }
    return {"identity": identity, "recording_state": state}


@lru_cache(maxsize=1)
def software_version() -> str:
    """Changes with all that results are computed and written with."""
    import cv2

    packages = [f"{name} {_source_version(name)}" for name in PACKAGES]
    libraries = [f"{name} {installed_version(name, 'absent')}" for name in LIBRARIES]
    return ", ".join([*packages, *libraries, f"opencv {cv2.__version__}"])


def _source_version(package: str) -> str:
    spec = find_spec(package)
    return source_digest(Path(spec.origin).parent) if spec and spec.origin else "absent"


def _files_of(source: Path) -> Iterator[tuple[str, Path]]:
    """Name and path of a file, or of the files of a folder."""
    for path in [source] if source.is_file() else sorted(source.iterdir()):
        # No recording has hidden files or folders; results may have been put there.
        if path.is_file() and not path.name.startswith("."):
            yield path.name, path
