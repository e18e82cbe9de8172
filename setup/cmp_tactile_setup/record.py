"""Records of finished steps: a step without a valid record is done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def read_record(path: Path) -> dict[str, Any]:
    """The record, or an empty one if there is none or it cannot be read."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write the record in one step, so that an interruption leaves no half of it."""
    temporary = path.with_suffix(".new")
    temporary.write_text(json.dumps(record, indent=1, sort_keys=True), encoding="utf-8")
    temporary.replace(path)


def digest(contents: Iterable[Path], names: Iterable[Path], root: Path) -> str:
    """Hash of the contents of some files and of the names alone of others, relative to root."""
    total = hashlib.sha256()
    for path in sorted(contents):
        total.update(path.relative_to(root).as_posix().encode() + b"\0")
        total.update(hashlib.sha256(path.read_bytes()).digest())
    for path in sorted(names):
        total.update(path.relative_to(root).as_posix().encode() + b"\0")
    return total.hexdigest()
