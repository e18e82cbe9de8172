"""The material before and after, value by value, as the description names them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily
from cmp_tactile_processing.calibration.material.fit import MaterialFit
from cmp_tactile_processing.calibration.outcome import Estimate
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

__all__ = ["material_estimates", "material_record"]

# Young's modulus is always fitted; it counts as determined below this share of its prior deviation.
HELD_SHARE = 0.5


def material_estimates(
    sensor: SensorDescription, family: ComplianceFamily, fit: MaterialFit
) -> tuple[Estimate, ...]:
    """Estimates of all values of the material, those that were not fitted included.

    The shading layer's modulus keeps its ratio to the gel's where the loads do not tell it, so it
    changes with the gel's, and counts as determined only where that ratio is.
    """
    before = sensor.elastomer
    after = family.shape(fit.shape).of(before, fit.young)
    std = np.sqrt(np.diag(fit.covariance))
    spread = {"young": float(std[0])}
    told = {"young": bool(fit.open_share[0] <= HELD_SHARE)}
    for k, name in enumerate(family.names):
        spread[name], told[name] = float(std[1 + k]), not bool(fit.held[k])
    ratio = family.names.index("layer_ratio") + 1 if "layer_ratio" in family.names else None
    layer_std = spread["young"]
    if ratio is not None:
        both = np.ix_([0, ratio], [0, ratio])
        layer_std = float(np.sqrt(fit.covariance[both].sum()))
    old, new = before.shading_layer, after.shading_layer
    thickness = after.size[2] * spread.get("thickness", 0.0)
    rows = [
        ("young", "young", "Pa", before.young, after.young, after.young * spread["young"]),
        ("poisson", "poisson", "", before.poisson, after.poisson, spread.get("poisson", 0.0)),
        ("thickness", "size[2]", "m", before.size[2], after.size[2], thickness),
    ]
    if old.thickness > 0:
        layer = new.thickness * spread.get("layer_thickness", 0.0)
        key, name = "layer_thickness", "shading_layer.thickness"
        rows.append((key, name, "m", old.thickness, new.thickness, layer))
        layer = new.young * layer_std
        rows.append(("layer_ratio", "shading_layer.young", "Pa", old.young, new.young, layer))
    return tuple(
        Estimate(f"elastomer.{name}", unit, one, other, deviation, told.get(key, False))
        for key, name, unit, one, other, deviation in rows
    )


def material_record(
    method: str, samples: int, estimates: Sequence[Estimate], force_std: tuple[float, float]
) -> MaterialRecord:
    """What a description keeps of the estimates; force_std: relative, normal and tangential."""
    known = {item.name: item for item in estimates}
    young, poisson = known["elastomer.young"], known["elastomer.poisson"]
    return MaterialRecord(
        method=method,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        samples=samples,
        normal_std=force_std[0],
        tangential_std=force_std[1],
        young_std=young.std / young.after if young.determined else float("nan"),
        poisson_std=poisson.std if poisson.determined else float("nan"),
        determined=tuple(item.name for item in estimates if item.determined),
        held=tuple(item.name for item in estimates if not item.determined),
    )
