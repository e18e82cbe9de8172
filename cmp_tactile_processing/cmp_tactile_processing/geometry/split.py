"""Splits a camera frame into the views that the mirrors show, and makes grey of colour."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.parameters import TrackingParameters, check_grey_weights

LUMINANCE = TrackingParameters().grey_weights


def to_grey(
    image: NDArray[np.uint8],
    weights: tuple[float, float, float] = LUMINANCE,
    dst: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Grey image (H, W) uint8 of a grey (H, W) or BGR (H, W, 3) one.

    weights: of red, green and blue.  Their sum over the colours is shifted and scaled so that it
    reaches from 0 to 255 over all colours that there are: (1, -1, 0) makes red white, green black
    and grey 127.  A grey image is returned as it is.
    dst (H, W) uint8: where the grey values of a colour image are put.
    Raises FrameError for another type or shape, InputError for weights that leave all
    colours alike.
    """
    image = np.asarray(image)
    _check_pixels(image, "image")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    if weights == LUMINANCE:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=dst), dtype=np.uint8)
    grey = cv2.transform(image, _projection(weights), dst=dst)
    return np.asarray(grey, dtype=np.uint8).reshape(image.shape[:2])


def _projection(weights: tuple[float, float, float]) -> NDArray[np.float64]:
    """Grey value as (1, 4) matrix on (blue, green, red, 1)."""
    check_grey_weights(weights)
    bgr = np.array(weights[::-1], dtype=np.float64)
    bgr /= np.abs(bgr).sum()
    return np.append(bgr, -255 * np.minimum(bgr, 0).sum())[None]


def _check_pixels(image: NDArray[np.uint8], name: str) -> None:
    if image.dtype != np.uint8:
        msg = f"{name}: found type {image.dtype}, expected uint8"
        raise FrameError(msg)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)):
        msg = f"{name}: found shape {image.shape}, expected (height, width) or (height, width, 3)"
        raise FrameError(msg)


def check_image(image: NDArray[np.uint8], width: int, height: int, name: str) -> None:
    """Raise FrameError unless the image is height x width (x 3) and uint8."""
    image = np.asarray(image)
    if image.shape[:2] != (height, width):
        found = " x ".join(str(side) for side in image.shape[1::-1]) or "0"
        msg = f"{name}: found {found} px, expected {width} x {height} px"
        raise FrameError(msg)
    _check_pixels(image, name)


def split_frame(
    frame: NDArray[np.uint8], placement: ViewPlacement, dst: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """The view at that place of the frame, cut out and un-mirrored, as a contiguous copy.

    dst: contiguous, of the view's shape and the frame's channels; where the view is put.
    Raises FrameError where the view is not within the frame.
    """
    bottom, right = placement.y + placement.height, placement.x + placement.width
    if frame.shape[0] < bottom or frame.shape[1] < right:
        found = f"{frame.shape[1]} x {frame.shape[0]}"
        msg = f"frame: found {found} px, expected at least {right} x {bottom} px"
        raise FrameError(msg)
    view = frame[placement.y : bottom, placement.x : right]
    if dst is None:
        dst = np.empty(view.shape, dtype=view.dtype)
    if placement.flipped:
        cv2.flip(view, 1, dst=dst)
    else:
        np.copyto(dst, view)
    return dst
