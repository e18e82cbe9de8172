"""What can be read of a contact: a method, with its virtual markers or by its corners alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import Chain
from paper.dot_methods import DMP_FLOW, DMP_GRID, DMP_NEAREST
from paper.film import Film
from paper.mechanics import Mechanics
from paper.method import CMP, CMP_PAPER, Method
from paper.without_virtual import without_virtual

__all__ = ["MEASURED", "READINGS", "Reading", "Reels", "Take"]

REST_FRAMES = 3
# Noise differs with a frame's number, and so by the seed.
NUMBERS_PER_SEED = 10_000


@dataclass(frozen=True)
class Take:
    """One course of frames as one method measured it.

    method: key.  seed: of the noise.  rest: at rest, measured REST_FRAMES times.
    surfaces: by number of the frame in the mechanics.
    """

    method: str
    seed: int
    rest: Sequence[Surface]
    surfaces: Mapping[int, Surface]


@dataclass(frozen=True)
class Reading:
    """key: of results; label: of tables.  method: None for exact markers.

    corners_only: virtual markers are left out; dots have none.
    """

    key: str
    label: str
    method: Method | None
    corners_only: bool = False

    def of(self, surface: Surface) -> Surface:
        """What the reading takes of a surface."""
        return without_virtual(surface) if self.corners_only else surface

    def takes(self, measured: Sequence[Take], exact: Take) -> list[Take]:
        """Those of its method, or the exact markers."""
        if self.method is None:
            return [exact]
        return [take for take in measured if take.method == self.method.key]


READINGS = (
    Reading("cmp", "CMP, with virtual markers", CMP),
    Reading("cmp_corners", "CMP, corners only", CMP, corners_only=True),
    Reading("cmp_paper", "CMP of the paper, with virtual markers", CMP_PAPER),
    Reading("dmp_nearest", "DMP, nearest neighbour", DMP_NEAREST, corners_only=True),
    Reading("dmp_grid", "DMP, ordered by its grid", DMP_GRID, corners_only=True),
    Reading("dmp_flow", "DMP, optical flow", DMP_FLOW, corners_only=True),
    Reading("exact", "exact markers, virtual ones included", None),
    Reading("exact_corners", "exact markers, corners only", None, corners_only=True),
)
MEASURED = tuple(reading for reading in READINGS if reading.method is not None)


class Reels:
    """Frames of mechanics on both prints, rendered once, to be measured under several noises."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.sensor = sensor
        self._films = {kind: Film(sensor, kind) for kind in ("cmp", "dmp")}
        rest = DeformedSurface.rest(sensor.pattern)
        self._rest = {kind: film.rendered(rest) for kind, film in self._films.items()}
        methods = {r.method.key: r.method for r in MEASURED if r.method is not None}
        self._methods = tuple(methods.values())
        self._chains: dict[tuple[str, int], tuple[Chain, Sequence[Surface]]] = {}

    def takes(
        self, mechanics: Mechanics, frames: Sequence[int], seeds: Sequence[int]
    ) -> Iterator[Take]:
        """Measure these frames in order, from rest, with every method under every noise."""
        rendered = {
            kind: [film.rendered(mechanics.surface(f, self.sensor.pattern)) for f in frames]
            for kind, film in self._films.items()
        }
        for method in self._methods:
            for seed in seeds:
                yield self._take(method, frames, rendered[method.pattern_type], seed)

    def true_surface(self, mechanics: Mechanics, frame: int) -> Surface:
        """Exact markers of a frame."""
        return self._films["cmp"].truth(mechanics.surface(frame, self.sensor.pattern)).surface

    @property
    def rest_surface(self) -> Surface:
        """Exact markers of the gel at rest."""
        return self._films["cmp"].truth(DeformedSurface.rest(self.sensor.pattern)).surface

    def _take(
        self, method: Method, frames: Sequence[int], rendered: Sequence[RenderedFrame], seed: int
    ) -> Take:
        film, first = self._films[method.pattern_type], seed * NUMBERS_PER_SEED
        chain, rest = self._at_rest(method, seed)
        chain.reset()
        surfaces = {
            frame: chain.measure(film.exposed(item, first + REST_FRAMES + place)).surface
            for place, (frame, item) in enumerate(zip(frames, rendered, strict=True))
        }
        return Take(method.key, seed, rest, surfaces)

    def _at_rest(self, method: Method, seed: int) -> tuple[Chain, Sequence[Surface]]:
        """A chain that has its reference, and what it measures of the frames of that."""
        if (method.key, seed) not in self._chains:
            film, first = self._films[method.pattern_type], seed * NUMBERS_PER_SEED
            rendered = self._rest[method.pattern_type]
            images = [film.exposed(rendered, first + number) for number in range(REST_FRAMES)]
            chain = Chain(self.sensor, method)
            chain.set_reference(images)
            rest = [chain.measure(image).surface for image in images]
            self._chains[method.key, seed] = chain, rest
        return self._chains[method.key, seed]
