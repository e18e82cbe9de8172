"""What a sensor description may have wrong, and what that does to pixels and displacements.

A change is of the rig (`RigParameters`), of the print, or of the height of the marker surface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.rig_parameters import RigParameters, RigPrior
from cmp_tactile_processing.measured import Systematics
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import USUAL_STD, RefractingLayer

Array: TypeAlias = NDArray[np.float64]
Numbers: TypeAlias = NDArray[np.intp]

# Deviations of optical values where the description states none.
PRIOR = RigPrior(aspect=3e-3, distortion=5e-3, layer_z=2e-4, layer_index=0.03)
# Of a sensor without layers: of the index between the base of the gel and the pattern.
UNDESCRIBED_INDEX_STD = 0.1
# Of a print: its pitch, the ratio of its pitches along y and x, its shear; all relative.
PRINT_STD = {
    "pattern.pitch": USUAL_STD["pattern.pitch"],
    "pattern: aspect": 2e-3,
    "pattern: shear": 2e-3,
}
# Of the surface's height at the pattern's border, by the order of the polynomial, m: a mould may
# have another radius; beyond that it differs by some hundredths of a millimetre.
HEIGHT_STD_M = {2: 3e-4, 3: 3e-5, 4: 3e-5}
# Over which derivatives are taken, in deviations of the prior; the least of these deviations, as a
# share of the usual one.
STEP, MIN_PRIOR_SHARE = 1e-3, 1e-4
# Corners along a side at which pixels are compared, and errors of displacements evaluated.
COMPARED_PER_SIDE, SAMPLED_PER_SIDE = 10, 4
# Steps to the point that the description makes of the pixels of two views.
TRIANGULATION_STEPS = 4


class CheckableChange(NamedTuple):
    """Parameters that people can check together, and how to print the first of them."""

    name: str
    columns: list[int]
    format: str


class DescriptionChanges:
    """The changes (n,) of one description.  Raises InputError as `build_views` does.

    Corners are in one row, of N.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor = _with_layer(sensor)
        self.views = build_views(self._sensor)
        prior = PRIOR
        if not sensor.optics.layers:
            prior = replace(PRIOR, layer_z=0.0, layer_index=UNDESCRIBED_INDEX_STD)
        self._rig = RigParameters(self._sensor, prior)
        self.corners = sensor.pattern.corners().reshape(-1, 3)
        shape = sensor.pattern.rows, sensor.pattern.cols
        self.compared = _spread_over(shape, COMPARED_PER_SIDE)
        self._sampled = _spread_over(shape, SAMPLED_PER_SIDE)
        self._powers = [(a, n - a) for n in HEIGHT_STD_M for a in range(n + 1)]
        # Directions (3, k) in which displacements are measured.
        self._along = np.eye(3)[:, : len(self.views) + 1]

    @cached_property
    def prior(self) -> Array:
        """Covariance (n, n) of the changes; that of the gel's pose is as of an exchanged gel."""
        heights = [HEIGHT_STD_M[a + b] for a, b in self._powers]
        names = [*self._rig.names, *PRINT_STD, *("" for _ in heights)]
        usual = np.concatenate([self._rig.prior_std, [*PRINT_STD.values()], heights])
        asked = ["" if "gel: " in name else name for name in names]
        covariance = self._sensor.uncertainty.covariance(asked, usual)
        # A value that is known exactly keeps next to no freedom.
        return np.asarray(covariance + np.diag((MIN_PRIOR_SHARE * usual) ** 2))

    @cached_property
    def prior_std(self) -> Array:
        """Deviations (n,) of the changes."""
        return np.asarray(np.sqrt(np.diag(self.prior)))

    @cached_property
    def jacobian(self) -> Array:
        """Derivatives (views, compared, 2, n) of the compared corners, px, as described."""
        return self.jacobian_at(0 * self.prior_std)

    def jacobian_at(self, changes: Array) -> Array:
        """The same of a changed description."""
        return self._derivatives(lambda other: self.pixels(other)[:, self.compared], changes)

    @cached_property
    def effects_by_change(self) -> Array:
        """Derivatives (samples, 11, n) of `effects`."""
        return self._derivatives(self.effects, 0 * self.prior_std)

    def pixels(self, changes: Array) -> Array:
        """Where the views see all corners, (views, N, 2) px; InputError where they do not."""
        views, places = self._changed(changes)
        return np.stack([view.project(places) for view in views.values()])

    def effects(self, changes: Array) -> Array:
        """Errors of displacements at sampled corners, (samples, 11): see Systematics.

        A displacement is measured by what the description makes of pixels; these move with it as
        the changed rig has it.
        """
        views, places = self._changed(changes)
        pixels, by_point = _projected(views, places[self._sampled])
        point = self.corners[self._sampled]
        for _ in range(TRIANGULATION_STEPS):
            described, slope = _projected(self.views, point)
            inverse = np.linalg.pinv(slope @ self._along)
            point = point + np.einsum("nij,nj->ni", self._along @ inverse, pixels - described)
        k = self._along.shape[1]
        effects = np.zeros((len(point), Systematics.COMPONENTS))
        gain = effects[:, :9].reshape(-1, 3, 3)
        gain[:, :k, :k] = inverse @ (by_point @ self._along) - np.eye(k)
        effects[:, 9] = self._parts(changes)[1][0]
        heights = self._heights(changes)
        higher = (heights - heights.mean())[self._sampled]
        effects[:, 10] = higher / self._sensor.elastomer.size[2]
        return effects

    def on_gel(self, pixels: Array) -> Array:
        """Distances (views, N, 2) px of the corners as lengths on the gel, (N, 3) m."""
        _, slope = _projected(self.views, self.corners)
        inverse = self._along @ np.linalg.pinv(slope @ self._along)
        per_corner = np.moveaxis(pixels, 0, 1).reshape(len(slope), -1)
        return np.asarray(np.einsum("nij,nj->ni", inverse, per_corner))

    @property
    def pose(self) -> list[int]:
        """Parameters of the gel's pose: any pose is right."""
        return [k for k, name in enumerate(self._rig.names) if "gel: " in name]

    def checkable(self) -> Iterator[CheckableChange]:
        """Changes one by one."""
        names, of_print = self._rig.names, len(self._rig.free)
        yield CheckableChange("pattern.pitch", [of_print], "{:+.1%}")
        cameras = [k for k, name in enumerate(names) if name.endswith(".fx")]
        yield CheckableChange("focal length", cameras, "{:+.1%}")
        for column, name in enumerate(names):
            if name.endswith((".cx", ".cy")):
                yield CheckableChange(name, [column], "{:+.1f} px")
            elif name.endswith(".index"):
                yield CheckableChange("index of refraction before the gel", [column], "{:+.2f}")
            elif ".mirror" in name or ".distortion" in name:
                yield CheckableChange(name, [column], "{:+.2g}")
        squares = [of_print + len(PRINT_STD) + self._powers.index(p) for p in ((2, 0), (0, 2))]
        name = "height of pattern.surface at the pattern's border"
        yield CheckableChange(name, squares, "{:+.2g} m")

    def _derivatives(self, function: Callable[[Array], Array], changes: Array) -> Array:
        """By each change, along a last axis."""
        at, steps = function(changes), STEP * self.prior_std
        moved = [function(changes + step) - at for step in np.diag(steps)]
        return np.asarray(np.stack(moved, axis=-1) / steps)

    def _changed(self, changes: Array) -> tuple[dict[str, ViewGeometry], Array]:
        """Views, and places (N, 3) m of the corners."""
        rig, printed, _ = self._parts(changes)
        pitch, aspect, shear = printed
        scale = np.array([[1 + pitch - aspect / 2, shear], [0.0, 1 + pitch + aspect / 2]])
        xy = self.corners[:, :2] @ scale.T
        z = self._sensor.pattern.surface.height(xy) + self._heights(changes)
        return build_views(self._rig.sensor(rig)), np.column_stack([xy, z])

    def _parts(self, changes: Array) -> tuple[Array, Array, Array]:
        """Those of the rig, of the print and of the surface's height."""
        of_rig = len(self._rig.free)
        of_print = of_rig + len(PRINT_STD)
        return changes[:of_rig], changes[of_rig:of_print], changes[of_print:]

    def _heights(self, changes: Array) -> Array:
        """By how much the surface is higher than described at the corners, (N,) m."""
        x, y = (self.corners[:, :2] / np.abs(self.corners[:, :2]).max()).T
        shape = np.stack([x**a * y**b for a, b in self._powers], axis=-1)
        return np.asarray(shape @ self._parts(changes)[2])


def _with_layer(sensor: SensorDescription) -> SensorDescription:
    """The sensor, if it has no layer, with one from the base of the gel on with the index of air.

    A layer that was not described shows as another index of it.
    """
    if sensor.optics.layers:
        return sensor
    base = sensor.elastomer.shading_layer.thickness - sensor.elastomer.size[2]
    layers = (RefractingLayer(base, 1.0),)
    return replace(sensor, optics=replace(sensor.optics, layers=layers))


def _spread_over(shape: tuple[int, int], count: int) -> Numbers:
    """Numbers of corners, so many along each side at most."""
    rows, cols = (
        np.unique(np.linspace(0, side - 1, min(count, side)).round().astype(np.intp))
        for side in shape
    )
    return np.asarray((rows[:, None] * shape[1] + cols).ravel(), np.intp)


def _projected(views: Mapping[str, ViewGeometry], points: Array) -> tuple[Array, Array]:
    """Pixels (N, 2 views) of points (N, 3) m, and derivatives (N, 2 views, 3) px per m."""
    found = [view.project_with_jacobian(points) for view in views.values()]
    pixels, slopes = zip(*found, strict=True)
    return np.concatenate(pixels, axis=1), np.concatenate(slopes, axis=1)
