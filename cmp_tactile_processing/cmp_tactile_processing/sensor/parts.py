"""The parts of a sensor description: camera, optics, views, elastomer, records."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "CalibrationRecord",
    "Camera",
    "Elastomer",
    "GelRelaxation",
    "ImageSize",
    "MaterialRecord",
    "Mirror",
    "Optics",
    "RefractingLayer",
    "Roi",
    "ShadingLayer",
    "ViewDescription",
]


@dataclass(frozen=True)
class ImageSize:
    """Size of the camera frame, px."""

    width: int
    height: int


@dataclass(frozen=True)
class Camera:
    """Intrinsics: focal lengths and principal point in px of the whole frame.

    model: pinhole with distortion (k1, k2, p1, p2, k3), or equidistant with (k1, k2, k3, k4).
    """

    model: str
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class RefractingLayer:
    """From the plane z (gel frame, m) towards the gel the refractive index is `index`."""

    z: float
    index: float


@dataclass(frozen=True)
class Optics:
    """How the camera sees the gel.  T_camera_gel: (4, 4), absent for two_view."""

    type: str
    T_camera_gel: NDArray[np.float64] | None
    layers: tuple[RefractingLayer, ...]


@dataclass(frozen=True)
class Mirror:
    """The plane {p : normal . p = distance} in the camera's optical frame, m; normal (3,) unit."""

    normal: NDArray[np.float64]
    distance: float


@dataclass(frozen=True)
class Roi:
    """Part of the frame: top-left pixel (x, y) and size, px."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class ViewDescription:
    """One view: its part of the frame, and the mirror or the camera of its own.

    T_view_gel: (4, 4), gel frame -> optical frame of the view's own camera.
    """

    roi: Roi
    mirror: Mirror | None = None
    camera: Camera | None = None
    T_view_gel: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class ShadingLayer:
    """The opaque skin above the marker surface: thickness in m, Young's modulus in Pa."""

    thickness: float
    young: float


@dataclass(frozen=True)
class GelRelaxation:
    """How the gel yields while it is held: E(t) = young (1 - share + share exp(-t / time)).

    share: of the modulus that is lost in the long run, 0 to 1; time: s.  One Prony term, the same
    for all components, so `young` is the modulus of a quick press.
    """

    share: float
    time: float


@dataclass(frozen=True)
class MaterialRecord:
    """What the moduli of a description were measured with, and how well they are known.

    method: weights or force_sensor; date: ISO 8601, UTC; samples: loads that were used.
    young_std, poisson_std: relative and absolute standard deviation, NaN where held.
    normal_std, tangential_std: relative standard deviations of normal and tangential force that
    follow from these and from how they hang together.
    determined, held: names of the parameters that the data told, and of those that were kept.
    """

    method: str
    date: str
    samples: int
    normal_std: float
    tangential_std: float
    young_std: float = float("nan")
    poisson_std: float = float("nan")
    determined: tuple[str, ...] = ()
    held: tuple[str, ...] = ()


@dataclass(frozen=True)
class Elastomer:
    """The gel: size (x, y, thickness at the apex, shading layer included) in m, moduli in Pa."""

    size: tuple[float, float, float]
    young: float
    poisson: float
    model: str
    shading_layer: ShadingLayer
    relaxation: GelRelaxation | None = None
    calibration: MaterialRecord | None = None


@dataclass(frozen=True)
class CalibrationRecord:
    """What the optical values of a description were measured with.

    method: board or gel; date: ISO 8601, UTC; frames: used; reprojection: RMS, px; ray_gap: RMS
    length of the common normal at rest, m, NaN for one view.  determined, held: names of the
    parameters that the data told, and of those that kept what was known before.
    """

    method: str
    date: str
    frames: int
    reprojection: float
    ray_gap: float = float("nan")
    determined: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
