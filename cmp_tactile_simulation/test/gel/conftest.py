"""Gels for the tests of the elastomer: small ones that are quick to solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.gel import LinearElastomer

CONFIG = Path(__file__).parents[3] / "cmp_tactile_processing" / "config"


@pytest.fixture(scope="session")
def prototype() -> SensorDescription:
    """The packaged prototype: 22 x 22 x 6 mm, sphere cap of 27 mm."""
    return SensorDescription.load(CONFIG / "prototype.yaml")


@pytest.fixture(scope="session")
def gel(prototype: SensorDescription) -> Callable[..., SensorDescription]:
    """Makes a sensor with 5 x 7 mm of pattern on a block of 8 x 9 x 4 mm."""

    def make(
        surface: PatternSurface = PatternSurface("sphere_cap", 0.015),  # noqa: B008
        layer: float = 3e-4,
        rows: int = 13,
        cols: int = 9,
        poisson: float = 0.48,
    ) -> SensorDescription:
        pattern = replace(prototype.pattern, surface=surface, rows=rows, cols=cols, pitch=5e-4)
        skin = replace(prototype.elastomer.shading_layer, thickness=layer, young=1e6)
        elastomer = replace(
            prototype.elastomer, size=(8e-3, 9e-3, 4e-3), poisson=poisson, shading_layer=skin
        )
        name = f"{surface.type}_{rows}x{cols}"
        return replace(prototype, name=name, pattern=pattern, elastomer=elastomer)

    return make


@pytest.fixture(scope="session")
def elastomer(
    gel: Callable[..., SensorDescription], tmp_path_factory: pytest.TempPathFactory
) -> LinearElastomer:
    """A sphere cap with a skin, 11 x 9 contact nodes."""
    return LinearElastomer(gel(), 11, tmp_path_factory.mktemp("cache"))
