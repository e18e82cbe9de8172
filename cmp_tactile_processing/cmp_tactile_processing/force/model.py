"""Force stage: from the displacement of the markers to the force that the object exerts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.elastic.equilibrium import NoEquilibriumError
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem, Progress
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.contact_regions import (
    ContactRegions,
    material_covariance,
    resultant_matrix,
    wrench_of,
)
from cmp_tactile_processing.force.large_press import GradualSettling, LargePress, settle
from cmp_tactile_processing.force.plausibility import Plausibility
from cmp_tactile_processing.force.solution import ForceSolution, ForceSolver
from cmp_tactile_processing.measured import (
    Contact,
    ForceField,
    ForceFlag,
    SlipState,
    Status,
    SurfaceGrid,
)
from cmp_tactile_processing.sensor.description import SensorDescription

# A marker whose deviation is so many times the median's shows next to nothing.
MUCH_NOISIER = 4.0
# Share of the markers under a contact that may be missing before it is reported.
HIDDEN_SHARE = 0.2
# The linear model is off by about 4 % of Fz where the surface is pressed in by this share of the
# thickness.
LARGE_PRESS_RATIO = 0.023
# The fit is poor where it leaves so large a share of the displacement, and so many times the noise.
POOR_SHARE, POOR_NOISE = 0.2, 3.0
# A press that the correction could not follow is tried again when it is so much less.
RETRY_SHARE = 0.97
# Data that differ by less than this share are solved for on the same nodes, for the same scale.
SAME_SHARE = 0.01
# Of what model_error says, so much is in directions in which no force acts: near the border the
# mesh takes 0.06 % of a press for a force along the surface.
LEAK_SHARE = 0.2
# Seen aslant by one view a press looks like a shift: forces are known to such shares of their size.
ONE_VIEW_SHARE = 0.3, 0.3, 1.0
# Pressed in by less than this share of the thickness, the linear model is off by 0.3 % of Fz.
SMALL_PRESS_RATIO = 1.5e-3
# Spheres and flats pressed in by 2 to 12 % of the thickness lose 0.3 to 0.6 of that share.
LINEAR_DOUBT = 0.5
# Where less of the displacement is open, error bars say it and no flag: noise alone asks for that.
SETTLED_SHARE = 5e-3


Array = NDArray[np.float64]


class _Measured(NamedTuple):
    """data (3 markers,) in units of the noise, known (3 markers,), valid: share of the markers."""

    data: NDArray[np.float64]
    known: NDArray[np.bool_]
    valid: float


class ForceModel:
    """Reconstructs force by inverting the elastic model of a sensor's gel (paper, V.D).

    A first pass solves for a smooth traction on the whole surface, a second one for that on the
    nodes found in contact; noise, sizes and smoothness follow from each frame itself.
    cache_dir, progress: see ElasticModel.  large_press_steps: of the correction for large presses
    in one frame, so that it may take several and the force is the linear one until then; 0: until
    it has settled.  Raises GeometryError for a block without a base.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: Progress | None = None,
        large_press_steps: int = 0,
    ) -> None:
        self._sensor = sensor
        self._parameters = parameters = sensor.force
        self.elastic = ElasticModel(sensor, cache_dir, progress)
        nodes, markers = self.elastic.nodes, self.elastic.markers
        self._depth_seen = len(sensor.views) > 1
        one = (parameters.noise_in_plane, parameters.noise_in_plane, parameters.noise_depth)
        self._noise = np.tile(one, markers.rows * markers.cols)
        response = self.elastic.compliance / self._noise[:, None]
        if not self._depth_seen:
            response[2::3] = 0.0
        self._position = self.elastic.node_position
        self._area = nodes.spacing[0] * nodes.spacing[1] * self.elastic.node_stretch
        self._to_nodes = interpolation_matrix(markers, nodes)
        with one_blas_thread():
            self._solver = ForceSolver(markers, nodes, response, parameters)
            of_all = resultant_matrix(self._position, np.ones(len(self._position)))
            self._rest_covariance = self._solver.rest_covariance(of_all)
        self._regions = ContactRegions(nodes, self._area)
        self._plausibility = Plausibility(sensor, markers)
        self._large = self._large_press(cache_dir, progress)
        self._gradual: GradualSettling | None = None
        if self._large is not None and large_press_steps:
            self._gradual = GradualSettling(self._large, large_press_steps)
        self._out_of_reach = np.inf
        # What this keeps is made here, before the first frame.
        self.elastic.node_displacement(np.ones(self._position.shape))

    def _large_press(self, cache_dir: Path | None, progress: Progress | None) -> LargePress | None:
        choice, elastomer = self._parameters.large_press, self._sensor.elastomer
        if choice == "off" or (choice == "auto" and elastomer.model != "neo_hookean"):
            return None
        problem = ElasticProblem.from_sensor(self._sensor)
        return LargePress(problem, elastomer.young, cache_dir, progress)

    def reconstruct(
        self,
        displacement: NDArray[np.float64],
        status: NDArray[np.uint8],
        covariance: NDArray[np.float64] | None = None,
    ) -> ForceField:
        """Force on the gel from the displacement of the markers.

        displacement (rows, cols, 3) m, gel frame; status (rows, cols); covariance (rows, cols, 3,
        3) m^2 of the displacement: markers that are much less certain than most are left out.
        A marker with status 0, one that moved farther than the gel is large, and any component
        that is not finite count as not measured.  Too few markers give a field of NaN, and so does
        what no gel can show.  Raises GeometryError for arrays of other shapes.
        """
        measured = self._measurements(displacement, status, covariance)
        if measured.valid < self._parameters.min_valid_fraction or not measured.known.any():
            return self._unknown(measured.valid, ForceFlag.FEW_MARKERS)
        if not self._plausibility.allows_displacement(self._known_of(measured, measured.data)):
            self.reset()
            return self._unknown(measured.valid, ForceFlag.IMPLAUSIBLE)
        with one_blas_thread():
            solution = self._solver.solve(measured.data, measured.known)
            small = self._depth_of(solution) < SMALL_PRESS_RATIO
            if small:
                self._out_of_reach = np.inf
            if self._large is None or small:
                return self._linear_field(solution, measured, ForceFlag.NONE)
            return self._corrected(solution, measured, self._large)

    def _known_of(self, measured: _Measured, data: NDArray[np.float64]) -> NDArray[np.float64]:
        """Data (3 markers,) in m, (rows, cols, 3), NaN where nothing was measured."""
        shape = self.elastic.markers.rows, self.elastic.markers.cols, 3
        return np.where(measured.known, data * self._noise, np.nan).reshape(shape)

    def _depth_of(self, solution: ForceSolution) -> float:
        """How far the markers are pressed in, as a share of the gel's thickness."""
        depth = float(np.abs(solution.predicted[:, 2]).max()) * self._parameters.noise_depth
        return depth / self._sensor.elastomer.size[2]

    def _corrected(
        self, linear: ForceSolution, measured: _Measured, large: LargePress
    ) -> ForceField:
        """The field with what large strain does taken out; the linear one where that fails."""
        found, size = linear, float(np.linalg.norm(linear.force, axis=1).max())
        solved = None if self._gradual is None else measured.data
        # To find that there is no equilibrium takes long: not again before the press is less, where
        # it is hardest, as that is where the gel folds.
        if size > self._out_of_reach:
            return self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)

        def solve(moved: NDArray[np.float64]) -> NDArray[np.float64]:
            nonlocal found, solved
            data = np.where(measured.known, moved.ravel() / self._noise, 0.0)
            if solved is not None and _is_near(data, solved):
                found = self._solver.again(found, data, measured.known)
            else:
                found, solved = self._solver.solve(data, measured.known), data
            return found.coefficient

        moved = self._known_of(measured, measured.data)
        noise = self._parameters.noise_in_plane * float(np.sqrt(linear.noise_squared))
        # What is open by more is no better than the linear force, which is doubted by twice that.
        worth, left = LINEAR_DOUBT / 2 * self._depth_of(linear), 0.0
        try:
            if self._gradual is None:
                _, settled = settle(solve, large.excess, moved, large.latest, noise)
            else:
                left = self._gradual.follow(solve, moved, noise, worth)
                settled = left <= SETTLED_SHARE
        except NoEquilibriumError:
            field = self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)
            if ForceFlag.IMPLAUSIBLE not in field.flags:
                self._out_of_reach = RETRY_SHARE * size
            return field
        self._out_of_reach = np.inf
        if left > worth:
            return self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)
        flag = ForceFlag.NONE if settled else ForceFlag.NOT_CONVERGED
        # What is fitted now is the measured displacement without the excess.
        excess = large.latest if self._gradual is None else self._gradual.taken_off
        data = np.where(measured.known, measured.data - excess.ravel() / self._noise, 0.0)
        found = self._solver.completed(found)
        corrected = self._field(found, measured._replace(data=data), large.moved, flag)
        if ForceFlag.IMPLAUSIBLE in corrected.flags:
            self.reset()
            if left:
                return self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)
            return corrected
        return replace(_doubted(corrected, left) if left else corrected, corrected=True)

    def _linear_field(
        self, linear: ForceSolution, measured: _Measured, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution as it is, in doubt as far as the gel strains beyond linearly."""
        moved = self.elastic.node_displacement(linear.coefficient)
        field = self._field(linear, measured, moved, flag)
        if self._sensor.elastomer.model == "linear":
            return field
        return _doubted(field, LINEAR_DOUBT * self._depth_of(linear))

    def reset(self) -> None:
        """Forget where a large press has settled; all else is of one frame alone."""
        self._out_of_reach = np.inf
        for large in (self._large, self._gradual):
            if large is not None:
                large.reset()

    def _measurements(
        self,
        displacement: NDArray[np.float64],
        status: NDArray[np.uint8],
        covariance: NDArray[np.float64] | None,
    ) -> _Measured:
        shape = self.elastic.markers.rows, self.elastic.markers.cols
        moved, states = np.asarray(displacement, dtype=np.float64), np.asarray(status)
        expected: list[tuple[str, NDArray[Any], tuple[int, ...]]] = [
            ("displacement", moved, (*shape, 3)),
            ("status", states, shape),
        ]
        if covariance is not None:
            expected.append(("covariance", np.asarray(covariance), (*shape, 3, 3)))
        for name, found, wanted in expected:
            if found.shape != wanted:
                msg = f"{self._sensor.name}: {name}: found shape {found.shape}, expected {wanted}"
                raise GeometryError(msg)
        moved = within_reach(moved, self._sensor).reshape(-1, 3)
        known = np.isfinite(moved) & (states.reshape(-1, 1) != Status.MISSING.value)
        if covariance is not None:
            variance = np.einsum("ijkk->ij", covariance).reshape(-1, 1)
            stated = np.isfinite(variance) & (variance > 0)
            seen = stated & known.any(axis=1, keepdims=True)
            if seen.any():
                most = MUCH_NOISIER**2 * np.median(variance[seen])
                known &= ~stated | (variance <= most)
        if not self._depth_seen:
            known[:, 2] = False
        valid = np.count_nonzero(known.any(axis=1)) / len(known)
        known = known.ravel()
        return _Measured(np.where(known, moved.ravel() / self._noise, 0.0), known, valid)

    def _field(
        self,
        solution: ForceSolution,
        measured: _Measured,
        moved: NDArray[np.float64],
        flag: ForceFlag,
    ) -> ForceField:
        """The field of a solution; moved (nodes, 3) m: how far its forces have moved."""
        force, noise, valid = solution.force, solution.noise_squared, measured.valid
        unexplained = self._known_of(measured, measured.data - solution.predicted.ravel())
        if self._parameters.regularization:
            # A chosen smoothness leaves what it smooths away, however well the gel is described.
            unexplained = 0.0 * unexplained
        if not self._plausibility.allows_force(force, unexplained):
            return self._unknown(valid, ForceFlag.IMPLAUSIBLE)
        place = self._position + moved
        wrench = wrench_of(force, place)
        of_all: list[tuple[Array, Array]] = []

        def of_some(sets: list[NDArray[np.intp]]) -> list[tuple[Array, Array]]:
            # All in one, as what is solved for several costs little more than for one.
            every = np.arange(len(force))
            found = self._covariances(solution, valid, place, [every, *sets])
            of_all.append(found[0])
            return found[1:]

        pressed = self._solver.rule.pressed(force, solution.force_std[:, 2]) & solution.loaded
        contacts = tuple(
            self._with_model_error(item, force, place)
            for item in self._regions.contacts(force, pressed, place, of_some)
        )
        if not of_all:
            of_some([])
        covariance = sum(of_all[0]) + self._model_covariance(wrench, place, force)
        contact = np.zeros(len(force), dtype=bool)
        for item in contacts:
            contact[item.nodes] = pressed[item.nodes]
        flags = flag | self._flags(solution, measured, contacts)
        pressing = np.where(contact, np.minimum(force[:, 2], 0.0), 0.0)
        total = pressing.sum()
        none = not contact.any()
        relative = self._parameters.model_error * np.abs(force)
        return self._new_field(
            force=force,
            force_std=np.hypot(solution.force_std, relative),
            contact=contact,
            wrench=wrench,
            wrench_covariance=covariance,
            contact_area=float(sum(item.area for item in contacts)),
            centre_of_pressure=np.full(3, np.nan) if none else pressing @ place / total,
            contacts=contacts,
            slip_state=SlipState.NO_CONTACT if none else SlipState.UNKNOWN,
            valid_fraction=valid,
            regularization=float(np.sqrt(solution.first.weight)),
            flags=flags,
            noise_scale=float(np.sqrt(noise)),
        )

    def _covariances(
        self,
        solution: ForceSolution,
        valid: float,
        place: Array,
        sets: list[NDArray[np.intp]],
    ) -> list[tuple[Array, Array]]:
        """Covariance (6, 6) of the wrench of each set of nodes, of noise and resolution alone.

        With it what scale and edge of the second pass leave open on top of that.  valid: share of
        the markers that are seen.
        """
        if solution.posterior is None:
            # That of all nodes, for want of a better one; fewer markers average less noise.
            noise = solution.noise_squared / valid * self._rest_covariance
            return [(noise, np.zeros((6, 6)))] * len(sets)
        weights = np.zeros((len(sets), len(place)))
        for weight, nodes in zip(weights, sets, strict=True):
            weight[nodes] = 1.0
        nodes = solution.posterior.nodes
        functionals = [self._solver.functionals(place, weight, nodes) for weight in weights]
        noise, doubt = solution.posterior.covariances(np.concatenate(functionals))
        blocks = [slice(6 * k, 6 * k + 6) for k in range(len(sets))]
        return [(noise[block, block], doubt[block, block]) for block in blocks]

    def _with_model_error(
        self,
        contact: Contact,
        force: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> Contact:
        nodes = contact.nodes
        error = self._model_covariance(contact.wrench, place[nodes], force[nodes])
        return replace(contact, covariance=contact.covariance + error)

    def _model_covariance(
        self,
        wrench: NDArray[np.float64],
        place: NDArray[np.float64],
        force: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """What the model and its calibration leave open of a wrench, (6, 6).

        place (k, 3) m, force (k, 3) N: of the nodes that bear the wrench.
        """
        normal = tangential = self._parameters.model_error
        record = self._sensor.elastomer.calibration
        if record is not None:
            normal = float(np.hypot(normal, record.normal_std))
            tangential = float(np.hypot(tangential, record.tangential_std))
        error, height = self._parameters.model_error, self._sensor.elastomer.size[2]
        sizes = np.sqrt(np.einsum("ij,ij->i", force, force))
        total = float(sizes.sum())
        centre = sizes @ place / total if total else np.zeros(3)
        covariance = material_covariance(wrench, centre, normal, tangential)
        # Where the forces act is as uncertain as the mesh that says how far they have moved.
        lever = error * height * np.linalg.norm(wrench[:3])
        about = error * height * np.hypot(wrench[0], wrench[1])
        covariance[3:, 3:] += np.diag(np.square([lever, lever, about]))
        leaking = LEAK_SHARE * error * total * resultant_matrix(centre[None], np.ones(1))
        covariance += leaking @ leaking.T
        if not self._depth_seen:
            size = float(np.linalg.norm(wrench[:3]))
            reach = float(np.linalg.norm(centre)) + self._sensor.elastomer.size[2]
            covariance += np.diag((size * np.array([*ONE_VIEW_SHARE, *3 * (reach,)])) ** 2)
        return covariance

    def _flags(
        self,
        solution: ForceSolution,
        measured: _Measured,
        contacts: tuple[Contact, ...],
    ) -> ForceFlag:
        flags = ForceFlag.NONE
        if any(item.at_border for item in contacts) or self._border_bears(solution):
            flags |= ForceFlag.AT_BORDER
        if not measured.known[2::3].any():
            flags |= ForceFlag.NO_DEPTH
        if self._hidden(contacts, measured.known):
            flags |= ForceFlag.HIDDEN_CONTACT
        linear = self._sensor.elastomer.model == "linear" or self._large is not None
        if not linear and self._depth_of(solution) > LARGE_PRESS_RATIO:
            flags |= ForceFlag.LARGE_PRESS
        misfit = (measured.data - solution.predicted.ravel())[measured.known]
        left, whole = (np.sqrt(part @ part / len(part)) for part in (misfit, measured.data))
        if left > POOR_NOISE and left > POOR_SHARE * whole:
            flags |= ForceFlag.POOR_FIT
        return flags

    def _border_bears(self, solution: ForceSolution) -> bool:
        """Whether something presses, pulls or drags at the edge of the marker area."""
        bearing = self._solver.rule.bearing(solution.force, solution.force_std[:, 2])
        return solution.loaded and bool((bearing & self._regions.border).any())

    def _hidden(self, contacts: tuple[Contact, ...], known: NDArray[np.bool_]) -> bool:
        if known.all():
            return False
        seen = self._to_nodes @ known.reshape(-1, 3).any(axis=1).astype(np.float64)
        return any(float(seen[item.nodes].mean()) < 1 - HIDDEN_SHARE for item in contacts)

    def _unknown(self, valid: float, why: ForceFlag) -> ForceField:
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

    def _new_field(self, **values: object) -> ForceField:
        elastomer, nodes = self._sensor.elastomer, self.elastic.nodes
        return ForceField(
            rows=nodes.rows,
            cols=nodes.cols,
            position=self._position,
            reference_point=np.zeros(3),
            young=elastomer.young,
            poisson=elastomer.poisson,
            **values,  # type: ignore[arg-type]
        )


def within_reach(
    displacement: NDArray[np.float64], sensor: SensorDescription
) -> NDArray[np.float64]:
    """Displacement (rows, cols, 3) m, NaN where it is no measurement.

    No marker moves farther than the gel is large.
    """
    farthest = max(sensor.elastomer.size)
    # Not by the largest of them, which may be NaN.
    beyond = np.any(np.abs(displacement) > farthest, axis=-1, keepdims=True)
    return np.where(beyond, np.nan, displacement) if beyond.any() else displacement


def _is_near(data: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return float(np.linalg.norm(data - other)) <= SAME_SHARE * float(np.linalg.norm(other))


def _doubted(field: ForceField, relative: float) -> ForceField:
    """The same with a relative standard deviation on top of all error bars."""

    def wider(wrench: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
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
