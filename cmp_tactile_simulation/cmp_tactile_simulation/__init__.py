"""Simulator of vision-based tactile sensors: elastomer, contact, mirror optics, camera."""

from pathlib import Path

import cmp_tactile_processing
from cmp_tactile_processing.cache.compiled import use_cache_of_these_sources

# As the processing core does.
__path__[:] = [str(Path(folder).resolve()) for folder in __path__]
# Functions of the processing core are compiled into those of the simulator.
use_cache_of_these_sources(Path(cmp_tactile_processing.__file__).parent, Path(__file__).parent)
