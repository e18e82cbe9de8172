"""Which modules of `paper` a function rests on, and a digest of what they say."""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["modules_behind", "source_of", "sources_digest"]

PACKAGE = "paper"
FOLDER = Path(__file__).parent


def sources_digest(work: Callable[..., Any], folder: Path = FOLDER) -> str:
    """Changes with the function's module and all modules of the package that it imports.

    Imports within functions count as well, and those of imported modules; comments and the way
    the code is laid out do not.  folder: of the package.
    """
    digest = hashlib.sha256()
    for name, path in modules_behind(work.__module__, folder).items():
        digest.update(f"{name}\0{_parsed(path).code}\0".encode())
    return digest.hexdigest()[:32]


def modules_behind(module: str, folder: Path = FOLDER) -> dict[str, Path]:
    """The module and all modules of the package that it imports, also through others; sorted.

    Raises ModuleNotFoundError for a module without a source file.
    """
    own = source_of(module, folder) or _file_of(module)
    found: dict[str, Path] = {}
    ahead = {module: own}
    while ahead:
        name, path = ahead.popitem()
        found[name] = path
        for other in _parsed(path).imported:
            its_path = source_of(other, folder)
            if its_path is not None and other not in found:
                ahead[other] = its_path
    return dict(sorted(found.items()))


def _file_of(module: str) -> Path:
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None:
        msg = f"{module}: found no source file, expected a module that was imported from one"
        raise ModuleNotFoundError(msg)
    return Path(path)


def source_of(module: str, folder: Path = FOLDER) -> Path | None:
    """The file of a module of the package; None for any other name."""
    package, *parts = module.split(".")
    if package != PACKAGE:
        return None
    place = folder.joinpath(*parts)
    files = (place.with_suffix(".py") if parts else place / "__init__.py", place / "__init__.py")
    return next((file for file in files if file.is_file()), None)


class _Parsed(NamedTuple):
    """Code without comments, and the names that may be modules that it imports."""

    code: str
    imported: tuple[str, ...]


def _parsed(path: Path) -> _Parsed:
    facts = path.stat()
    return _parsed_version(path, facts.st_mtime_ns, facts.st_size)


@cache
def _parsed_version(path: Path, _changed_ns: int, _size: int) -> _Parsed:
    """Many cases rest on the same files, and a file may be changed while they run."""
    tree = ast.parse(path.read_bytes())
    return _Parsed(ast.unparse(tree), tuple(_imported(tree)))


def _imported(tree: ast.Module) -> Iterator[str]:
    """Names that may be modules; of `from a import b`, both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 1:
            base = f"{PACKAGE}.{node.module}" if node.module else PACKAGE
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
