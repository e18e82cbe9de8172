"""From the displacement of the markers to the force that the object exerts.

A field has contacts, resultant wrench, error bars and flags.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation, binary_propagation

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem
from cmp_tactile_processing.errors import NotConvergedError
from cmp_tactile_processing.force.contact_regions import (
    ContactRegions,
    centre_of_forces,
    material_covariance,
    resultant_matrix,
    wrench_of,
)
from cmp_tactile_processing.force.large_press import LargePress, settle
from cmp_tactile_processing.force.measurements import Measurements, Whitening
from cmp_tactile_processing.force.plausibility import Plausibility
from cmp_tactile_processing.force.solution import ForceSolution, ForceSolver
from cmp_tactile_processing.force.systematics import SystematicErrors
from cmp_tactile_processing.measured import (
    Contact,
    ForceField,
    ForceFlag,
    SlipState,
    SurfaceGrid,
    Systematics,
)
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription

# Share of the markers under a contact, or of those around it, that may be missing before it is
# reported.
HIDDEN_SHARE = 0.2
# A node is seen where so large a share of the markers around it is.
MOSTLY_SEEN = 0.5
# The fit is poor if its residual exceeds this share of the displacement and this many times the
# noise, of the description or of the frame, whichever is larger.
MAX_RESIDUAL_SHARE = 0.2
MAX_RESIDUAL_NOISE = 3.0
# Of what model_error says, so much is in directions in which no force acts: near the border the
# mesh takes 0.06 % of a press for a force along the surface.
LEAK_SHARE = 0.2
# Seen aslant by one view a press looks like a shift: forces are known to such shares of their size.
ONE_VIEW_SHARE = 0.3, 0.3, 1.0
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]
# Depth over the thickness above which a gel is not linear.  A neo-Hookean gel then shows at least
# 1 % too little Fz.
LARGE_PRESS_RATIO = 0.023
# The linear description is used up to where any rubber shows 4 to 7 % too little.
LARGE_PRESS_RATIO_LINEAR = 0.15
# A press that the correction could not follow is tried again when it is so much less.
RETRY_SHARE = 0.97
# Data that differ by less than this share are solved for on the same nodes, for the same scale.
SAME_SHARE = 0.01
# Pressed in by less than this share of the thickness, the linear model is off by 0.3 % of Fz.
SMALL_PRESS_RATIO = 1.5e-3
# Relative standard deviation of a linear force over the depth ratio: spheres and flats pressed in
# by 2 to 12 % of the thickness lose 0.3 to 0.5 of that share.
LINEAR_STD_PER_DEPTH_RATIO = 0.5


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
        error, height = float(sensor.force.model_error), float(sensor.elastomer.size[2])
        self._doubt = error, height, bool(whitening.depth_seen)
        area = nodes.spacing[0] * nodes.spacing[1] * elastic.node_stretch
        self._regions = ContactRegions(nodes, area)
        self._to_nodes = interpolation_matrix(elastic.markers, nodes)
        of_all = np.column_stack([self._position, np.ones(len(self._position))])
        self._rest_covariance = solver.rest_covariance(resultant_matrix(of_all[:, None].copy()))

    def field(
        self, solution: ForceSolution, measured: Measurements, moved: Array, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution; moved (nodes, 3) m: how far its forces have moved."""
        force, place = solution.force, self._position + moved
        wrench = wrench_of(force, place, self._every)
        # Of one view noise alone counts: that the size of all forces is open hides no contact.
        seen = self._whitening.depth_seen
        normal_std = solution.force_std[:, 2] if seen else solution.first.nodal_std
        contact = self._solver.rule.pressed(force, normal_std) & solution.loaded
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
        is_poor = left > MAX_RESIDUAL_NOISE and left > MAX_RESIDUAL_SHARE * whole
        if is_poor and not left < MAX_RESIDUAL_NOISE * measured.stated_noise():
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
    force: Array, place: Array, nodes: Numbers, error: float, height: float, depth_seen: bool
) -> Array:  # fmt: skip
    """What the model leaves open of the wrench of some nodes (k,), (6, 6).

    force (M, 3) N, place (M, 3) m: of all nodes.  error: of the model, relative.  height: of the
    gel, m.
    """
    wrench = wrench_of(force, place, nodes)
    centre, total = centre_of_forces(force, place, nodes)
    found: Array = material_covariance(wrench, centre, error, error)
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


class ForceModel:
    """Reconstructs force by inverting the elastic model of a sensor's gel (paper, V.D).

    A first pass solves for a smooth traction on the whole surface, a second one for that on the
    nodes found in contact; noise, sizes and smoothness follow from each frame itself.
    cache_dir, progress: see ElasticModel.  Raises InputError for a block without a base.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        self._sensor, self._parameters = sensor, sensor.force
        self.elastic = ElasticModel(sensor, cache_dir, progress)
        nodes, markers = self.elastic.nodes, self.elastic.markers
        self._whitening = Whitening(sensor, markers)
        response = self.elastic.compliance / self._whitening.noise[:, None]
        if not self._whitening.depth_seen:
            response[2::3] = 0.0
        with one_thread():
            self._solver = ForceSolver(markers, nodes, response, self._parameters)
            self._builder = FieldBuilder(sensor, self.elastic, self._solver, self._whitening)
        self._systematics = SystematicErrors(sensor)
        self._plausibility = Plausibility(sensor, markers)
        self._large = self._large_press(cache_dir, progress)
        self._out_of_reach = np.inf

    def _large_press(
        self, cache_dir: Path | None, progress: OnProgress | None
    ) -> LargePress | None:
        choice, elastomer = self._parameters.large_press, self._sensor.elastomer
        if choice == "off" or (choice == "auto" and elastomer.model != "neo_hookean"):
            return None
        problem = ElasticProblem.from_sensor(self._sensor)
        return LargePress(problem, elastomer.young, cache_dir, progress)

    def reconstruct(
        self,
        displacement: Array,
        status: NDArray[np.uint8],
        covariance: Array | None = None,
        *,
        contacts: bool = True,
        systematics: Systematics | None = None,
    ) -> ForceField:
        """Force on the gel from the displacement of the markers.

        displacement (rows, cols, 3) m, gel frame; status (rows, cols); covariance (rows, cols, 3,
        3) m^2 of the displacement: markers that are much less certain than most are left out,
        unless they have moved ten times as far.
        A marker with status 0, one that moved farther than the gel is large, and any component
        that is not finite count as not measured.  Too few markers give a field of NaN, and so does
        what no gel can show.  contacts: without them the contacts, their area and flags, and the
        wrench's covariance stay unknown, and `contact` is every node that is pressed, by noise too;
        that saves a third of the time.  systematics: errors of all displacements beside those of
        `covariance`.  Raises InputError for arrays of other shapes.
        """
        field = self.reconstruct_random(displacement, status, covariance, contacts=contacts)
        return self.with_systematic(field, systematics)

    def with_systematic(self, field: ForceField, systematics: Systematics | None) -> ForceField:
        """The field with systematic errors in its error bars, and flagged by them."""
        field = self._systematics.add(field, systematics)
        if self._systematics.scale_is_uncertain:
            return replace(field, flags=field.flags | ForceFlag.SCALE_UNCERTAIN)
        return field

    def reconstruct_random(
        self,
        displacement: Array,
        status: NDArray[np.uint8],
        covariance: Array | None = None,
        *,
        contacts: bool = True,
    ) -> ForceField:
        """The same with error bars of what differs from frame to frame alone.

        What compares frames, or forces of one frame, needs these.
        """
        measured = self._whitening.measurements(displacement, status, covariance)
        measured = measured._replace(contacts=contacts)
        if measured.valid < self._parameters.min_valid_fraction or not measured.known.any():
            return self._builder.unknown(measured.valid, ForceFlag.FEW_MARKERS)
        if not self._plausibility.allows_displacement(self._in_metres(measured, measured.data)):
            self.reset()
            return self._builder.unknown(measured.valid, ForceFlag.IMPLAUSIBLE)
        with one_thread():
            solution = self._solver.solve(measured.data, measured.known)
            small = self._depth_of(solution) < SMALL_PRESS_RATIO
            if small:
                self._out_of_reach = np.inf
            if self._large is None or small:
                return self._linear_field(solution, measured, ForceFlag.NONE)
            return self._corrected(solution, measured, self._large)

    def _in_metres(self, measured: Measurements, data: Array) -> Array:
        return self._whitening.in_metres(data, measured.known)

    def _depth_of(self, solution: ForceSolution) -> float:
        """How far the markers are pressed in, as a share of the gel's thickness."""
        depth = float(np.abs(solution.predicted[:, 2]).max()) * self._parameters.noise_depth
        return depth / self._sensor.elastomer.size[2]

    def _corrected(
        self, linear: ForceSolution, measured: Measurements, large: LargePress
    ) -> ForceField:
        """The field with what large strain does taken out; the linear one where that fails."""
        found, size = linear, float(np.linalg.norm(linear.force, axis=1).max())
        solved: Array | None = None
        # To find that there is no equilibrium takes long: not again before the press is less, where
        # it is hardest, as that is where the gel folds.
        if size > self._out_of_reach:
            return self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)

        def solve(moved: Array) -> Array:
            nonlocal found, solved
            data = self._whitening.in_noise(moved, measured.known)
            if solved is not None and _is_near(data, solved):
                found = self._solver.again(found, data, measured.known)
            else:
                found, solved = self._solver.solve(data, measured.known), data
            return found.coefficient

        moved = self._in_metres(measured, measured.data)
        noise = self._parameters.noise_in_plane * float(np.sqrt(linear.noise_squared))
        try:
            _, settled = settle(solve, large.excess, moved, large.latest, noise)
        except NotConvergedError:
            field = self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)
            if ForceFlag.IMPLAUSIBLE not in field.flags:
                self._out_of_reach = RETRY_SHARE * size
            return field
        self._out_of_reach = np.inf
        flag = ForceFlag.NONE if settled else ForceFlag.NOT_CONVERGED
        # What is fitted now is the measured displacement without the excess.
        data = measured.data - self._whitening.in_noise(large.latest, measured.known)
        found = self._solver.completed(found)
        corrected = self._field(found, measured._replace(data=data), large.moved, flag)
        if ForceFlag.IMPLAUSIBLE in corrected.flags:
            self.reset()
            return corrected
        return replace(corrected, corrected=True)

    def _linear_field(
        self, linear: ForceSolution, measured: Measurements, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution as it is, in doubt as far as the gel strains beyond linearly."""
        moved = self.elastic.node_displacement(linear.coefficient)
        field = self._field(linear, measured, moved, flag)
        if self._sensor.elastomer.model == "linear":
            return field
        return field.with_errors(relative=LINEAR_STD_PER_DEPTH_RATIO * self._depth_of(linear))

    def reset(self) -> None:
        """Forget where a large press has settled; all else is of one frame alone."""
        self._out_of_reach = np.inf
        if self._large is not None:
            self._large.reset()

    def _field(
        self, solution: ForceSolution, measured: Measurements, moved: Array, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution; moved (nodes, 3) m: how far its forces have moved."""
        unexplained = self._in_metres(measured, measured.data - solution.predicted.ravel())
        if self._parameters.regularization:
            # A chosen smoothness leaves what it smooths away, however well the gel is described.
            unexplained = 0.0 * unexplained
        if not self._plausibility.allows_force(solution.force, unexplained):
            return self._builder.unknown(measured.valid, ForceFlag.IMPLAUSIBLE)
        linear = self._sensor.elastomer.model == "linear"
        most = LARGE_PRESS_RATIO_LINEAR if linear else LARGE_PRESS_RATIO
        if self._large is None and self._depth_of(solution) > most:
            flag |= ForceFlag.LARGE_PRESS
        return self._builder.field(solution, measured, moved, flag)


def _is_near(data: Array, other: Array) -> bool:
    return float(np.linalg.norm(data - other)) <= SAME_SHARE * float(np.linalg.norm(other))
