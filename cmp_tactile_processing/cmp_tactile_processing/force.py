"""Force stage: from the displacement of the markers to the force that the object exerts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from cmp_tactile_processing.elastic_model import ElasticModel, Progress
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force_field import ForceField, SlipState
from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.traction_inverse import TikhonovInverse, hat_penalty

__all__ = ["ForceModel"]


class ForceModel:
    """Reconstructs force by inverting the linear elastic model of a sensor's gel (paper, V.D).

    cache_dir, progress: see ElasticModel.  Raises GeometryError for a block without a base.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        cache_dir: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._sensor = sensor
        self._parameters = parameters = sensor.force
        self.elastic = ElasticModel(sensor, cache_dir, progress)
        nodes, markers = self.elastic.nodes, self.elastic.markers
        noise = (parameters.noise_in_plane, parameters.noise_in_plane, parameters.noise_depth)
        self._inverse = TikhonovInverse(
            self.elastic.compliance,
            np.tile(noise, markers.rows * markers.cols),
            hat_penalty((nodes.rows, nodes.cols), nodes.spacing, parameters.smoothing_length),
            parameters.regularization,
        )
        self._position = self.elastic.node_position
        self._projected_area = nodes.spacing[0] * nodes.spacing[1]
        self._area = self._projected_area * self.elastic.node_stretch
        deviation = self._inverse.deviation[2::3]
        self._pressure_floor = np.maximum(
            parameters.contact_pressure_floor,
            parameters.contact_deviations * deviation / self._projected_area,
        )

    def reconstruct(
        self, displacement: NDArray[np.float64], status: NDArray[np.uint8]
    ) -> ForceField:
        """Force on the gel from the displacement of the markers.

        displacement (rows, cols, 3) m, gel frame; status (rows, cols).  A marker with status 0
        and any component that is not finite count as not measured.  Too few markers give a field
        of NaN.  Raises GeometryError for arrays of other shapes.
        """
        moved, known = self._measurements(displacement, status)
        valid = float(np.mean(known.any(axis=1)))
        if valid < self._parameters.min_valid_fraction or not known.any():
            return self._unknown(valid)
        force = self._inverse.solve(moved.ravel(), known.ravel()).reshape(-1, 3)
        contact = self._contact(force)
        place = self._place(force)
        wrench = np.concatenate([force.sum(axis=0), np.cross(place, force).sum(axis=0)])
        centre = np.full(3, np.nan)
        if contact.any():
            normal = force[contact, 2]
            centre = normal @ place[contact] / normal.sum()
        return self._field(force, contact, wrench, centre, valid)

    def _measurements(
        self, displacement: NDArray[np.float64], status: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Displacement and what of it is known, both (markers, 3)."""
        shape = self.elastic.markers.rows, self.elastic.markers.cols
        moved, states = np.asarray(displacement, dtype=np.float64), np.asarray(status)
        for name, found, expected in (
            ("displacement", moved.shape, (*shape, 3)),
            ("status", states.shape, shape),
        ):
            if found != expected:
                msg = f"{self._sensor.name}: {name}: found shape {found}, expected {expected}"
                raise GeometryError(msg)
        known = np.isfinite(moved) & (states != Status.MISSING)[..., None]
        return moved.reshape(-1, 3), known.reshape(-1, 3)

    def _contact(self, force: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Nodes whose normal pressure stands out of the noise and is not small beside the peak."""
        # On a sloping surface -f_z per area seen along z is the pressure on the surface.
        pressure = -force[:, 2] / self._projected_area
        share = self._parameters.contact_threshold * pressure.max()
        return np.asarray(pressure > np.maximum(self._pressure_floor, share))

    def _place(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the forces act: the force nodes moved as the markers below them, (nodes, 3) m."""
        markers = self.elastic.markers
        moved = RegularGridInterpolator((markers.y, markers.x), self.elastic.displacement(force))
        return np.asarray(self._position + moved(self.elastic.nodes.points[:, ::-1]))

    def _unknown(self, valid: float) -> ForceField:
        force = np.full(self._position.shape, np.nan)
        contact = np.zeros(len(force), dtype=bool)
        return self._field(force, contact, np.full(6, np.nan), np.full(3, np.nan), valid)

    def _field(
        self,
        force: NDArray[np.float64],
        contact: NDArray[np.bool_],
        wrench: NDArray[np.float64],
        centre: NDArray[np.float64],
        valid_fraction: float,
    ) -> ForceField:
        known = bool(np.isfinite(wrench).all())
        return ForceField(
            rows=self.elastic.nodes.rows,
            cols=self.elastic.nodes.cols,
            position=self._position,
            force=force,
            contact=contact,
            wrench=wrench,
            contact_area=float(self._area[contact].sum()) if known else float("nan"),
            centre_of_pressure=centre,
            reference_point=np.zeros(3),
            slip_state=SlipState.UNKNOWN if contact.any() or not known else SlipState.NO_CONTACT,
            valid_fraction=valid_fraction,
            regularization=self._parameters.regularization,
            young=self._sensor.elastomer.young,
            poisson=self._sensor.elastomer.poisson,
        )
