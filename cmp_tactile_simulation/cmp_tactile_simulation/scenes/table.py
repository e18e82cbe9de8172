"""Tables for the documentation of scenes, from the dataclasses and the packaged scenes.

`python3 -m cmp_tactile_simulation.scenes.table docs/scenes.md` renews what follows the marker line
of that file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields
from pathlib import Path

from cmp_tactile_processing.sensor import parameter_table
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes.description import INDENTERS, MESH, MESH_KEYS
from cmp_tactile_simulation.scenes.file import load_scene, packaged_scene_names

MARKER = "<!-- made by cmp_tactile_simulation.scenes.table from here on -->"


def renew(path: Path) -> str:
    """The text of the file with its tables made again."""
    lines = [
        *_indenters(),
        *parameter_table.parameter_rows("camera", CameraSettings),
        *parameter_table.parameter_rows("print", PrintDefects),
        *_scenes(),
    ]
    return parameter_table.with_generated_section(path, MARKER, "\n".join(lines) + "\n")


def _indenters() -> Iterator[str]:
    yield "### indenter\n"
    yield "| type | keys | shape |\n|---|---|---|"
    for name, shape in INDENTERS.items():
        keys = ", ".join(
            f"`{item.name}`" + ("" if item.default is MISSING else f" ({item.default:g})")
            for item in fields(shape)
        )
        text = " ".join((shape.__doc__ or "").split())
        yield f"| `{name}` | {keys} | {text} |"
    keys = ", ".join(f"`{key}`" for key in ("file", *MESH_KEYS))
    yield f"| `{MESH}` | {keys} | The underside of a closed mesh, see [mesh files](#mesh-files). |"
    yield ""


def _scenes() -> Iterator[str]:
    yield "### Packaged scenes\n"
    yield "`ball:16mm` is variant `16mm` of the scene `ball`. The name of a scene is not the `type`"
    yield "of its indenter: the indenter of `ball` is a `sphere`.\n"
    yield "| scene | frames | source | title |\n|---|---|---|---|"
    for name in packaged_scene_names():
        scene = load_scene(name)
        yield f"| `{name}` | {scene.frame_count} | {scene.source} | {scene.title} |"


if __name__ == "__main__":
    parameter_table.renew_file(renew)
