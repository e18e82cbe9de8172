"""What the camera makes of the light: a field for each way in which a real frame falls short."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["CameraSettings"]


@dataclass(frozen=True)
class CameraSettings:
    """Light, lens, dirt and sensor noise.  Lengths in px of the frame, light in grey levels 0..255.

    The defaults are a good camera's: a little blur, vignetting and noise, nothing else.
    Raises ParameterError for a value outside its range.
    """

    light_level: float = parameter(
        205.0, "grey of the light skin where it is lit best", unit="grey levels", low=1, high=1000
    )
    dark_level: float = parameter(
        45.0, "grey of the dark ink where it is lit best", unit="grey levels", low=0, high=1000
    )
    light_ratio: float = parameter(
        1.0, "brightest over darkest illumination across the frame", low=1, high=100
    )
    light_direction: float = parameter(
        0.0,
        "direction in which the light fades, from the frame's x axis (right) towards y (down)",
        unit="rad",
        low=-2 * math.pi,
        high=2 * math.pi,
    )
    vignette: float = parameter(
        0.15,
        "share of the light lost in the frame's corners; it grows with the square of the distance "
        "from the frame's centre",
        low=0,
        high=1,
    )
    blur: float = parameter(
        0.7, "standard deviation of the blur where the lens is in focus", unit="px", low=0, high=20
    )
    defocus: float = parameter(
        0.0,
        "standard deviation of the further blur at the frame's point farthest from the line in "
        "focus; it grows in proportion to the distance from that line",
        unit="px",
        low=0,
        high=20,
    )
    focus_position: float = parameter(
        0.5,
        "where the line in focus crosses the frame along focus_direction, 0 at its beginning, "
        "1 at its end",
        low=0,
        high=1,
    )
    focus_direction: float = parameter(
        math.pi / 2,
        "direction across the line in focus, from the frame's x axis (right) towards y (down)",
        unit="rad",
        low=-2 * math.pi,
        high=2 * math.pi,
    )
    glare_spots: int = parameter(
        0, "number of glare spots, at places set by the seed", low=0, high=200
    )
    glare_size: float = parameter(
        12.0, "standard deviation of a glare spot's light", unit="px", low=0.5, high=500
    )
    glare_strength: float = parameter(
        400.0, "light at the centre of a glare spot", unit="grey levels", low=0, high=10000
    )
    clutter: int = parameter(
        0,
        "number of dust grains and hairs on the optics, at places set by the seed",
        low=0,
        high=2000,
    )
    motion_samples: int = parameter(
        1, "states of the gel averaged in one exposure: motion blur", low=1, high=64
    )
    exposure_time: float = parameter(
        0.01, "time over which those states are spread", unit="s", low=0, high=10
    )
    full_well: float = parameter(
        0.0,
        "electrons at grey 255, which set the shot noise; 0 for none",
        unit="electrons",
        low=0,
        high=1e7,
    )
    read_noise: float = parameter(
        1.0,
        "standard deviation of the noise that does not depend on the light",
        unit="grey levels",
        low=0,
        high=100,
    )
    salt_and_pepper: float = parameter(
        0.0, "share of the pixels that are white or black by chance", low=0, high=1
    )

    def __post_init__(self) -> None:
        check_parameters(self, "camera")
        if not self.dark_level < self.light_level:
            msg = (
                f"camera.dark_level: found {self.dark_level}, "
                f"expected less than light_level, {self.light_level}"
            )
            raise ParameterError(msg)
