"""Contacts with a known force: solved by the simulator, on another mesh than the force model's.

Each load case is an indenter with friction that presses on the gel with a given load. The contact
solver of the simulator finds the nodes in contact and their forces. Its nodes are half as far apart
as those of the force model. The displacement of the markers comes from a mesh with elements of the
same width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import default_cache_dir, files_digest
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.gel import ContactProblem, LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Cylinder, FlatProbe, Ring, Sphere, SphereGroup
from cmp_tactile_simulation.indenters import Indenter
from cmp_tactile_simulation.neo_hookean_gel import NeoHookeanElastomer
from cmp_tactile_simulation.scenes.description import turned
from hard_frames.contacts import at_markers

Array = NDArray[np.float64]

# Contact nodes along the patch of 16.5 mm: 0.35 mm apart, the force nodes of the inverse 0.69 mm.
TRUTH_NODES = 48

# Loads that are solved, N, and those that are the 10 N of a linear gel times a factor: physical
# contacts of these indenters would leave the marker area.
SOLVED_N = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SCALED_N = (20.0, 50.0)

# The depths of the indenters in a neo-Hookean gel, m.
DEPTHS = (0.14e-3, 0.3e-3, 0.44e-3, 0.7e-3)
LINEAR, NEO_HOOKEAN, SMOOTH = "linear", "neo-Hookean", "smooth"


@dataclass(frozen=True)
class Contacting:
    """An indenter let down at (x, y) m, turned about x, y, z.

    tangential: share of the normal force along x and y; torque: at 10 N, N m; below, it falls
    with the normal force to the power of 4/3, as what the friction of a sphere carries does.
    """

    indenter: Indenter
    at: tuple[float, float] = (0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    torque: float = 0.0
    friction: float = 0.6

    def load(self, newton: float) -> Load:
        """What it presses with where its normal force is `newton`."""
        x, y = self.tangential
        return Load(newton, (x * newton, y * newton), self.torque * (newton / 10) ** (4 / 3))


CONTACTS = {
    "sphere": Contacting(Sphere(8e-3), (0.4e-3, -0.3e-3)),
    "edge": Contacting(Cylinder(2e-3, 8e-3, 1e-3), rotation_deg=(0.0, 0.0, 20.0)),
    "ring": Contacting(Ring(3.2e-3, 1e-3), (0.2e-3, 0.1e-3)),
    "two contacts": Contacting(SphereGroup(((-3.4e-3, -0.5e-3, 0.0), (3.4e-3, 0.5e-3, 0.0)), 3e-3)),
    "off centre": Contacting(Sphere(6e-3), (2e-3, -1.4e-3), tangential=(0.1, -0.1)),
    "tilted": Contacting(
        FlatProbe(6e-3, edge_radius=1e-3), (0.3e-3, 0.2e-3), rotation_deg=(5.0, -3.0, 0.0)
    ),
    "shear": Contacting(Sphere(8e-3), tangential=(0.3, 0.1)),
    "torque": Contacting(Sphere(8e-3), torque=8e-3, friction=1.0),
}

# What presses on a neo-Hookean gel: the flat pin moves more of it at the same depth.
LARGE_PRESSES = {
    "sphere": CONTACTS["sphere"],
    "shear": CONTACTS["shear"],
    "flat": Contacting(FlatProbe(8e-3, edge_radius=1e-3)),
}


@dataclass(frozen=True)
class ForceCase:
    """A load, and what it truly does to the markers; gel frame, M force nodes of the inverse.

    name, newton: load case and its normal force, N.  material: linear, neo-Hookean or smooth (a
    smooth patch of pressure that no indenter makes, on a linear gel).  depth: of the indenter, m,
    NaN where the load drives it.
    displacement: (rows, cols, 3) m of the markers.
    force_on_nodes: (M, 3) N, the true force as the hats of the force nodes collect it: that of
    each point is shared out to the four nodes around it so that force and centre are kept.
    wrench: (6,) N and N m about the gel frame's origin, forces where their points have moved to.
    area: of the undeformed surface in contact, m^2.
    """

    name: str
    newton: float
    material: str
    depth: float
    displacement: Array
    force_on_nodes: Array
    wrench: Array
    area: float


@dataclass(frozen=True)
class _Solved:
    """Forces on the truth's nodes, their displacement (N, 3), and the nodes that touch (N,)."""

    name: str
    newton: float
    material: str
    depth: float
    force: Array
    moved: Array
    contact: NDArray[np.bool_]

    def times(self, factor: float) -> _Solved:
        return replace(
            self, newton=self.newton * factor, force=self.force * factor, moved=self.moved * factor
        )


def load_cases(sensor: SensorDescription) -> list[ForceCase]:
    """All cases on a linear gel: contacts at every load, then the smooth patches at 10 N and 1 N.

    They are computed once, in about two minutes, and kept in the cache folder, as long as this
    module stays.
    """
    return _memory().cache(_linear_cases)(sensor)


def load_neo_hookean_cases(sensor: SensorDescription) -> list[ForceCase]:
    """Indenters that come to DEPTHS in a neo-Hookean gel, straight down and with shear."""
    return _memory().cache(_neo_hookean_cases)(sensor)


def _memory() -> joblib.Memory:
    sources = files_digest([("cases", Path(__file__))])
    return joblib.Memory(default_cache_dir() / f"force_cases-{sources[:16]}", verbose=0)


def _hat_weights(grid: SurfaceGrid, xy: Array) -> Array:
    """Share (n, M) of the force at each point (n, 2) m that goes to each node of a grid.

    Points outside give to the nearest border, which keeps the force and not its centre.
    """
    lines = []
    for axis, count in ((1, grid.rows), (0, grid.cols)):
        place = (xy[:, axis] + grid.extent[axis] / 2) / grid.spacing[axis]
        place = np.clip(place, 0, count - 1)
        lines.append(np.maximum(0, 1 - np.abs(place[:, None] - np.arange(count))))
    return np.einsum("ni,nj->nij", *lines).reshape(len(xy), -1)


def _linear_cases(sensor: SensorDescription) -> list[ForceCase]:
    gel = LinearElastomer(sensor, TRUTH_NODES)
    solved: list[_Solved] = []
    for name, contact in CONTACTS.items():
        states = list(pressed(gel, contact, SOLVED_N))
        found = [
            _Solved(name, n, LINEAR, float("nan"), s.force, s.displacement, s.contact)
            for n, s in zip(SOLVED_N, states, strict=True)
        ]
        solved += found + [found[-1].times(n / SOLVED_N[-1]) for n in SCALED_N]
    for name, force in _smooth_loads(gel.nodes.points).items():
        touching = force.any(axis=1)
        whole = _Solved(name, 10.0, SMOOTH, float("nan"), force, gel.displacement(force), touching)
        solved += [whole.times(0.1), whole]
    displacement = marker_displacement(sensor, [case.force for case in solved])
    return [
        _finished(sensor, gel, case, moved)
        for case, moved in zip(solved, displacement, strict=True)
    ]


def marker_displacement(
    sensor: SensorDescription, forces: list[Array], nodes: int = TRUTH_NODES, finer: float = 1
) -> list[Array]:
    """Displacement (rows, cols, 3) m of the markers of a linear gel under forces on its nodes.

    finer: how many elements there are between neighbouring nodes.
    """
    problem: ElasticProblem = ContactProblem.with_nodes(sensor, nodes)
    markers = ElasticProblem.from_sensor(sensor).markers
    problem = replace(problem, markers=markers)
    if finer > 1:
        # The mesh of the plain problem: its width under the loads can be chosen.
        density = replace(
            problem.density, across=2 * round(finer * problem.density.across / 2), depth=5
        )
        problem = ElasticProblem(
            problem.geometry,
            problem.poisson,
            problem.layer_ratio,
            markers,
            problem.nodes,
            replace(density, layer=2, rim=4, growth=1.5),
        )
    columns = np.stack([force.ravel() for force in forces], axis=1)
    moved = problem.expand(problem.solve(columns), of_nodes=False) / sensor.elastomer.young
    return [column.reshape(markers.rows, markers.cols, 3) for column in moved.T]


def pressed(
    gel: LinearElastomer, contact: Contacting, loads: tuple[float, ...]
) -> Iterator[ContactState]:
    """The contact at each load, one after the other."""
    simulation, state = _above(gel, contact)
    for newton in loads:
        state = simulation.press(state, contact.load(newton))
        yield state


def _above(gel: LinearElastomer, contact: Contacting) -> tuple[ContactSimulation, ContactState]:
    simulation = ContactSimulation(gel, contact.indenter, contact.friction)
    pose = Pose(np.array([*contact.at, 0.1]), turned(contact.rotation_deg))
    return simulation, simulation.rest(simulation.touch(pose))


def _neo_hookean_cases(sensor: SensorDescription) -> list[ForceCase]:
    gel = NeoHookeanElastomer(sensor, TRUTH_NODES)
    linear = LinearElastomer(sensor, TRUTH_NODES)
    solved, beyond = [], []
    for name, contact in LARGE_PRESSES.items():
        simulation, state = _above(gel, contact)
        start = state.pose.position
        for depth in DEPTHS:
            aside = 0.3 * depth if name == "shear" else 0.0
            place = start + (aside, 0.0, -depth)
            state = simulation.move(state, Pose(place, state.pose.rotation))
            newton = -float(state.resultant[2])
            solved.append(
                _Solved(name, newton, NEO_HOOKEAN, depth, state.force, state.displacement,
                        state.contact)
            )  # fmt: skip
            beyond.append(
                gel.marker_displacement(state.force) - linear.marker_displacement(state.force)
            )
    moved = marker_displacement(sensor, [case.force for case in solved])
    markers = ElasticProblem.from_sensor(sensor).markers
    return [
        _finished(sensor, gel, case, first + at_markers(gel.observers, markers, more))
        for case, first, more in zip(solved, moved, beyond, strict=True)
    ]


def _finished(
    sensor: SensorDescription, gel: LinearElastomer, case: _Solved, displacement: Array
) -> ForceCase:
    nodes = ElasticProblem.from_sensor(sensor).nodes
    place = gel.node_position + case.moved
    moment = np.cross(place, case.force).sum(axis=0)
    return ForceCase(
        name=case.name,
        newton=case.newton,
        material=case.material,
        depth=case.depth,
        displacement=displacement,
        force_on_nodes=_hat_weights(nodes, gel.nodes.points).T @ case.force,
        wrench=np.concatenate([case.force.sum(axis=0), moment]),
        area=float(gel.node_area[case.contact].sum()),
    )


def _smooth_loads(xy: Array) -> dict[str, Array]:
    """Nodal forces (n, 3) N of smooth round patches of pressure, 10 N of normal force each."""

    def patch(centre: tuple[float, float], radius: float) -> Array:
        weights = np.maximum(0, 1 - ((xy - centre) ** 2).sum(axis=1) / radius**2) ** 1.5
        return weights / weights.sum()

    down = np.array([0.0, 0.0, -10.0])
    centred = patch((0.0, 0.0), 3e-3)
    turn = np.stack([-xy[:, 1], xy[:, 0], np.zeros(len(xy))], axis=1) * centred[:, None]
    turn *= 0.01 / (xy[:, 0] @ turn[:, 1] - xy[:, 1] @ turn[:, 0])
    two = (patch((-3e-3, 0.0), 1.5e-3) + patch((3e-3, 1e-3), 1.5e-3)) / 2
    return {
        "smooth press": centred[:, None] * down,
        "smooth small press": patch((-1e-3, 1.5e-3), 1.5e-3)[:, None] * down,
        "smooth shear": centred[:, None] * (down + [3.0, 1.0, 0.0]),
        "smooth torque": centred[:, None] * down + turn,
        "smooth off centre": patch((3e-3, -2e-3), 2.5e-3)[:, None] * (down + [1.0, -1.0, 0.0]),
        "smooth two contacts": two[:, None] * down,
    }
