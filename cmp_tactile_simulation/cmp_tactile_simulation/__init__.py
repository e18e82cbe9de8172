"""Simulator of vision-based tactile sensors: elastomer, contact, mirror optics, camera."""

from cmp_tactile_simulation.compiled_cache import use_cache_of_these_sources

use_cache_of_these_sources()
