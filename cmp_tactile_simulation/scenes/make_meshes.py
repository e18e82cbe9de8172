"""Makes screw.stl and key.stl, the meshes of the scenes of those names, in mm.

python3 make_meshes.py writes them beside this file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

FOLDER = Path(__file__).resolve().parent

# An M10 screw (ISO 261: pitch 1.5 mm; ISO 68-1: thread 0.92 mm deep), lying along x.
SCREW_RADIUS_MM, THREAD_DEPTH_MM, THREAD_PITCH_MM, SCREW_LENGTH_MM = 5.0, 0.92, 1.5, 12.0
AROUND, ROWS_PER_PITCH = 32, 7

# A pin tumbler key's blade, lying on its side along x, the cuts towards +y.
BLADE_MM = (9.0, 7.0, 2.0)
GROOVE_MM = (1.5, 2.7, 0.7)
FIRST_CUT_MM, CUT_SPACING_MM, CUT_FLAT_MM, PEAK_MM = 1.5, 2.0, 0.6, 0.2
CUT_DEPTHS_MM = (0.7, 1.1, 0.5, 0.9)


def screw() -> trimesh.Trimesh:
    """Radius over angle and length: a triangular thread that winds once a pitch."""
    rows = round(SCREW_LENGTH_MM / THREAD_PITCH_MM * ROWS_PER_PITCH) + 1
    x = np.linspace(-SCREW_LENGTH_MM / 2, SCREW_LENGTH_MM / 2, rows)[:, None]
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)[None]
    phase = (x / THREAD_PITCH_MM - angle / (2 * np.pi)) % 1.0
    # Crest and root are flat, by 1/8 and 1/4 of the pitch.
    height = np.clip((np.abs(2 * phase - 1) - 0.25) / 0.625, 0.0, 1.0)
    radius = SCREW_RADIUS_MM - THREAD_DEPTH_MM * (1 - height)
    ring = np.stack(np.broadcast_arrays(x, radius * np.cos(angle), radius * np.sin(angle)), axis=-1)
    ends = [[x[0, 0], 0.0, 0.0], [x[-1, 0], 0.0, 0.0]]
    vertices = np.concatenate([ring.reshape(-1, 3), ends])
    count = rows * AROUND
    around = np.roll(np.arange(AROUND), -1)
    caps = [
        np.stack([np.full(AROUND, count), around, np.arange(AROUND)], axis=1),
        np.stack([np.full(AROUND, count + 1), np.arange(AROUND), around], axis=1)
        + [0, count - AROUND, count - AROUND],
    ]
    return _solid(vertices, [_tube(rows, AROUND), *caps])


def key() -> trimesh.Trimesh:
    """The same outline across at every place along the blade, but for how far it reaches in y."""
    length, width, thickness = BLADE_MM
    low, high, depth = GROOVE_MM
    x, top = _cuts(length, width)
    outline = [
        (0.0, 0.0), (low, 0.0), (low + depth / 2, depth), (high - depth / 2 + 0.4, depth),
        (high + 0.4, 0.0), (width, 0.0), (width, thickness), (0.0, thickness),
    ]  # fmt: skip
    sections = []
    for place, reach in zip(x, top, strict=True):
        y = np.array([min(y, reach) for y, _ in outline])
        z = np.array([z for _, z in outline])
        sections.append(np.stack([np.full(len(y), place), y, z], axis=1))
    vertices = np.concatenate(sections) - (length / 2, width / 2, thickness / 2)
    corners = len(outline)
    cap = np.array([(7, 0, 1), (7, 1, 2), (7, 2, 6), (2, 3, 6), (3, 4, 6), (4, 5, 6)])
    last = corners * (len(x) - 1)
    return _solid(vertices, [_tube(len(x), corners), cap[:, ::-1], cap + last])


def _cuts(length: float, width: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places along the blade, and how far it reaches in y there: flat cuts, peaks between them."""
    x, top = [0.0], [width]
    for number, depth in enumerate(CUT_DEPTHS_MM):
        middle = FIRST_CUT_MM + number * CUT_SPACING_MM
        x += [middle - CUT_FLAT_MM / 2, middle + CUT_FLAT_MM / 2, middle + CUT_SPACING_MM / 2]
        top += [width - depth, width - depth, width - PEAK_MM]
    return np.array([*x, length]), np.array([*top, width - 2.0])


def _tube(rows: int, corners: int) -> NDArray[np.int64]:
    """Triangles between neighbouring rows of a closed outline."""
    first = np.arange(rows - 1)[:, None] * corners
    here, beside = np.arange(corners), np.roll(np.arange(corners), -1)
    a, b, c, d = first + here, first + beside, first + corners + here, first + corners + beside
    return np.concatenate(
        [np.stack([a, b, d], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)]
    )


def _solid(vertices: NDArray[np.float64], faces: list[NDArray[np.int64]]) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
    trimesh.repair.fix_normals(mesh)
    if not mesh.is_watertight or mesh.volume <= 0:
        msg = "found a mesh that is not watertight, expected a solid"
        raise ValueError(msg)
    return mesh


if __name__ == "__main__":
    for name, mesh in (("screw", screw()), ("key", key())):
        (FOLDER / f"{name}.stl").write_bytes(mesh.export(file_type="stl"))
