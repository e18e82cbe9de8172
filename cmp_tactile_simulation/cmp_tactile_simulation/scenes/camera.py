"""The camera of a scene: frames of a deformed gel, and what is true of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_simulation.rendering.camera import expose
from cmp_tactile_simulation.rendering.ink import ink_of
from cmp_tactile_simulation.rendering.optical_truth import OpticalTruth
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene

__all__ = ["CameraView", "SceneCamera"]


@dataclass(frozen=True)
class CameraView:
    """A frame (H, W) uint8 and its truth: grids by view, px of the view; surface, gel frame."""

    image: NDArray[np.uint8]
    grids: Mapping[str, Grid]
    surface: Surface


class SceneCamera:
    """Sensor optics, ink and camera settings of a scene.

    observers: the grid that displacements are given on.
    """

    def __init__(self, scene: Scene, observers: SurfaceGrid) -> None:
        self._scene = scene
        self._observers = observers
        ink = ink_of(scene.sensor.pattern, scene.pattern_type, scene.defects, scene.seed)
        self._renderer = Renderer(scene.sensor, ink, samples=scene.samples)
        self._truth = OpticalTruth(scene.sensor)

    def observe(
        self, frame: int, before: NDArray[np.float64], now: NDArray[np.float64]
    ) -> CameraView:
        """Frame number `frame` and its truth.

        before, now (rows, cols, 3) m: displacement of the observers in the frame before and in
        this one; motion blur sees the last part of the way, and what is true of the markers is
        then the middle of the exposure.
        """
        scene = self._scene
        camera = scene.camera
        backs = self._exposures()
        images = [self._renderer.render(self._surface(now - b * (now - before))) for b in backs]
        surface = self._surface(now - backs.mean() * (now - before))
        # Noise of a frame must not depend on the frames that were rendered before it.
        rng = random_stream(Purpose.FRAME_NOISE, scene.seed, frame)
        return CameraView(
            image=expose(images, camera, rng, scene.seed),
            grids=self._truth.grids(surface),
            surface=self._truth.surface(surface),
        )

    def _exposures(self) -> NDArray[np.float64]:
        """When the camera looks: shares of a frame's time before the frame's end."""
        camera = self._scene.camera
        if camera.motion_samples == 1:
            return np.zeros(1)
        open_share = min(1.0, camera.exposure_time * self._scene.rate)
        return np.linspace(open_share, 0.0, camera.motion_samples)

    def _surface(self, displacement: NDArray[np.float64]) -> DeformedSurface:
        return DeformedSurface(self._scene.sensor.pattern, self._observers, displacement)
