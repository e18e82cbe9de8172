"""Force stage: from the displacement of the markers to the force that the object exerts."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
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
        self._of_corrected = self._solver
        if self._large is not None and large_press_steps:
            self._gradual = GradualSettling(self._large, large_press_steps)
            # One with a memory of its own: scales of the linear force are others.
            self._of_corrected = copy(self._solver)
            self._of_corrected.reset()
        self._out_of_reach = np.inf
        self._unstated = np.zeros((markers.rows, markers.cols, 3, 3))
        # Compiled, or read from numba's cache, before the first frame.
        at_rest, seen = np.zeros((markers.rows, markers.cols, 3)), (markers.rows, markers.cols)
        self._measurements(within_reach(at_rest, sensor), np.ones(seen, np.uint8), None)
        point, every = np.zeros((1, 3)), np.ones((len(self._position), 3))
        self._model_covariance(wrench_of(point, point), point, point)
        self.elastic.node_displacement(every)

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
            self._solver.reset()
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
                found = self._of_corrected.again(found, data, measured.known)
            else:
                found, solved = self._of_corrected.solve(data, measured.known), data
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
        found = self._of_corrected.completed(found)
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
        """Forget where scales and large press have settled; all else is of one frame alone."""
        self._out_of_reach = np.inf
        self._solver.reset()
        self._of_corrected.reset()
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
        stated = self._unstated if covariance is None else covariance
        return _Measured(
            *_measured(
                _plain(moved),
                np.require(states, np.uint8, ["C", "W"]),
                _plain(stated),
                max(self._sensor.elastomer.size),
                self._noise,
                self._depth_seen,
            )
        )

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
        everywhere = np.ones(len(force), dtype=bool)
        of_all = self._covariances(solution, valid, place, everywhere)
        loaded = force.any(axis=1)

        def of_some(nodes: NDArray[np.intp]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            some = np.zeros(len(force), dtype=bool)
            some[nodes] = True
            whole = some[loaded].all()
            return of_all if whole else self._covariances(solution, valid, place, some)

        pressed = self._solver.rule.pressed(force, solution.force_std[:, 2]) & solution.loaded
        contacts = tuple(
            self._with_model_error(item, force, place)
            for item in self._regions.contacts(force, pressed, place, of_some)
        )
        covariance = of_all[0] + of_all[1] + self._model_covariance(wrench, place, force)
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
        place: NDArray[np.float64],
        some: NDArray[np.bool_],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Covariance (6, 6) of the wrench of some nodes (nodes,), of noise and resolution alone.

        With it what scale and edge of the second pass leave open on top of that.  valid: share of
        the markers that are seen.
        """
        if solution.posterior is None:
            # That of all nodes, for want of a better one; fewer markers average less noise.
            return solution.noise_squared / valid * self._rest_covariance, np.zeros((6, 6))
        weight = some.astype(np.float64)
        functionals = self._solver.functionals(place, weight, solution.posterior.nodes)
        return solution.posterior.covariances(functionals)

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
        covariance, centre = _model_covariance(
            wrench, place, force, (normal, tangential), LEAK_SHARE * error, error * height
        )
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


@njit(cache=True, nogil=True, error_model="numpy")
def _model_covariance(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    wrench: NDArray[np.float64],
    place: NDArray[np.float64],
    force: NDArray[np.float64],
    scales: tuple[float, float],
    leak: float,
    lever: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the model leaves open of a wrench, (6, 6), and the centre (3,) of its forces.

    scales: relative deviations of the normal and the tangential force.  leak: of the forces' sum.
    lever: by which the forces may act elsewhere, m.
    """
    total = 0.0
    centre: NDArray[np.float64] = np.zeros(3)
    for i in range(len(force)):
        size = np.sqrt(force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2)
        total += size
        for c in range(3):
            centre[c] += size * place[i, c]
    if total > 0:
        centre /= total
    covariance: NDArray[np.float64] = material_covariance(wrench, centre, scales[0], scales[1])
    # Where the forces act is as uncertain as the mesh that says how far they have moved.
    across = np.hypot(wrench[0], wrench[1])
    along = np.hypot(across, wrench[2])
    covariance[3, 3] += (lever * along) ** 2
    covariance[4, 4] += (lever * along) ** 2
    covariance[5, 5] += (lever * across) ** 2
    leaking = leak * total * resultant_matrix(centre.reshape(1, 3), np.ones(1))
    covariance += np.dot(leaking, leaking.T)
    return covariance, centre


@njit(cache=True, nogil=True, error_model="numpy")
def _measured(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    moved: NDArray[np.float64],
    states: NDArray[np.uint8],
    covariance: NDArray[np.float64],
    farthest: float,
    noise: NDArray[np.float64],
    depth_seen: bool,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
    """As _Measured, for arrays as of `reconstruct`; farthest, m: how far a marker can move."""
    count = states.size
    data, known = np.zeros(3 * count), np.zeros(3 * count, np.bool_)
    values, variance = moved.reshape(-1), np.zeros(count)
    for i, state in enumerate(states.flat):
        of_marker = values[3 * i : 3 * i + 3]
        if state == Status.MISSING.value or _beyond(of_marker, farthest):
            continue
        for c in range(3):
            known[3 * i + c] = np.isfinite(of_marker[c])
        if known[3 * i : 3 * i + 3].any():
            trace = 0.0
            for c in range(3):
                trace += covariance[i // states.shape[1], i % states.shape[1], c, c]
            variance[i] = trace
    stated = np.isfinite(variance) & (variance > 0)
    most = MUCH_NOISIER**2 * np.median(variance[stated]) if stated.any() else np.inf
    valid = 0
    for i in range(count):
        is_certain = not stated[i] or variance[i] <= most
        seen = False
        for k in range(3 * i, 3 * i + 3):
            known[k] = known[k] and is_certain and (depth_seen or k % 3 < 2)
            if known[k]:
                data[k] = values[k] / noise[k]
                seen = True
        valid += seen
    return data, known, valid / count


@njit(cache=True, nogil=True, error_model="numpy")
def _beyond(moved: NDArray[np.float64], farthest: float) -> bool:
    # Not by the largest of them, which may be NaN.
    return bool(abs(moved[0]) > farthest or abs(moved[1]) > farthest or abs(moved[2]) > farthest)


@njit(cache=True, nogil=True, error_model="numpy")
def _within_reach(moved: NDArray[np.float64], farthest: float) -> NDArray[np.float64]:
    found: NDArray[np.float64] = moved.copy()
    for i in range(moved.shape[0]):
        for j in range(moved.shape[1]):
            if _beyond(moved[i, j], farthest):
                found[i, j] = np.nan
    return found


def within_reach(
    displacement: NDArray[np.float64], sensor: SensorDescription
) -> NDArray[np.float64]:
    """Displacement (rows, cols, 3) m, NaN where it is no measurement.

    No marker moves farther than the gel is large.
    """
    return _within_reach(_plain(displacement), max(sensor.elastomer.size))


def _plain(values: NDArray[Any]) -> NDArray[np.float64]:
    """As what is compiled takes it."""
    return np.require(values, np.float64, ["C", "W"])


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
