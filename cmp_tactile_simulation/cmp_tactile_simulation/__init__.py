"""Simulator of vision-based tactile sensors: elastomer, contact, mirror optics, camera."""

from pathlib import Path

import cmp_tactile_processing  # noqa: F401  # chooses the folder of compiled functions

# As the processing core does.
__path__[:] = [str(Path(folder).resolve()) for folder in __path__]
