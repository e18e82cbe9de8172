"""A simulated indenter; a live one is pressed, dragged and twisted by the mouse."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import viser

from cmp_tactile_viewer.scene.surface_mesh import MM
from cmp_tactile_viewer.snapshot import Pose, Touch

SIZE_MM, BALL_MM = 4.0, 0.4
COLOUR = (240, 228, 66)
# After so long without the mouse the handle is where the indenter is again.
RELEASED_S = 2.0


class DraggedIndenter:
    """A handle in the scene, and a ball where the indenter's origin really is.

    The indenter follows at its own speed, and stands still where the gel cannot be pressed further.
    """

    def __init__(self, scene: viser.SceneApi, root: str, touch: Touch, *, may_move: bool) -> None:
        self._touch, self._dragged_s = touch, -RELEASED_S
        self._ball = scene.add_icosphere(
            f"{root}/indenter", radius=BALL_MM, color=COLOUR, visible=False
        )
        self._handle: viser.TransformControlsHandle | None = None
        if may_move and touch.move is not None:
            self._handle = scene.add_transform_controls(
                f"{root}/handle", SIZE_MM, depth_test=False, opacity=0.8, visible=False
            )
            self._handle.on_update(self._drag)

    def draw(self) -> None:
        """Show where it is."""
        pose = self._touch.pose
        if pose is None:
            return
        position, orientation = MM * np.array(pose.position), np.array(pose.orientation)
        self._ball.visible, self._ball.position = True, position
        if self._handle is not None and time.monotonic() - self._dragged_s > RELEASED_S:
            self._handle.visible = True
            self._handle.position, self._handle.wxyz = position, orientation

    def _drag(self, event: Any) -> None:
        if event.client is None or self._handle is None or self._touch.move is None:
            return
        self._dragged_s = time.monotonic()
        x, y, z = (self._handle.position / MM).tolist()
        a, b, c, d = self._handle.wxyz.tolist()
        self._touch.move(Pose((x, y, z), (a, b, c, d)))
