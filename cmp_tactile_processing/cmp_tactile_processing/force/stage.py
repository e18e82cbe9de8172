"""The force stage as a whole: relaxation of the gel, force, slip, frame by frame.

It chains what belongs to force; nodes, pipeline and offline command all use it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.relaxation import RelaxationFilter
from cmp_tactile_processing.force.error_bars import (
    RollingShutter,
    errors_without_reference,
)
from cmp_tactile_processing.force.measurements import within_reach
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.plausibility import BorderContact
from cmp_tactile_processing.measured import (
    NS_PER_S,
    ForceField,
    ForceFlag,
    ReferenceFault,
    Status,
    Surface,
)
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import SlipParameters
from cmp_tactile_processing.slip.observer import SlipObserver
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest
from cmp_tactile_processing.surface.stillness import RestParameters, rest_shape, why_touched

# Without contact the force is 0 but for noise; more than so many deviations and this, N, is the
# reference's.
DOUBTED_DEVIATIONS, LEAST_DOUBTED_N = 10.0, 0.02
# A load under which a reference was taken is gone where what a later one takes away leaves less
# than this share: large presses are not linear.
SHARE_LEFT = 0.2
# Presses to warm a stage up with: width as a share of the gel's, drag as a share of the depth, and
# how many rows of markers are missing.
WARM_UP_PRESSES = ((0.07, 0.0, 0), (0.07, 0.2, 0), (0.07, 0.3, 1), (0.5, 0.3, 1))
WARM_UP_DEPTH_M = 1e-4
# Errors of an encoded video agree over blocks of 16 px and more, and do not average out: deviations
# of forces are so many times those of independent markers (benchmarks/doubtful_pictures.py).
ENCODED_DEVIATIONS = 3.0


class ForceStage:
    """Turns surfaces of one sensor, in the order of their stamps, into force fields.

    cache_dir, progress: see ElasticModel; encoded: see Pipeline.
    It remembers what the relaxation of the gel and the slip of contacts need of earlier frames, so
    one frame at a time: calls from several threads must take turns.  Surfaces in which nothing was
    found give fields of NaN.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
        *,
        encoded: bool = False,
    ) -> None:
        self._sensor, self._encoded = sensor, encoded
        self._model = ForceModel(sensor, cache_dir, progress)
        relaxation = sensor.elastomer.relaxation
        self._relaxation = None if relaxation is None else RelaxationFilter(relaxation)
        self._border = BorderContact(sensor, self._model.elastic, cache_dir)
        self._slip = SlipObserver(sensor)
        self._shutter = RollingShutter(sensor.image.readout_time)
        nodes = len(self._model.elastic.node_position)
        self._of_no_reference = errors_without_reference(sensor, nodes)
        self._reference_id: int | None = None
        self._stamp_ns: int | None = None
        self._last: ForceField | None = None
        self._zeroed = np.zeros(3)
        self._warm_up()

    @property
    def zeroed_load(self) -> float:
        """Force under which the reference in use was taken, N; 0 where none is known of."""
        return float(np.linalg.norm(self._zeroed))

    def process(
        self, surface: Surface, stamp_ns: int | None = None, *, contacts: bool = True
    ) -> ForceField:
        """Force, contacts and slip of a surface.

        contacts: see ForceModel.reconstruct.  Without them slip stays unknown, too, and is judged
        from the next frame on that has them.

        stamp_ns: of the camera frame; without it relaxation is left in.  Begins again where the
        displacement counts from another reference than before, and where time goes back, as where
        a recording is played again.
        """
        self._begin_again_where_due(surface, stamp_ns)
        # Before the memory: what a marker that moved too far shows is not to be remembered.
        displacement = within_reach(surface.displacement, self._sensor)
        surface = replace(surface, displacement=displacement)
        if self._relaxation is not None:
            displacement = self._relaxation.effective(displacement, surface.status, stamp_ns)
        # Entered here it costs nothing within.
        with one_thread():
            field = self._model.reconstruct_random(
                displacement, surface.status, surface.covariance, contacts=contacts
            )
            flags = field.flags | self._beyond(field, displacement) | self._of_zero(field)
            flags |= _of_reference(surface.reference_faults)
        if self._encoded:
            field = field.with_errors(ENCODED_DEVIATIONS)
        relaxed = self._relaxation is not None and stamp_ns is not None
        self._last = field
        field = replace(field, relaxed=relaxed, flags=flags)
        if contacts:
            field = self._slip.update(field, surface)
        else:
            self._slip.reset()
        field = self._model.with_systematic(field, surface.systematics)
        if surface.reference_faults & ReferenceFault.NOT_TAKEN:
            field = field.with_systematic_errors(*self._of_no_reference)
        return self._shutter.add(field, stamp_ns)

    def reset(self) -> None:
        """Forget earlier frames, as after start-up."""
        self._stamp_ns = self._last = None
        self._model.reset()
        self._slip.reset()
        self._shutter.reset()
        if self._relaxation is not None:
            self._relaxation.reset()

    def set_slip(self, parameters: SlipParameters) -> None:
        """Determine slip by other parameters from the next frame on; the force stays as it is.

        Contacts that are held keep their history.
        """
        if parameters != self._sensor.slip:
            self._sensor = replace(self._sensor, slip=parameters)
            self._slip.use(parameters)

    def carry_on_from(self, other: ForceStage) -> None:
        """Take over what another stage knows of the gel, as it has seen the frames so far.

        For a stage of the same gel with other parameters: what it was pressed with before still
        relaxes.
        """
        self._reference_id, self._stamp_ns = other._reference_id, other._stamp_ns
        self._relaxation = other._relaxation
        self._last, self._zeroed = other._last, other._zeroed

    def _warm_up(self) -> None:
        """Compile, or load, what frames need, not in the first of them: of a press that moves."""
        rest = surface_at_rest(Reference.nominal(self._sensor), self._sensor.pattern.shape)
        place = rest.reference[..., :2] / min(self._sensor.elastomer.size[:2])
        for number, (width, drag, missing) in enumerate(WARM_UP_PRESSES):
            hill = WARM_UP_DEPTH_M * np.exp(-((place / width) ** 2).sum(axis=-1))[..., None]
            # The gel spreads under the press, which is all that one view sees.
            moved = hill * np.dstack([place / width + [drag, 0.0], np.full(hill.shape, -1.0)])
            moved[:missing] = np.nan
            status = np.where(np.isnan(moved[..., 0]), Status.MISSING, rest.status)
            self.process(replace(rest, displacement=moved, status=status), number * NS_PER_S)
        self.reset()
        self._reference_id = None

    def _beyond(self, field: ForceField, displacement: NDArray[np.float64]) -> ForceFlag:
        known = np.isfinite(field.wrench).all()
        if known and self._border.reaches_beyond(displacement, field.force):
            return ForceFlag.BEYOND_MARKERS
        return ForceFlag.NONE

    def _of_zero(self, field: ForceField) -> ForceFlag:
        """Whether the reference was taken under load, as known before or as the force shows."""
        unpressed = not field.contact.any() and _is_force(field)
        return ForceFlag.ZERO_DOUBTFUL if self._zeroed.any() or unpressed else ForceFlag.NONE

    def _note_load(self, surface: Surface) -> None:
        """What the load was under which another reference was taken, by the one before it.

        By the nominal surface, number 0, errors of the description look like a load.
        """
        last, before = self._last, self._zeroed
        self._zeroed = np.zeros(3)
        if last is None or 0 in {self._reference_id, surface.reference_id}:
            return
        if not np.isfinite(last.wrench).all() or not (last.contact.any() or before.any()):
            return
        force = last.wrench[:3] if _is_force(last) else np.zeros(3)
        most = SHARE_LEFT * max(np.linalg.norm(before), np.linalg.norm(force))
        if before.any() and np.linalg.norm(before + force) <= most + LEAST_DOUBTED_N:
            return
        # What pulls without pressing is a load that an earlier reference had in it, now gone.
        shape = rest_shape(Reference.nominal(self._sensor).position, surface.reference)
        if last.contact.any() or why_touched(shape, RestParameters()):
            self._zeroed = before + force

    def _begin_again_where_due(self, surface: Surface, stamp_ns: int | None) -> None:
        reference_id = surface.reference_id
        if reference_id != self._reference_id:
            self._note_load(surface)
        if reference_id != self._reference_id or _goes_back(self._stamp_ns, stamp_ns):
            self.reset()
        self._reference_id = reference_id
        self._stamp_ns = self._stamp_ns if stamp_ns is None else stamp_ns


def _of_reference(faults: ReferenceFault) -> ForceFlag:
    flags = ForceFlag.NONE
    if faults & ReferenceFault.TOUCHED:
        flags |= ForceFlag.ZERO_DOUBTFUL
    if faults & ReferenceFault.DESCRIPTION:
        flags |= ForceFlag.DESCRIPTION_DOUBTFUL
    return flags


def _is_force(field: ForceField) -> bool:
    """Whether a field's force is more than noise makes of none."""
    limit = np.maximum(DOUBTED_DEVIATIONS * field.random_std[:3], LEAST_DOUBTED_N)
    return bool((np.abs(field.wrench[:3]) > limit).any())


def _goes_back(before: int | None, now: int | None) -> bool:
    return before is not None and now is not None and now < before
