"""Calibration from images of a board, before the gel is mounted: of mirrors or of plain cameras.

The board is looked for in every image, then camera and rig are fitted to all images together
(bundle adjustment); what is wrong with images or result is told in words.  An outcome with an ERROR
must not be used; where the images themselves do not serve, nothing is fitted.
"""

from cmp_tactile_processing.calibration.board.cameras import calibrate_cameras
from cmp_tactile_processing.calibration.board.mirrors import calibrate_mirror_rig

__all__ = ["calibrate_cameras", "calibrate_mirror_rig"]
