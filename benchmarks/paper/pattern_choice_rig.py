"""Cameras of several resolutions, prints of several pitches, and what light and lens do to them."""

from __future__ import annotations

from dataclasses import replace

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import ImageSize, Roi
from cmp_tactile_simulation.rendering.camera_settings import CameraSettings

__all__ = ["CONDITIONS", "PRINT_SIDE", "STANDARD_WIDTH", "condition", "of_width", "printed"]

# The prototype's print and the width of its image, m and px.
PRINT_SIDE = 0.0145
STANDARD_WIDTH = 1024

# Blur in px of an image of the standard width.
CONDITIONS = {
    "good": CameraSettings(),
    "dim": CameraSettings(
        light_level=90.0, dark_level=35.0, light_ratio=4.0, vignette=0.4, read_noise=2.0
    ),
    "noisy": CameraSettings(read_noise=10.0),
    "soft": CameraSettings(blur=2.0),
}


def condition(name: str, width: int) -> CameraSettings:
    """The same lens, light and noise per pixel before a sensor chip of `width` px.

    What the lens blurs, it blurs on the chip: in px the more, the finer the pixels.
    """
    settings = CONDITIONS[name]
    return replace(settings, blur=settings.blur * width / STANDARD_WIDTH)


def of_width(sensor: SensorDescription, width: int) -> SensorDescription:
    """The same optics before a chip of the same size with `width` px across.

    Centres of pixels are at whole numbers, so the frame's edge is at -0.5 whatever its width.
    """
    if sensor.camera is None or any(view.camera for view in sensor.views.values()):
        msg = f"{sensor.name}: found cameras of the views' own, expected one camera and mirrors"
        raise ValueError(msg)
    factor = width / sensor.image.width
    camera = replace(
        sensor.camera,
        fx=sensor.camera.fx * factor,
        fy=sensor.camera.fy * factor,
        cx=(sensor.camera.cx + 0.5) * factor - 0.5,
        cy=(sensor.camera.cy + 0.5) * factor - 0.5,
    )
    views = {
        name: replace(view, roi=_scaled(view.roi, factor)) for name, view in sensor.views.items()
    }
    size = ImageSize(_whole(sensor.image.width * factor), _whole(sensor.image.height * factor))
    return replace(sensor, image=size, camera=camera, views=views)


def printed(sensor: SensorDescription, corners: int, points: int) -> SensorDescription:
    """The sensor with corners x corners on a print of the same size, and so many virtual markers
    in each segment.
    """
    pattern = replace(
        sensor.pattern,
        rows=corners,
        cols=corners,
        pitch=PRINT_SIDE / (corners + 1),
        points_per_segment=points,
    )
    return replace(sensor, pattern=pattern)


def _scaled(roi: Roi, factor: float) -> Roi:
    return Roi(*(_whole(length * factor) for length in (roi.x, roi.y, roi.width, roi.height)))


def _whole(length: float) -> int:
    if abs(length - round(length)) > 1e-9:
        msg = f"image: found a length of {length} px, expected a width that keeps all sizes whole"
        raise ValueError(msg)
    return round(length)
