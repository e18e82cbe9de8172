"""Splits a camera frame into the views that the mirrors show."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.grid import ViewPlacement

__all__ = ["check_image", "split_frame", "to_grey"]


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey image (H, W) uint8 of a grey (H, W) or BGR (H, W, 3) one.

    Raises FrameError for another type or shape.
    """
    image = np.asarray(image)
    if image.dtype != np.uint8:
        msg = f"image: found type {image.dtype}, expected uint8"
        raise FrameError(msg)
    if image.ndim == 2:
        return image
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if image.ndim == 3 and image.shape[2] == 1:
        return image[:, :, 0]
    msg = f"image: found shape {image.shape}, expected (height, width) or (height, width, 3)"
    raise FrameError(msg)


def check_image(image: NDArray[np.uint8], width: int, height: int, name: str) -> None:
    """Raise FrameError unless the image is height x width (x 3)."""
    if np.shape(image)[:2] != (height, width):
        found = " x ".join(str(side) for side in np.shape(image)[1::-1])
        msg = f"{name}: found {found} px, expected {width} x {height} px"
        raise FrameError(msg)


def split_frame(frame: NDArray[np.uint8], placement: ViewPlacement) -> NDArray[np.uint8]:
    """The view at that place of the frame, cut out and un-mirrored, as a contiguous copy."""
    bottom, right = placement.y + placement.height, placement.x + placement.width
    if frame.shape[0] < bottom or frame.shape[1] < right:
        found = f"{frame.shape[1]} x {frame.shape[0]}"
        msg = f"frame: found {found} px, expected at least {right} x {bottom} px"
        raise FrameError(msg)
    view = frame[placement.y : bottom, placement.x : right]
    return np.ascontiguousarray(view[:, ::-1] if placement.flipped else view)
