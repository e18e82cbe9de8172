"""From nodal forces to a force field: contacts, resultant wrench, error bars, flags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation, binary_propagation

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.force.contact_regions import (
    ContactRegions,
    material_covariance,
    resultant_matrix,
    wrench_of,
)
from cmp_tactile_processing.force.measurements import Measurements, Whitening
from cmp_tactile_processing.force.solution import ForceSolution, ForceSolver
from cmp_tactile_processing.measured import (
    Contact,
    ForceField,
    ForceFlag,
    SlipState,
    SurfaceGrid,
)
from cmp_tactile_processing.sensor.description import SensorDescription

# Share of the markers under a contact, or of those around it, that may be missing before it is
# reported.
HIDDEN_SHARE = 0.2
# A node is seen where so large a share of the markers around it is.
MOSTLY_SEEN = 0.5
# The fit is poor where it leaves so large a share of the displacement, and so many times the noise.
POOR_SHARE, POOR_NOISE = 0.2, 3.0
# Of what model_error says, so much is in directions in which no force acts: near the border the
# mesh takes 0.06 % of a press for a force along the surface.
LEAK_SHARE = 0.2
# Seen aslant by one view a press looks like a shift: forces are known to such shares of their size.
ONE_VIEW_SHARE = 0.3, 0.3, 1.0

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]


class FieldBuilder:
    """Says all that a solution means, for one sensor."""

    def __init__(
        self,
        sensor: SensorDescription,
        elastic: ElasticModel,
        solver: ForceSolver,
        whitening: Whitening,
    ) -> None:
        self._sensor, self._elastic, self._solver = sensor, elastic, solver
        self._whitening = whitening
        nodes = elastic.nodes
        self._position = elastic.node_position
        self._every = np.arange(len(self._position))
        error, record = sensor.force.model_error, sensor.elastomer.calibration
        stated = (0.0, 0.0) if record is None else (record.normal_std, record.tangential_std)
        material = float(np.hypot(error, stated[0])), float(np.hypot(error, stated[1]))
        height = float(sensor.elastomer.size[2])
        self._doubt = float(error), material, height, bool(whitening.depth_seen)
        area = nodes.spacing[0] * nodes.spacing[1] * elastic.node_stretch
        self._regions = ContactRegions(nodes, area)
        self._to_nodes = interpolation_matrix(elastic.markers, nodes)
        of_all = np.column_stack([self._position, np.ones(len(self._position))])
        self._rest_covariance = solver.rest_covariance(resultant_matrix(of_all[:, None].copy()))
        # Compiled here, before the first frame.
        _model_covariance(self._position, self._position, self._every, *self._doubt)

    def field(
        self, solution: ForceSolution, measured: Measurements, moved: Array, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution; moved (nodes, 3) m: how far its forces have moved."""
        force, place = solution.force, self._position + moved
        wrench = wrench_of(force, place, self._every)
        contact = self._solver.rule.pressed(force, solution.force_std[:, 2]) & solution.loaded
        contacts: tuple[Contact, ...] = ()
        covariance, area = np.full((6, 6), np.nan), float("nan")
        if measured.contacts:
            contacts, covariance = self._contacts(solution, measured.valid, place, contact)
            area = float(sum(item.area for item in contacts))
            of_some = np.zeros(len(force), dtype=bool)
            for item in contacts:
                of_some[item.nodes] = True
            contact &= of_some
        pressing = np.where(contact, np.minimum(force[:, 2], 0.0), 0.0)
        total = pressing.sum()
        none = not contact.any()
        relative = self._sensor.force.model_error * np.abs(force)
        return self._new_field(
            force=force,
            force_std=np.hypot(solution.force_std, relative),
            contact=contact,
            wrench=wrench,
            wrench_covariance=covariance,
            contact_area=area,
            centre_of_pressure=np.full(3, np.nan) if none else pressing @ place / total,
            contacts=contacts,
            slip_state=SlipState.NO_CONTACT if none else SlipState.UNKNOWN,
            valid_fraction=measured.valid,
            regularization=float(np.sqrt(solution.first.weight)),
            flags=flag | self._flags(solution, measured, contacts),
            noise_scale=float(np.sqrt(solution.noise_squared)),
        )

    def _contacts(
        self, solution: ForceSolution, valid: float, place: Array, pressed: Mask
    ) -> tuple[tuple[Contact, ...], Array]:
        """The contacts among pressed nodes, and the covariance (6, 6) of the whole wrench."""
        hills = self._regions.hills(solution.force, pressed, place)
        whole, *of_hills = self._covariances(solution, valid, place, hills.nodes)
        return self._regions.contacts(hills, of_hills), whole[0] + whole[1]

    def unknown(self, valid: float, why: ForceFlag) -> ForceField:
        """A field of NaN; valid: share of the markers that are seen."""
        force = np.full(self._position.shape, np.nan)
        return self._new_field(
            force=force,
            force_std=force,
            contact=np.zeros(len(force), dtype=bool),
            wrench=np.full(6, np.nan),
            contact_area=float("nan"),
            centre_of_pressure=np.full(3, np.nan),
            slip_state=SlipState.UNKNOWN,
            valid_fraction=valid,
            regularization=float("nan"),
            flags=why,
        )

    def _covariances(
        self, solution: ForceSolution, valid: float, place: Array, parts: list[Numbers]
    ) -> list[tuple[Array, Array]]:
        """Covariance (6, 6) of the whole wrench and of that of some nodes each, by noise alone.

        With it all that comes to it: what resolution, scale, edge and the model leave open.
        valid: share of the markers that are seen.
        """
        sets = [self._every, *parts]
        if solution.posterior is None:
            # That of all nodes, for want of a better one; fewer markers average less noise.
            noise = solution.noise_squared / valid * self._rest_covariance
            found = [(noise, np.zeros((6, 6)))] * len(sets)
        else:
            functionals = self._solver.functionals(place, sets, solution.posterior.nodes)
            noise, doubt = solution.posterior.covariances(functionals)
            blocks = [slice(6 * k, 6 * k + 6) for k in range(len(sets))]
            found = [(noise[block, block], doubt[block, block]) for block in blocks]
        of_model = [_model_covariance(solution.force, place, nodes, *self._doubt) for nodes in sets]
        return [(noise, more + model) for (noise, more), model in zip(found, of_model, strict=True)]

    def _flags(
        self, solution: ForceSolution, measured: Measurements, contacts: tuple[Contact, ...]
    ) -> ForceFlag:
        flags = ForceFlag.NONE
        if any(item.at_border for item in contacts) or self._border_bears(solution):
            flags |= ForceFlag.AT_BORDER
        if not measured.known[2::3].any():
            flags |= ForceFlag.NO_DEPTH
        seen = self._seen(measured.known)
        if self._hidden(contacts, seen):
            flags |= ForceFlag.HIDDEN_CONTACT
        if self._sensor.pattern.border == "beyond_view" and self._hidden(
            contacts, ~_reaching_border(~seen)
        ):
            flags |= ForceFlag.AT_BORDER
        misfit = (measured.data - solution.predicted.ravel())[measured.known]
        left, whole = (np.sqrt(part @ part / len(part)) for part in (misfit, measured.data))
        if left > POOR_NOISE and left > POOR_SHARE * whole:
            flags |= ForceFlag.POOR_FIT
        return flags

    def _border_bears(self, solution: ForceSolution) -> bool:
        """Whether something presses, pulls or drags at the edge of the marker area."""
        bearing = self._solver.rule.bearing(solution.force, solution.force_std[:, 2])
        return solution.loaded and bool((bearing & self._regions.border).any())

    def _seen(self, known: Mask) -> Mask:
        """Nodes (rows, cols) about which at least half of the markers are known, (3 markers,)."""
        nodes = self._elastic.nodes
        if known.all():
            return np.ones((nodes.rows, nodes.cols), dtype=bool)
        share = self._to_nodes @ known.reshape(-1, 3).any(axis=1).astype(np.float64)
        return np.asarray(share.reshape(nodes.rows, nodes.cols) >= MOSTLY_SEEN)

    def _hidden(self, contacts: tuple[Contact, ...], seen: Mask) -> bool:
        """Whether much of a contact is hidden, or of what is around it: it may be larger.

        seen (rows, cols): of the nodes.
        """
        if seen.all():
            return False
        for item in contacts:
            inside = np.zeros_like(seen)
            inside.ravel()[item.nodes] = True
            around = binary_dilation(inside, np.ones((3, 3))) & ~inside
            for part in (inside, around):
                if part.any() and float(seen[part].mean()) < 1 - HIDDEN_SHARE:
                    return True
        return False

    def _new_field(self, **values: object) -> ForceField:
        elastomer, nodes = self._sensor.elastomer, self._elastic.nodes
        return ForceField(
            rows=nodes.rows,
            cols=nodes.cols,
            position=self._position,
            reference_point=np.zeros(3),
            young=elastomer.young,
            poisson=elastomer.poisson,
            **values,  # type: ignore[arg-type]
        )


@kernel
def _model_covariance(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    force: Array, place: Array, nodes: Numbers, error: float, material: tuple[float, float],
    height: float, depth_seen: bool,
) -> Array:  # fmt: skip
    """What the model and its calibration leave open of the wrench of some nodes (k,), (6, 6).

    force (M, 3) N, place (M, 3) m: of all nodes.  error: of the model; material: of the normal and
    of the tangential scale; all relative.  height: of the gel, m.
    """
    wrench = wrench_of(force, place, nodes)
    centre, total = np.zeros(3), 0.0
    for n in nodes:
        size = np.sqrt(force[n, 0] ** 2 + force[n, 1] ** 2 + force[n, 2] ** 2)
        total += size
        for c in range(3):
            centre[c] += size * place[n, c]
    if total > 0:
        centre /= total
    found: Array = material_covariance(wrench, centre, material[0], material[1])
    across = np.hypot(wrench[0], wrench[1])
    size = np.hypot(across, wrench[2])
    # Where the forces act is as uncertain as the mesh that says how far they have moved.
    for i, acting in enumerate((size, size, across)):
        found[3 + i, 3 + i] += (error * height * acting) ** 2
    leaking = LEAK_SHARE * error * total * resultant_matrix(np.append(centre, 1.0).reshape(1, 1, 4))
    for i in range(6):
        for j in range(6):
            for c in range(3):
                found[i, j] += leaking[i, c] * leaking[j, c]
    if not depth_seen:
        reach = height + np.sqrt(np.sum(centre**2))
        for i in range(6):
            share = ONE_VIEW_SHARE[i] if i < 3 else reach
            found[i, i] += (size * share) ** 2
    return found


def _reaching_border(hidden: Mask) -> Mask:
    """Of hidden nodes (rows, cols) those that hang together with hidden ones at the edge."""
    edge = np.ones_like(hidden)
    edge[1:-1, 1:-1] = False
    return np.asarray(binary_propagation(hidden & edge, mask=hidden))


def doubted(field: ForceField, relative: float) -> ForceField:
    """The same with a relative standard deviation on top of all error bars."""

    def wider(wrench: Array, covariance: Array) -> Array:
        return np.asarray(covariance + relative**2 * np.outer(wrench, wrench))

    std = field.force_std
    return replace(
        field,
        force_std=None if std is None else np.hypot(std, relative * np.abs(field.force)),
        wrench_covariance=wider(field.wrench, field.wrench_covariance),
        contacts=tuple(
            replace(item, covariance=wider(item.wrench, item.covariance)) for item in field.contacts
        ),
    )


def interpolation_matrix(source: SurfaceGrid, target: SurfaceGrid) -> sparse.csr_array:
    """Bilinear interpolation from the points of one grid to those of another, (target, source).

    Points outside the source grid take the value at its edge.
    """
    rows, cols = _line(source.y, target.y), _line(source.x, target.x)
    matrix = sparse.csr_array(sparse.kron(rows, cols))
    matrix.eliminate_zeros()
    return matrix


def _line(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear interpolation along one axis, (target, source)."""
    return np.stack([np.interp(target, source, row) for row in np.eye(len(source))], axis=1)
