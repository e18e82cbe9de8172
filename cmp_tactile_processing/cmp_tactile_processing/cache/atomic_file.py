"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from pathlib import Path

from cmp_tactile_processing.errors import DescriptionError

__all__ = ["write_whole"]


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file beside its place, then move it there: readers see the old or the new one.

    Text is UTF-8.  A link is followed, and the permissions of a file that was there are kept.
    Raises DescriptionError, and leaves what was there, where the file cannot be written.
    """
    try:
        data = content.encode("utf-8") if isinstance(content, str) else content
        target = path.resolve()
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        beside = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.chmod(_mode(target))
            beside.replace(target)
        except BaseException:
            with contextlib.suppress(OSError):
                beside.unlink()
            raise
    except (OSError, UnicodeEncodeError) as error:
        msg = f"{path}: cannot be written: {error}"
        raise DescriptionError(msg) from None


def _mode(target: Path) -> int:
    """Permissions of the file there, or those of a new one."""
    try:
        return stat.S_IMODE(target.stat().st_mode)
    except FileNotFoundError:
        # The only way to read the mask is to set it.
        mask = os.umask(0o077)
        os.umask(mask)
        return 0o666 & ~mask
