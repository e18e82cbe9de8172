#!/usr/bin/env python3
"""Compare the force with CalculiX, a finite-element program that shares no code with this project.

Known tractions act on a gel that CalculiX solves on a separate mesh (C3D20R hexahedra). Its
displacement at the markers gets noise, and the force is computed from it. Needs ccx: apt-get
install calculix-ccx. Takes some minutes.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np
from errors import NOISE_M, surface_of
from numpy.typing import NDArray
from tables import CommandLine

from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.force.advice import flag_names
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import ForceField, ForceFlag
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor

Array = NDArray[np.float64]

# Elements along x and y: so many in the middle, where the markers are, and at each side; over the
# body's depth, with their growth downwards; one in the shading layer.
MIDDLE, SIDE, DEPTH, GROWTH = 22, 3, 4, 1.4
ACROSS = MIDDLE + 2 * SIDE
# Half of the middle, as a share of the block's.
MIDDLE_SHARE = 0.68
# Points per element and direction that the tractions are integrated with.
GAUSS = 8
# Corners, then midsides, of C3D20 in units of half an element, in the order of ccx.
CORNERS = [(0, 0), (2, 0), (2, 2), (0, 2)]
MIDSIDES = [(1, 0), (2, 1), (1, 2), (0, 1)]
NODES_20 = np.array(
    [(*p, 0) for p in CORNERS] + [(*p, 2) for p in CORNERS] + [(*p, 0) for p in MIDSIDES]
    + [(*p, 2) for p in MIDSIDES] + [(*p, 1) for p in CORNERS]
)  # fmt: skip
FACE = np.array(CORNERS + MIDSIDES)


@dataclass(frozen=True)
class Patch:
    """A round patch: centre and radius, mm, resultant, N; even, or as a ball presses."""

    at: tuple[float, float]
    radius: float
    force: tuple[float, float, float]
    even: bool = False

    def density(self, xy: Array) -> Array:
        """Share of the force per area (not normalised) at points (n, 2) m."""
        left = 1 - ((xy * 1e3 - self.at) ** 2).sum(axis=1) / self.radius**2
        return (left > 0).astype(float) if self.even else np.sqrt(np.maximum(left, 0.0))


CASES = {
    "press 5 N": (Patch((0.4, -0.3), 2.0, (0, 0, -5)),),
    "flat press 5 N": (Patch((-1.5, 1.0), 2.2, (0, 0, -5), even=True),),
    "press 5 N with shear": (Patch((1.0, 1.0), 2.0, (1.5, 0.5, -5)),),
    "press 5 N near the border": (Patch((4.7, 1.0), 1.3, (0, 0, -5)),),
    "press 5 N near a corner": (Patch((4.4, -4.4), 1.4, (0, 0, -5)),),
    "pull 1 N": (Patch((0.5, -0.5), 2.0, (0, 0, 1), even=True),),
    "press 2 N, pull 0.5 N": (
        Patch((-3.0, 0.0), 1.8, (0, 0, -2)), Patch((3.0, 1.0), 1.8, (0, 0, 0.5), even=True),
    ),
    "drag 1 N": (Patch((0.5, 0.3), 2.0, (0.8, 0.6, 0), even=True),),
    "press 5 N, a fifth outside": (Patch((5.9, 1.0), 1.6, (0, 0, -5)),),
    "press 5 N, all outside": (Patch((8.4, 1.0), 1.3, (0, 0, -5)),),
}  # fmt: skip


class Mesh:
    """The gel as a lattice of nodes, two steps to an element, and its top face."""

    def __init__(self, sensor: SensorDescription) -> None:
        problem = ElasticProblem.from_sensor(sensor)
        geometry, self.reach = problem.geometry, problem.markers.extent[0] / 2
        middle = np.linspace(-MIDDLE_SHARE, MIDDLE_SHARE, MIDDLE + 1)
        side = np.linspace(MIDDLE_SHARE, 1, SIDE + 1)[1:]
        edges = _with_midpoints(np.concatenate([-side[::-1], middle, side]))
        self.x, self.y = (edges * size / 2 for size in geometry.size[:2])
        parts = GROWTH ** -np.arange(DEPTH)
        edges = np.concatenate([[0.0], np.cumsum(parts) / parts.sum()])
        depth = _with_midpoints(edges)
        self.levels = 2 * DEPTH + 3
        grid = np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)
        top = geometry.surface.height(grid)[..., None]
        body = geometry.base + depth * (top - geometry.base)
        layer = top + np.array([0.5, 1.0]) * geometry.layer
        z = np.concatenate([body, layer], axis=2)
        xy = np.broadcast_to(grid[:, :, None], (*z.shape, 2))
        self.place = np.concatenate([xy, z[..., None]], axis=3)

    def number(self, i: Array, j: Array, k: Array) -> NDArray[np.intp]:
        """Number of a lattice point for ccx."""
        return np.asarray((i * len(self.y) + j) * self.levels + k + 1, dtype=np.intp)

    def on_face(self, xy: Array, level: int) -> tuple[NDArray[np.intp], Array]:
        """Numbers (n, 8) of the nodes around points (n, 2) m, and their shares (n, 8)."""
        cell, local = [], []
        for axis, line in ((0, self.x), (1, self.y)):
            index = np.searchsorted(line[2:-1:2], xy[:, axis])
            cell.append(index)
            middle = line[2 * index + 1]
            local.append((xy[:, axis] - middle) / (line[2 * index + 2] - middle))
        i, j = (2 * index[:, None] + FACE[:, axis] for axis, index in enumerate(cell))
        return self.number(i, j, np.full_like(i, level)), _serendipity(*local)

    def loads(self, patches: tuple[Patch, ...]) -> tuple[dict[int, Array], float]:
        """Consistent nodal forces by number, and the share of the load outside of the markers."""
        lines, lengths = [], []
        gauss, weight = np.polynomial.legendre.leggauss(GAUSS)
        for line in (self.x, self.y):
            half = (line[1::2] - line[:-1:2])[:, None]
            lines.append((line[1::2, None] + half * gauss).ravel())
            lengths.append((half * weight).ravel())
        xy = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
        area = np.multiply.outer(*lengths).ravel()
        force = np.zeros((len(xy), 3))
        for patch in patches:
            share = patch.density(xy) * area
            force += (share / share.sum())[:, None] * np.array(patch.force, float)
        acting = force.any(axis=1)
        numbers, shares = self.on_face(xy[acting], self.levels - 1)
        total: dict[int, Array] = {}
        parts = shares[..., None] * force[acting][:, None]
        for number, part in zip(numbers.ravel().tolist(), parts.reshape(-1, 3), strict=True):
            total[number] = total.get(number, np.zeros(3)) + part
        size = np.linalg.norm(force, axis=1)
        return total, float(size[(np.abs(xy) > self.reach).any(axis=1)].sum() / size.sum())


def _with_midpoints(edges: Array) -> Array:
    return np.sort(np.concatenate([edges, (edges[1:] + edges[:-1]) / 2]))


def _serendipity(u: Array, v: Array) -> Array:
    """Shares (n, 8) of the nodes of FACE at local places in -1..1."""
    a, b = (FACE - 1).T.astype(float)
    u, v = u[:, None], v[:, None]
    corner = (1 + a * u) * (1 + b * v) * (a * u + b * v - 1) / 4
    along_x, along_y = (1 - u**2) * (1 + b * v) / 2, (1 + a * u) * (1 - v**2) / 2
    return np.where(a == 0, along_x, np.where(b == 0, along_y, corner))


def write_input(path: Path, mesh: Mesh, sensor: SensorDescription, wanted: Array) -> None:
    """The model and one step for each case."""
    elastomer, lines = sensor.elastomer, ["*NODE"]
    index = np.indices(mesh.place.shape[:3]).reshape(3, -1)
    used = (index % 2).sum(axis=0) <= 1
    numbers = mesh.number(*index)[used]
    for number, place in zip(numbers, mesh.place.reshape(-1, 3)[used], strict=True):
        lines.append("{}, {:.12g}, {:.12g}, {:.12g}".format(number, *place))
    cells = np.indices((ACROSS, ACROSS, DEPTH + 1)).reshape(3, -1).T
    for name, chosen in (("BODY", cells[:, 2] < DEPTH), ("LAYER", cells[:, 2] == DEPTH)):
        lines.append(f"*ELEMENT, TYPE=C3D20R, ELSET={name}")
        for which in np.flatnonzero(chosen):
            around = mesh.number(*(2 * cells[which][:, None] + NODES_20.T)).tolist()
            row = [str(number) for number in (which + 1, *around)]
            lines += [", ".join(row[:11]) + ",", ", ".join(row[11:])]
        young = elastomer.young if name == "BODY" else elastomer.shading_layer.young
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{young}, {elastomer.poisson}"]
        lines += [f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"]
    base = numbers[index[2][used] == 0]
    lines += ["*NSET, NSET=BASE", *map(str, base), "*NSET, NSET=SEEN", *map(str, wanted)]
    lines += ["*BOUNDARY", "BASE, 1, 3"]
    for patches in CASES.values():
        lines += ["*STEP", "*STATIC", "*CLOAD, OP=NEW"]
        for number, force in mesh.loads(patches)[0].items():
            lines += [f"{number}, {axis + 1}, {part:.12g}" for axis, part in enumerate(force)]
        lines += ["*NODE PRINT, NSET=SEEN", "U", "*END STEP"]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def solved(sensor: SensorDescription, mesh: Mesh) -> dict[str, Array]:
    """Displacement (rows, cols, 3) m of the markers in each case, by ccx."""
    markers = ElasticProblem.from_sensor(sensor).markers
    around, shares = mesh.on_face(markers.points, mesh.levels - 3)
    wanted = np.unique(around)
    with tempfile.TemporaryDirectory() as folder:
        write_input(Path(folder) / "gel.inp", mesh, sensor, wanted)
        done = subprocess.run(
            [shutil.which("ccx") or "ccx", "-i", "gel"],
            cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        rows = [
            [float(word) for word in line.split()]
            for line in (Path(folder) / "gel.dat").read_text(encoding="ascii").splitlines()
            if line.strip() and not line.strip().startswith("displacements")
        ]
    if len(rows) != len(CASES) * len(wanted):
        sys.exit(f"ccx gave {len(rows)} rows, expected {len(CASES) * len(wanted)}: {done.stdout}")
    found = np.array(rows).reshape(len(CASES), len(wanted), 4)[..., 1:]
    at = np.einsum("nk,cnkj->cnj", shares, found[:, np.searchsorted(wanted, around)])
    shape = markers.rows, markers.cols, 3
    return {name: moved.reshape(shape) for name, moved in zip(CASES, at, strict=True)}


def line(name: str, outside: float, true: Array, fields: list[ForceField]) -> str:
    """A row of the table: means over the frames, share of components within two deviations."""
    force = np.array([field.wrench[:3] for field in fields])
    std = np.array([field.random_std[:3] for field in fields])
    within = float((np.abs(force - true) <= 2 * std).mean())
    flags = ForceFlag(int(np.bitwise_or.reduce([int(field.flags) for field in fields])))
    texts = (" ".join(f"{part:7.4f}" for part in row) for row in (true, force.mean(0), std.mean(0)))
    columns = (f"{name:27s}", f"{outside:4.2f}", *texts, f"{within:4.2f}", flag_names(flags))
    return " | ".join(columns)


def main() -> None:
    """Print the table."""
    parser = CommandLine(__doc__)
    parser.option("--sensor", "sensor description: name or file", "sample_rig")
    parser.option("--frames", "noisy frames of each case", 20)
    arguments = parser.parse_args()
    if shutil.which("ccx") is None:
        sys.exit("ccx is missing: apt-get install calculix-ccx")
    sensor = load_sensor(arguments.sensor)
    stage, mesh = ForceStage(sensor), Mesh(sensor)
    random = np.random.default_rng(0)
    print("case | share outside | true N | found N | std N | within 2 std | flags in any frame")
    for name, moved in solved(sensor, mesh).items():
        true = np.sum([patch.force for patch in CASES[name]], axis=0)
        fields = []
        for _ in range(arguments.frames):
            stage.reset()
            noise = NOISE_M * random.standard_normal(moved.shape)
            fields.append(stage.process(surface_of(sensor, moved + noise)))
        print(line(name, mesh.loads(CASES[name])[1], true, fields), flush=True)


if __name__ == "__main__":
    main()
