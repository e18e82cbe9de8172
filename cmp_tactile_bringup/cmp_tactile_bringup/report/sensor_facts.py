"""A sensor in words and numbers: its description, and the geometry that follows from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.misfit import margin_words
from cmp_tactile_processing.force.systematics import material_std
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig

# What a corner is located to in a good image, px.
CORNER_ERROR_PX = 0.05


def description_facts(sensor: SensorDescription) -> dict[str, str]:
    """The main entries of the description."""
    pattern, elastomer, layer = sensor.pattern, sensor.elastomer, sensor.elastomer.shading_layer
    radius = (
        f", radius {pattern.surface.radius * 1e3:g} mm" if pattern.surface.type != "plane" else ""
    )
    models = {view.camera.model for view in sensor.views.values() if view.camera}
    models |= {sensor.camera.model} if sensor.camera else set()
    size = " x ".join(f"{length * 1e3:g}" for length in elastomer.size)
    optics = {"Optics": "none: another device measures the markers"}
    if sensor.views:
        optics = {
            "Camera frame": f"{sensor.image.width} x {sensor.image.height} px",
            "Camera model": ", ".join(sorted(models)),
            "Optics": f"{sensor.optics.type}, {len(sensor.optics.layers)} refracting layers",
        }
    return {
        "ROS namespace": f"/{sensor.ros_name}",
        **optics,
        "Pattern": f"{pattern.rows} x {pattern.cols} inner corners, "
        f"pitch {pattern.pitch * 1e3:.4g} mm, {pattern.points_per_segment} virtual markers between",
        "Surface": f"{pattern.surface.type}{radius}",
        "Gel": f"{size} mm, {elastomer.model}, Young's modulus {elastomer.young / 1e3:g} kPa, "
        f"Poisson's ratio {elastomer.poisson:g}",
        "Shading layer": f"{layer.thickness * 1e3:g} mm, {layer.young / 1e3:g} kPa",
        "Forces known to": _uncertainty_words(sensor),
    }


def _uncertainty_words(sensor: SensorDescription) -> str:
    """How well the size of forces is known by the gel, and what of the description was assumed."""
    words = f"{material_std(sensor):.1%} by what is known of the gel (one standard deviation)"
    assumed = sensor.uncertainty.assumed
    if assumed:
        words += f"; assumed, not measured: {', '.join(assumed)}"
    return f"{words}; {sensor.size_doubt}" if sensor.size_doubt else words


def geometry_facts(sensor: SensorDescription) -> dict[str, str]:
    """Views, image scale, baseline, and what an error in the image means in space."""
    rig = StereoRig(sensor)
    facts: dict[str, str] = {}
    for name, view in rig.views.items():
        place = view.placement
        flipped = ", mirrored back" if place.flipped else ""
        scale = _px_per_mm(view, sensor)
        facts[f"View {name}"] = (
            f"{place.width} x {place.height} px at ({place.x}, {place.y}){flipped}, camera centre "
            f"{_mm(view.centre)} mm"
        )
        facts[f"Scale {name}"] = (
            f"{np.median(scale):.1f} px/mm ({scale.min():.1f} to {scale.max():.1f})"
        )
        side = scale * sensor.pattern.pitch * 1e3
        facts[f"Pattern {name}"] = (
            f"{margin_words(view, sensor)}; checkers of {np.median(side):.1f} px "
            f"({side.min():.1f} to {side.max():.1f})"
        )
    if len(rig.views) < 2:
        return {
            **facts,
            "Depth": "none: with one view, the height is that of the described surface",
            "Normal force": (
                "inferred, not measured: one view shows how the markers spread, not their depth. "
                "Every force has the flag NO_DEPTH. Shear is measured"
            ),
        }
    errors = position_errors(sensor, CORNER_ERROR_PX)
    middle = np.median(errors, axis=(0, 1)) * 1e6
    return {
        **facts,
        "Baseline": f"{rig.baseline * 1e3:.2f} mm",
        "Resolution": (
            f"an error of {CORNER_ERROR_PX} px in every corner causes {middle[0]:.2f} um in x, "
            f"{middle[1]:.2f} um in y, {middle[2]:.2f} um in depth (median over the pattern)"
        ),
    }


def position_errors(sensor: SensorDescription, corner_error_px: float) -> NDArray[np.float64]:
    """(rows, cols, 3) standard deviation of x, y, z, m, by independent errors in both views.

    First order: the covariance of the least-squares point is (J^T J)^-1 times the variance.
    """
    corners = sensor.pattern.corners()
    jacobians = [
        view.project_with_jacobian(corners)[1] for view in StereoRig(sensor).views.values()
    ]
    J = np.concatenate(jacobians, axis=-2)
    covariance = np.linalg.inv(np.swapaxes(J, -1, -2) @ J)
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)) * corner_error_px


def _px_per_mm(view: ViewGeometry, sensor: SensorDescription) -> NDArray[np.float64]:
    """Image scale at each corner, over both directions of the gel's plane."""
    in_plane = view.project_with_jacobian(sensor.pattern.corners())[1][..., :2]
    return np.sqrt(np.abs(np.linalg.det(in_plane))) * 1e-3


def _mm(point: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value * 1e3:.2f}" for value in point) + ")"
