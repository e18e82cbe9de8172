"""The whole chain of a method: split, track, triangulate, force; and the errors of its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker
from hard_frames.grid_score import GridScore, join_scores, score_grid
from paper.lab import Mechanics

Image = NDArray[np.uint8]


class ViewTracker(Protocol):
    """Follows the markers of one view from frame to frame."""

    def learn(self, at_rest: Sequence[Image]) -> None:
        """Look at view images (H, W) of the gel at rest, before the first frame."""

    def track(self, half_image: Image) -> Grid:
        """Markers of a view image (H, W); of dots, their centres are the corners."""

    def reset(self) -> None:
        """Forget earlier frames; what was learnt is kept."""


def _as_it_is(sensor: SensorDescription) -> SensorDescription:
    return sensor


@dataclass(frozen=True)
class Method:
    """A way to measure markers.

    key: of results; label: of figures and tables.  pattern_type: cmp or dmp.
    tracker: makes that of a view, from sensor and view name.
    settings: of triangulation and the rest, laid over the sensor's.
    """

    key: str
    label: str
    pattern_type: str
    tracker: Callable[[SensorDescription, str], ViewTracker]
    settings: Callable[[SensorDescription], SensorDescription] = _as_it_is


class _Checkers:
    """GridTracker as the pipeline uses it."""

    def __init__(self, sensor: SensorDescription, view: str) -> None:
        self._tracker = GridTracker(sensor, view)

    def learn(self, at_rest: Sequence[Image]) -> None:
        self._tracker.inspect_print(at_rest)

    def track(self, half_image: Image) -> Grid:
        return self._tracker.track(half_image)

    def reset(self) -> None:
        self._tracker.reset()


class _CheckersOfThePaper(_Checkers):
    """Section III: it learns nothing of the print."""

    def learn(self, at_rest: Sequence[Image]) -> None:
        pass


def _paper_settings(sensor: SensorDescription) -> SensorDescription:
    """Contour stitching, quadratic sub-pixel correction, common normal, each frame by itself."""
    tracking = replace(
        sensor.tracking,
        detector="contour_stitching",
        virtual_markers="local_correction",
        follow=False,
    )
    triangulation = replace(sensor.triangulation, method="common_normal")
    return replace(sensor, tracking=tracking, triangulation=triangulation)


CMP = Method("cmp", "CMP", "cmp", _Checkers)
CMP_PAPER = Method(
    "cmp_paper", "CMP, the paper's algorithm", "cmp", _CheckersOfThePaper, _paper_settings
)


def score_markers(grids: Mapping[str, Grid], truth: Mapping[str, Grid]) -> GridScore:
    """The score of both views together; every marker that a view truly shows is visible."""
    shown = {name: np.isfinite(grid.corners[..., 0]) for name, grid in truth.items()}
    return join_scores(
        score_grid(grids[name], truth[name], shown[name], shown[name]) for name in truth
    )


def found_and_wrong(counts: NDArray[np.intp]) -> str:
    """Share of the visible markers found, and wrong numbers, of counts (n, 3) of all three."""
    visible, found, wrong = counts.sum(axis=0).tolist()
    return f"{found / visible:.1%} / {wrong}"


@dataclass(frozen=True)
class Measurement:
    """What a method measured in a frame; grids by view.  force: None where it is not asked for."""

    grids: Mapping[str, Grid]
    surface: Surface
    force: ForceField | None


class Chain:
    """A method on a sensor.  Raises what the stages raise."""

    def __init__(
        self, sensor: SensorDescription, method: Method, *, with_force: bool = False
    ) -> None:
        sensor = method.settings(sensor)
        self._rig = StereoRig(sensor)
        self._trackers = {name: method.tracker(sensor, name) for name in self._rig.views}
        self._reference = Reference.nominal(sensor)
        self._force = ForceStage(sensor) if with_force else None

    def set_reference(self, images: Sequence[Image]) -> None:
        """Measure displacements against the mean of these frames (H, W) of the gel at rest."""
        views = [self.views(image) for image in images]
        for name, tracker in self._trackers.items():
            tracker.learn([each[name] for each in views])
        markers = []
        for image in images:
            grids = self.track(image)
            markers.append(self._rig.triangulate(grids["left"], grids["right"]))
        self._reference = Reference.average(markers, reference_id=1)

    def measure(self, image: Image) -> Measurement:
        """Everything that the next frame (H, W) shows."""
        grids = self.track(image)
        surface = self._reference.surface(self._rig.triangulate(grids["left"], grids["right"]))
        force = self._force.process(surface) if self._force else None
        return Measurement(grids, surface, force)

    def reset(self) -> None:
        """Forget earlier frames, but not the reference."""
        for tracker in self._trackers.values():
            tracker.reset()
        if self._force:
            self._force.reset()

    def track(self, image: Image) -> dict[str, Grid]:
        """The markers of each view of the next frame (H, W)."""
        views = self.views(image).items()
        return {name: self._trackers[name].track(view) for name, view in views}

    def views(self, image: Image) -> dict[str, Image]:
        """The views (h, w) of a frame (H, W), cut out."""
        views = self._rig.views.items()
        return {name: split_frame(image, view.placement) for name, view in views}


Array = NDArray[np.float64]


def virtual(surface: Surface, truth: Surface) -> Array:
    """Position errors of the virtual markers (n, 3), m, each from its own true point.

    That counts also what the image does not show, where along its gridline a marker is.
    """
    rows = surface.row_position - truth.row_position
    cols = surface.col_position - truth.col_position
    return np.concatenate([rows.reshape(-1, 3), cols.reshape(-1, 3)])


def all_markers(surface: Surface, truth: Surface) -> Array:
    """Position errors of corners and virtual markers (n, 3), m; NaN where missing."""
    corners = (surface.position - truth.position).reshape(-1, 3)
    return np.concatenate([corners, virtual(surface, truth)])


def mean_absolute(error: NDArray[np.floating]) -> Array:
    """(4,): along x, y, z, and as distance, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    if not len(known):
        return np.full(4, np.nan)
    return np.append(np.abs(known).mean(axis=0), np.linalg.norm(known, axis=1).mean())


def root_mean_square(error: NDArray[np.floating]) -> Array:
    """(3,): along x, y, z, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    return np.sqrt(np.mean(known**2, axis=0)) if len(known) else np.full(3, np.nan)


def largest(error: NDArray[np.floating]) -> Array:
    """(3,): the largest size along x, y, z, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    return np.abs(known).max(axis=0) if len(known) else np.full(3, np.nan)


def in_contact(mechanics: Mechanics, frame: int, reference: Array) -> NDArray[np.bool_]:
    """Which markers (rows, cols, 3) at rest lie nearest to a node that is in contact."""
    nodes = mechanics.node_position[:, :2]
    flat = reference[..., :2].reshape(-1, 1, 2)
    nearest = np.argmin(((flat - nodes) ** 2).sum(axis=-1), axis=1)
    return np.asarray(mechanics.contact[frame][nearest].reshape(reference.shape[:2]))


def _known(error: NDArray[np.floating]) -> Array:
    flat = np.asarray(error, dtype=np.float64).reshape(-1, 3)
    return flat[np.isfinite(flat).all(axis=1)]
