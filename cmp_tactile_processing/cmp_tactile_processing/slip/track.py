"""One contact followed over frames: what of its friction is known from how it came about.

In a single frame a traction that is spread wider than the pressure tells that a core sticks.
A traction like the pressure, in one ratio everywhere, is what full sliding leaves, but also what
an oblique press leaves in which nothing ever slid.  So the loads are counted from the last time
at which nothing can have begun to slide: the first touch, the end of a time in which the
tangential force grew with the normal force, or a turn of the load.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.force_field import SlipEstimate, SlipState
from cmp_tactile_processing.sensor.parameters import SlipParameters
from cmp_tactile_processing.slip.friction import FrictionUse
from cmp_tactile_processing.slip.patch import ContactPatch, TractionRecord

__all__ = ["ContactTrack"]

# Growth of the normal force after which it is looked at whether the tangential force grew along,
# how much more steeply than the present ratio it may have done so without anything sliding, and
# the change of the ratio that is no growth.
GROWTH, STEEPER, OTHER_RATIO = 1.05, 1.2, 0.05
# What was taken for sliding was none where the friction used rises beyond it by this share.
EXCEEDED = 0.1
# A load has turned, and sliding has ended, where so much of the friction used is given back.
GIVEN_BACK = 0.07
# Spread of traction over that of pressure, below which nothing explains it.
LEAST_WIDTH = 0.8
# A traction that is so much wider or narrower than the pressure is not in one ratio everywhere.
UNEVEN = 0.15
# Frames over which the friction used must have stopped to rise, and by what share it may rise.
STEADY_FRAMES, STEADY_SHARE = 3, 0.02
# Radii by which a contact may travel over the gel before its history is no longer its own.
FARTHEST = 0.5
# Sliding frames that the friction coefficient is taken from.
REMEMBERED = 30
# Share by which the friction coefficient may be wrong for reasons other than noise: of what
# slides as a whole, and as foreseen while a core sticks.
SLIDING_ERROR, FORESEEN_ERROR = 0.025, 0.1
# Slip ratio above which the friction coefficient of the rim is told.
FORESEEN_FROM = 0.5
DEVIATIONS = 3.0

UNKNOWN = SlipEstimate()


class ContactTrack:
    """The friction history of one contact."""

    def __init__(self, parameters: SlipParameters) -> None:
        self._parameters = parameters
        self.mask: NDArray[np.bool_] | None = None
        self.missed = 0
        self._forget()

    def use(self, parameters: SlipParameters) -> None:
        """Judge the next frames by these; what is known of earlier ones stays."""
        self._parameters = parameters

    def _forget(self) -> None:
        self._begun = False
        self._anchor: TractionRecord | None = None
        self._level: tuple[float, float, NDArray[np.float64]] = (0.0, 0.0, np.zeros(3))
        self._known = False  # whether it is known that not all slid at the anchor
        self._peak: tuple[float, float, TractionRecord] | None = None
        self._recent: deque[float] = deque(maxlen=STEADY_FRAMES)
        self._sliding = False
        self._slid: deque[float] = deque(maxlen=REMEMBERED)
        self._friction = float("nan")

    def judge(self, patch: ContactPatch | None) -> SlipEstimate:
        """The slip of this contact in the next frame; None: it cannot be seen in it."""
        if patch is None:
            return UNKNOWN
        if patch.normal_force < self._parameters.min_normal_force:
            self._forget()
            return UNKNOWN
        if not self._begun:
            self._begun = True
            self._anchor_at(patch, known=False)
        estimate = self._judge(patch)
        self._recent.append(patch.use.ratio)
        return replace(estimate, traction_ratio=patch.traction_ratio)

    def _judge(self, patch: ContactPatch) -> SlipEstimate:
        if self._sliding:
            if patch.use.ratio > self._friction_at_most(patch):
                self._sliding, self._peak, self._friction = False, None, float("nan")
                self._slid.clear()
            elif patch.use.ratio >= self._friction_kept(patch):
                return self._slides(patch)
            else:
                self._sliding = False
                if self._peak is not None:
                    self._anchor, self._known, self._peak = self._peak[2], True, None
        self._follow(patch)
        assert self._anchor is not None  # noqa: S101  there is one since the first frame
        reach = patch.since(self._anchor)
        if self._turned(patch, reach):
            reach = patch.since(self._anchor)
        self._keep_peak(patch, reach)
        return self._told(patch, reach)

    def _friction_kept(self, patch: ContactPatch) -> float:
        return (1 - GIVEN_BACK) * self._friction - DEVIATIONS * patch.ratio_std

    def _friction_at_most(self, patch: ContactPatch) -> float:
        return (1 + EXCEEDED) * self._friction + DEVIATIONS * patch.ratio_std

    def _slides(self, patch: ContactPatch) -> SlipEstimate:
        self._sliding = True
        self._slid.append(patch.use.ratio)
        values = np.array(self._slid)
        self._friction = float(np.median(values))
        scatter = 1.4826 * float(np.median(np.abs(values - self._friction)))
        std = np.hypot(
            scatter / np.sqrt(len(values)),
            np.hypot(patch.ratio_std, SLIDING_ERROR * self._friction),
        )
        self._peak = patch.use.ratio, 0.0, patch.record()
        return SlipEstimate(SlipState.FULL, 1.0, 0.0, self._friction, float(std))

    def _anchor_at(self, patch: ContactPatch, *, known: bool) -> None:
        small = patch.use.ratio < self._parameters.min_traction_ratio
        self._anchor, self._peak = patch.record(small=small), None
        self._known = known or small
        self._level_at(patch)

    def _level_at(self, patch: ContactPatch) -> None:
        self._level = patch.normal_force, patch.use.ratio, patch.along.sum(axis=0)

    def _follow(self, patch: ContactPatch) -> None:
        """Count from now where the tangential force grew only along with the normal force."""
        normal, ratio, along = self._level
        least = self._parameters.min_traction_ratio
        if patch.normal_force >= GROWTH * normal:
            rise = float(np.linalg.norm(patch.along.sum(axis=0) - along))
            steepness = rise / (patch.normal_force - normal)
            if steepness < STEEPER * max(patch.use.ratio, least):
                below = patch.use.ratio < (1 - GIVEN_BACK) * self._friction
                self._anchor_at(patch, known=self._known or bool(below))
            self._level_at(patch)
        elif patch.normal_force < normal or abs(patch.use.ratio - ratio) > OTHER_RATIO:
            self._level_at(patch)

    def _turned(self, patch: ContactPatch, reach: FrictionUse) -> bool:
        """Count from the largest load where so much of it was given back."""
        if self._peak is None:
            return False
        ratio, load, record = self._peak
        lost = max(GIVEN_BACK * ratio, DEVIATIONS * patch.ratio_std)
        enough = ratio > self._parameters.min_traction_ratio
        turned = enough and reach.ratio < ratio - lost and reach.ratio * patch.normal_force < load
        if turned:
            self._anchor, self._known, self._peak = record, True, None
        return turned

    def _keep_peak(self, patch: ContactPatch, reach: FrictionUse) -> None:
        if self._peak is None or reach.ratio >= self._peak[0]:
            self._peak = reach.ratio, reach.ratio * patch.normal_force, patch.record()

    def _told(self, patch: ContactPatch, reach: FrictionUse) -> SlipEstimate:
        if patch.use.ratio >= self._friction_kept(patch):
            return self._slides(patch)
        if reach.ratio < max(self._parameters.min_traction_ratio, DEVIATIONS * patch.ratio_std):
            uneven = abs(patch.use.width - 1) > UNEVEN
            known = self._known or uneven
            return SlipEstimate(SlipState.STICK, 0.0) if known else UNKNOWN
        if not self._tells(patch, reach):
            return UNKNOWN
        slip_ratio, used = patch.profile.at(reach)
        if slip_ratio >= self._parameters.full_ratio:
            if self._is_steady(patch):
                return self._slides(patch)
        else:
            self._known = True
            if slip_ratio < self._parameters.incipient_ratio:
                return SlipEstimate(SlipState.STICK, slip_ratio)
        friction = std = float("nan")
        if np.isfinite(self._friction):
            friction, std = self._friction, SLIDING_ERROR * self._friction
        elif slip_ratio >= FORESEEN_FROM and self._from_nothing:
            friction = reach.ratio / used
            std = float(np.hypot(FORESEEN_ERROR * friction, patch.ratio_std))
        return SlipEstimate(SlipState.INCIPIENT, slip_ratio, 0.0, friction, std)

    @property
    def _from_nothing(self) -> bool:
        """Whether the friction used is counted from where none was in use."""
        return self._anchor is not None and self._anchor.along is None

    def _tells(self, patch: ContactPatch, reach: FrictionUse) -> bool:
        """Whether the spread of what has changed tells how far slip has gone."""
        anchor = self._anchor
        travelled = 0.0 if anchor is None else float(np.linalg.norm(patch.centre - anchor.centre))
        near = travelled < FARTHEST * patch.radius
        return near and patch.profile.is_rounded and reach.width > LEAST_WIDTH

    def _is_steady(self, patch: ContactPatch) -> bool:
        """Whether the friction used no longer rises and, where it once slid, is as high as then."""
        if len(self._recent) < STEADY_FRAMES or patch.use.ratio < self._friction_kept(patch):
            return False
        limit = max(STEADY_SHARE * patch.use.ratio, DEVIATIONS * patch.ratio_std)
        return patch.use.ratio - min(self._recent) < limit
