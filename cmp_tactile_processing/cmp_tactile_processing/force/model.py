"""Force stage: from the displacement of the markers to the force that the object exerts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.one_thread import one_thread
from cmp_tactile_processing.elastic.equilibrium import NoEquilibriumError
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem, Progress
from cmp_tactile_processing.force.field import FieldBuilder, doubted
from cmp_tactile_processing.force.large_press import GradualSettling, LargePress, settle
from cmp_tactile_processing.force.measurements import Measurements, Whitening
from cmp_tactile_processing.force.plausibility import Plausibility
from cmp_tactile_processing.force.solution import ForceSolution, ForceSolver
from cmp_tactile_processing.measured import ForceField, ForceFlag
from cmp_tactile_processing.sensor.description import SensorDescription

# Pressed in by more than this share of the thickness, a gel is not linear.  One that is described
# as neo-Hookean then shows 1 % too little Fz or more; one that is described as linear is believed
# up to where any rubber would show 4 to 7 % too little.
LARGE_PRESS_RATIO, LARGE_PRESS_RATIO_LINEAR = 0.023, 0.15
# A press that the correction could not follow is tried again when it is so much less.
RETRY_SHARE = 0.97
# Data that differ by less than this share are solved for on the same nodes, for the same scale.
SAME_SHARE = 0.01
# Pressed in by less than this share of the thickness, the linear model is off by 0.3 % of Fz.
SMALL_PRESS_RATIO = 1.5e-3
# Spheres and flats pressed in by 2 to 12 % of the thickness lose 0.3 to 0.5 of that share.
LINEAR_DOUBT = 0.5
# Where less of the displacement is open, error bars say it and no flag: noise alone asks for that.
SETTLED_SHARE = 5e-3


Array = NDArray[np.float64]


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
        self._plausibility = Plausibility(sensor, markers)
        self._large = self._large_press(cache_dir, progress)
        self._gradual: GradualSettling | None = None
        if self._large is not None and large_press_steps:
            self._gradual = GradualSettling(self._large, large_press_steps)
        self._out_of_reach = np.inf
        # What this keeps is made here, before the first frame.
        self.elastic.node_displacement(np.ones(self.elastic.node_position.shape))

    def _large_press(self, cache_dir: Path | None, progress: Progress | None) -> LargePress | None:
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
    ) -> ForceField:
        """Force on the gel from the displacement of the markers.

        displacement (rows, cols, 3) m, gel frame; status (rows, cols); covariance (rows, cols, 3,
        3) m^2 of the displacement: markers that are much less certain than most are left out.
        A marker with status 0, one that moved farther than the gel is large, and any component
        that is not finite count as not measured.  Too few markers give a field of NaN, and so does
        what no gel can show.  contacts: without them the contacts, their area and flags, and the
        wrench's covariance stay unknown, and `contact` is every node that is pressed, by noise too;
        that saves a third of the time.  Raises GeometryError for arrays of other shapes.
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
        solved = None if self._gradual is None else measured.data
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
        data = measured.data - self._whitening.in_noise(excess, measured.known)
        found = self._solver.completed(found)
        corrected = self._field(found, measured._replace(data=data), large.moved, flag)
        if ForceFlag.IMPLAUSIBLE in corrected.flags:
            self.reset()
            if left:
                return self._linear_field(linear, measured, ForceFlag.NOT_CONVERGED)
            return corrected
        return replace(doubted(corrected, left) if left else corrected, corrected=True)

    def _linear_field(
        self, linear: ForceSolution, measured: Measurements, flag: ForceFlag
    ) -> ForceField:
        """The field of a solution as it is, in doubt as far as the gel strains beyond linearly."""
        moved = self.elastic.node_displacement(linear.coefficient)
        field = self._field(linear, measured, moved, flag)
        if self._sensor.elastomer.model == "linear":
            return field
        return doubted(field, LINEAR_DOUBT * self._depth_of(linear))

    def reset(self) -> None:
        """Forget where a large press has settled; all else is of one frame alone."""
        self._out_of_reach = np.inf
        for large in (self._large, self._gradual):
            if large is not None:
                large.reset()

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
