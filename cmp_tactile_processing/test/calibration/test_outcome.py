"""Numbers of calibrations as people read them."""

import numpy as np
import pytest

from cmp_tactile_processing.calibration.outcome import value_text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1.54e-3, "m", "1.54 mm"),
        (1.0e-3, "m", "1 mm"),
        (25e-6, "m", "25 um"),
        (1.968e-7, "m", "0.197 um"),
        (1543.2, "px", "1540 px"),
        (0.0000131, "px", "0.0000131 px"),
        (np.radians(5e-5), "rad", "0.00005 deg"),
        (0.4567, "", "45.67%"),
        (np.nan, "m", "nan mm"),
    ],
)
def test_a_figure_is_one_text_wherever_it_stands(value, unit, text):
    """Table and verdict of a check had 1.54 mm and 1.54e+03 um of one figure.

    Reports of the kind, tried here:
    kajf/bozr 85 (an error says 6.466547e+06 of what the user wrote as 6466547), joshwlewis/unitwise
    13 (0.2E2 for 20): no power of ten in any text of a calibration's figures.
    """
    assert value_text(value, unit) == text
