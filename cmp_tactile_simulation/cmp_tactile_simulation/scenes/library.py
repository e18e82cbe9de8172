"""Finds scenes by file or by the name of a packaged one, and their variants."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from cmp_tactile_simulation.errors import SceneError
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import read_scene, variants_of

__all__ = ["VARIANT_MARK", "SceneName", "load_scene", "packaged_scene_names", "packaged_scenes"]

PACKAGE = "cmp_tactile_simulation"
VARIANT_MARK = ":"


class SceneName(NamedTuple):
    """A scene file and one of its variants, empty where it has none."""

    path: Path
    variant: str = ""

    @classmethod
    def find(cls, text: str) -> SceneName:
        """From NAME, NAME:VARIANT, FILE or FILE:VARIANT; SceneError where there is no such file."""
        packaged = packaged_scenes()
        if text in packaged:
            return cls(packaged[text])
        whole = Path(text).expanduser()
        if whole.is_file():
            return cls(whole)
        base, _, variant = text.rpartition(VARIANT_MARK)
        if base in packaged:
            return cls(packaged[base], variant)
        path = Path(base).expanduser()
        if base and path.is_file():
            return cls(path, variant)
        msg = f"{text}: found no such scene, expected a file or one of {', '.join(packaged)}"
        raise SceneError(msg)


def packaged_scenes() -> dict[str, Path]:
    """Names and files of the scenes that come with the package."""
    found: dict[str, Path] = {}
    for folder in _scene_folders():
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


def packaged_scene_names() -> Iterator[str]:
    """What may be asked for: every scene, those with variants once for each."""
    for name, path in packaged_scenes().items():
        variants = variants_of(path)
        yield from (f"{name}{VARIANT_MARK}{variant}" for variant in variants)
        if not variants:
            yield name


def load_scene(name_or_path: str) -> Scene:
    """The scene of that name or file, `:VARIANT` behind it where it has variants.

    Raises SceneError naming file, key, found and expected.
    """
    found = SceneName.find(name_or_path)
    return replace(read_scene(*found), file=found.path)


def _scene_folders() -> list[Path]:
    source_tree = Path(__file__).resolve().parents[2] / "scenes"
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    installed = [Path(prefix) / "share" / PACKAGE / "scenes" for prefix in prefixes if prefix]
    return [folder for folder in (*installed, source_tree) if folder.is_dir()]
