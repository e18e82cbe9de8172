"""Errors of reconstructed forces, and how well their error bars describe them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
from cases import LINEAR, ForceCase
from numpy.typing import NDArray
from scipy.linalg import eigh

from cmp_tactile_processing.force.contact_regions import ContactRegions
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.traction_spectrum import nodal_force_matrix
from cmp_tactile_processing.measured import (
    ForceField,
    Status,
    Surface,
    SurfaceGrid,
    no_virtual_markers,
)
from cmp_tactile_processing.sensor.description import SensorDescription

Array = NDArray[np.float64]

# Noise of a measured marker displacement along x, y, z, m.
NOISE_M = np.array([2e-6, 2e-6, 5e-6])

# Limits: of the force, share and N; of the torque, N m; of the distribution at 10 N and at 1 N.
FORCE_SHARE, FORCE_N = 0.01, 0.01
TORQUE_NM = 0.5e-3
L2_LIMITS = {10.0: 0.05, 1.0: 0.15}
# A limit is met where this share of the frames is within it.
WITHIN = 0.95

# What the oracle tries: smoothing lengths, m, and weights, relative to the data's own.
ORACLE_LENGTHS = (0.5e-3, 1.5e-3)
ORACLE_TANGENTIAL = (0.3, 1.0)
ORACLE_WEIGHTS = 10.0 ** np.arange(-8, 0.1, 0.5)
# Nodes with less than this share of the largest normal force are beside the contact.
PRESSED = 0.1


@dataclass(frozen=True)
class ForceErrors:
    """Errors of F frames of one load.

    fz (F,): of the normal force, N, positive where too much is pressed.  ft (F,): length of the
    error of the tangential force, N.  torque (F,): length of that of the moment, N m.
    l2 (F,): |f - f_true| / |f_true| over all nodes and components.  area (F,): error of the area in
    contact over the true one, positive where it is too large.
    """

    fz: Array
    ft: Array
    torque: Array
    l2: Array
    area: Array

    def high(self, name: str) -> float:
        """What WITHIN of the frames' errors do not exceed in size."""
        return float(np.quantile(np.abs(getattr(self, name)), WITHIN, method="higher"))

    @classmethod
    def from_case(cls, case: ForceCase, found: Sequence[ForceField]) -> ForceErrors:
        """Errors of the fields that were found for a case."""
        wrench = np.stack([field.wrench for field in found]) - case.wrench
        force = np.stack([field.force for field in found])
        off = (force - case.force_on_nodes).reshape(len(force), -1)
        return cls(
            fz=-wrench[:, 2],
            ft=np.linalg.norm(wrench[:, :2], axis=1),
            torque=np.linalg.norm(wrench[:, 3:], axis=1),
            l2=np.linalg.norm(off, axis=1) / np.linalg.norm(case.force_on_nodes),
            area=np.array([field.contact_area for field in found]) / case.area - 1,
        )


@dataclass(frozen=True)
class Limits:
    """What the errors of a load must not exceed: N, N, N m, and the distribution's, else NaN."""

    fz: float
    ft: float
    torque: float
    l2: float

    @classmethod
    def from_case(cls, case: ForceCase) -> Limits:
        """Limits of a case."""
        tangential = float(np.linalg.norm(case.wrench[:2]))
        return cls(
            fz=FORCE_SHARE * abs(case.wrench[2]) + FORCE_N,
            ft=FORCE_SHARE * tangential + FORCE_N,
            torque=TORQUE_NM,
            l2=L2_LIMITS.get(round(case.newton, 6), float("nan")),
        )

    def missed(self, errors: ForceErrors) -> list[str]:
        """Names of the errors that exceed their limits."""
        named = [(item.name, getattr(self, item.name)) for item in fields(self)]
        return [name for name, limit in named if errors.high(name) > limit]


def noisy(case: ForceCase, frames: int, scale: float = 1.0) -> list[Array]:
    """The case's displacement with noise, as `frames` frames show it."""
    random = np.random.default_rng([0, *case.name.encode(), round(1e3 * case.newton)])
    shape = case.displacement.shape
    return [
        case.displacement + scale * NOISE_M * random.standard_normal(shape) for _ in range(frames)
    ]


def surface_of(sensor: SensorDescription, moved: Array) -> Surface:
    """The surface as it is measured where the markers have moved by (rows, cols, 3) m."""
    grid, reference = sensor.pattern.shape, sensor.pattern.corners()
    return Surface(
        shape=grid,
        reference=reference,
        position=reference + moved,
        displacement=moved,
        status=np.full(grid.corners, Status.MEASURED, np.uint8),
        fault=np.zeros(grid.corners, np.uint8),
        covariance=np.broadcast_to(np.diag(NOISE_M**2), (*grid.corners, 3, 3)),
        ray_gap=np.zeros(grid.corners),
        **no_virtual_markers(grid),
    )


def reconstructed(
    model: ForceModel, moved: Iterable[Array], status: NDArray[np.uint8] | None = None
) -> list[ForceField]:
    """What a model makes of displacements, all markers measured unless `status` says otherwise."""
    found = []
    for displacement in moved:
        seen = status
        if seen is None:
            seen = np.full(displacement.shape[:2], Status.MEASURED, dtype=np.uint8)
        found.append(model.reconstruct(displacement, seen))
    return found


def errors_of(model: ForceModel, case: ForceCase, frames: int, scale: float = 1.0) -> ForceErrors:
    """Errors of a case with noise."""
    return ForceErrors.from_case(case, reconstructed(model, noisy(case, frames, scale)))


def oracle(model: ForceModel, case: ForceCase, frames: int) -> tuple[float, float]:
    """Errors of the distribution and of Fz, N, of a smoothing inverse that knows the support.

    Nodes where nothing truly acts are held at 0; order and length of the smoothness, how small
    the tangential force is expected to be, and the weight are those with the least error of the
    distribution.  What this misses, a better choice of contact nodes and of weight is not likely
    to reach.
    """
    nodes = model.elastic.nodes
    true = case.force_on_nodes
    support = np.flatnonzero(np.abs(true).sum(axis=1) > 1e-9 * np.abs(true).sum())
    columns = (3 * support[:, None] + np.arange(3)).ravel()
    noise = np.tile(NOISE_M, len(model.elastic.compliance) // 3)
    operator = model.elastic.compliance[:, columns] / noise[:, None]
    data = np.stack([moved.ravel() / noise for moved in noisy(case, frames)], axis=1)
    normal, right = operator.T @ operator, operator.T @ data
    collect = nodal_force_matrix(nodes)[:, support]
    best = np.inf, np.nan
    for penalty in _penalties(nodes, support):
        scaled = penalty * (np.trace(normal) / np.trace(penalty))
        # In the basis that makes both diagonal every weight costs a product.
        values, basis = eigh(normal, scaled, check_finite=False)
        parts = basis.T @ right
        for weight in ORACLE_WEIGHTS:
            found = basis @ (parts / (values + weight)[:, None])
            force = np.einsum("mk,kcf->mcf", collect, found.reshape(len(support), 3, -1))
            off = force - true[..., None]
            l2 = float(np.linalg.norm(off, axis=(0, 1)).mean() / np.linalg.norm(true))
            fz = np.abs(off[:, 2].sum(axis=0))
            best = min(best, (l2, float(np.quantile(fz, WITHIN, method="higher"))))
    return best


def outlined(model: ForceModel, case: ForceCase) -> float:
    """Error of the area, over the true one, that is outlined on the true forces of the nodes.

    What no better forces on these nodes can mend.
    """
    elastic, force = model.elastic, case.force_on_nodes
    area = elastic.nodes.spacing[0] * elastic.nodes.spacing[1] * elastic.node_stretch
    regions = ContactRegions(elastic.nodes, area)
    pressed = force[:, 2] < -PRESSED * np.abs(force[:, 2]).max()
    hills = regions.hills(force, pressed, elastic.node_position)
    exact = np.zeros((6, 6)), np.zeros((6, 6))
    found = regions.contacts(hills, [exact] * len(hills.nodes))
    return sum(item.area for item in found) / case.area - 1


def _penalties(nodes: SurfaceGrid, support: NDArray[np.intp]) -> Iterator[Array]:
    """Penalties of first and second order on the coefficients of the supporting hats."""
    mass_y, mass_x = (_tridiagonal(count, 2 / 3, 1 / 6) for count in (nodes.rows, nodes.cols))
    slope_y, slope_x = (_tridiagonal(count, 2.0, -1.0) for count in (nodes.rows, nodes.cols))
    slope = np.kron(mass_y, slope_x) / nodes.spacing[0] ** 2
    slope += np.kron(slope_y, mass_x) / nodes.spacing[1] ** 2
    for length in ORACLE_LENGTHS:
        first = np.kron(mass_y, mass_x) + length**2 * slope
        for one in (first, first @ first):
            for share in ORACLE_TANGENTIAL:
                yield np.kron(one[np.ix_(support, support)], np.diag([share**-2, share**-2, 1.0]))


def _tridiagonal(count: int, middle: float, beside: float) -> Array:
    return middle * np.eye(count) + beside * (np.eye(count, k=1) + np.eye(count, k=-1))


COMPONENTS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
# Of a normal distribution, within 1 and 2 standard deviations.
NORMAL_SHARES = (0.683, 0.954)
SMALL_LOADS_N = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class ErrorBars:
    """Errors in units of the standard deviations that were reported.

    wrench: (frames, 6).  nodes: (values,) of all components of nodes where force truly acts.
    loads: (frames,) N.
    """

    wrench: Array
    nodes: Array
    loads: Array

    @classmethod
    def from_cases(cls, model: ForceModel, cases: Sequence[ForceCase], frames: int) -> ErrorBars:
        """Of contacts at every load that was solved."""
        wrench, nodes, loads = [], [], []
        for case in cases:
            if case.material != LINEAR or case.newton > 10:
                continue
            acts = case.force_on_nodes[:, 2] < -0.02 * np.abs(case.force_on_nodes[:, 2]).max()
            for field in reconstructed(model, noisy(case, frames)):
                wrench.append((field.wrench - case.wrench) / field.random_std)
                loads.append(case.newton)
                if field.force_std is not None:
                    off = (field.force - case.force_on_nodes)[acts]
                    std = field.force_std[acts]
                    nodes.append((off[std > 0] / std[std > 0]).ravel())
        joined = np.concatenate(nodes) if nodes else np.zeros(0)
        return cls(np.array(wrench), joined, np.array(loads))


def false_contacts(model: ForceModel, frames: int, scale: float) -> int:
    """How many of so many frames of noise alone, times `scale`, show a contact."""
    random = np.random.default_rng(99)
    markers = model.elastic.markers
    shape = (markers.rows, markers.cols, 3)
    shown = 0
    for _ in range(frames):
        moved = scale * NOISE_M * random.standard_normal(shape)
        shown += bool(reconstructed(model, [moved])[0].contact.any())
    return shown


def seen_shares(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> dict[float, float]:
    """Share of frames in which the sphere is seen at all, by load, N.

    Below 0.2 N the displacement is that of 0.2 N on a linear gel times the load.
    """
    smallest = min(
        (case for case in cases if case.name == "sphere" and case.material == LINEAR),
        key=lambda case: case.newton,
    )
    found = {}
    for newton in SMALL_LOADS_N:
        factor = newton / smallest.newton
        case = replace(smallest, newton=newton, displacement=factor * smallest.displacement)
        fields = reconstructed(model, noisy(case, frames))
        found[newton] = float(np.mean([field.contact.any() for field in fields]))
    return found


@dataclass(frozen=True)
class Dependence:
    """Largest differences of a frame's wrench, in its deviations, that should change nothing.

    history: by where the recording begins.  pixel: by one corner, off by its noise in one frame,
    in that frame and those after it.
    """

    history: float
    pixel: float


def dependence(model: ForceModel) -> Dependence:
    """Of a smooth hollow made by hand, which no elastic gel shows, that deepens and is dragged."""
    history, pixel = [0.0], [0.0]
    markers = model.elastic.markers
    distance2 = (markers.points**2).sum(axis=1).reshape(markers.rows, markers.cols, 1)
    for seed, width in product(range(4), (2e-3, 2.6e-3, 3.2e-3)):
        random = np.random.default_rng(seed)
        hollow = np.exp(-distance2 / (2 * width**2))
        deep = [hollow * [0.0, 0.0, -depth] for depth in np.linspace(1e-4, 1e-3, 10)]
        dragged = [hollow * [drag, 0.0, -1e-3] for drag in (2e-4, 4e-4)]
        frames = [
            moved + NOISE_M * random.standard_normal(moved.shape) for moved in (*deep, *dragged)
        ]
        model.reset()
        expected = reconstructed(model, frames)
        for start in range(1, len(frames)):
            model.reset()
            found = reconstructed(model, frames[start : start + 3])
            history += [_ratio(*pair) for pair in zip(found, expected[start:], strict=False)]
            spoilt = frames[start : start + 3]
            corner = tuple(
                random.integers(count // 4, 3 * count // 4) for count in hollow.shape[:2]
            )
            spoilt[0] = spoilt[0].copy()
            spoilt[0][corner] += NOISE_M * random.standard_normal(3)
            found = reconstructed(model, spoilt)
            pixel += [_ratio(*pair) for pair in zip(found, expected[start:], strict=False)]
    return Dependence(float(np.max(history)), float(np.max(pixel)))


def _ratio(field: ForceField, other: ForceField) -> float:
    std = np.minimum(field.random_std, other.random_std)
    return float(np.max(np.abs(field.wrench - other.wrench) / std))
