"""Files and texts of a calibration: names, what is kept, units that people read."""

import numpy as np
import pytest

from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles
from cmp_tactile_bringup.report.calibration import estimate_table
from cmp_tactile_processing.calibration.outcome import Estimate
from cmp_tactile_processing.errors import OutputError

VIEWS = ("left", "right")


@pytest.mark.parametrize("there", ["my.yaml", "my_left.yaml", "my_right.yaml"])
def test_any_earlier_file_keeps_the_work_from_being_begun(there, tmp_path):
    (tmp_path / there).write_text("precious")
    files = CalibrationFiles.of_sensor(tmp_path / "my.yaml", VIEWS)
    with pytest.raises(OutputError, match=f"{there}: exists already; --overwrite"):
        files.check_free(overwrite=False)
    files.check_free(overwrite=True)


def test_a_file_is_no_folder_for_cameras(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="found a file, expected a folder"):
        CalibrationFiles.of_cameras(tmp_path / "file", ("left",))


def test_estimates_are_in_millimetres_and_degrees_as_exact_as_they_are_known():
    rows = estimate_table(
        [
            Estimate("held", "", 1.0, 1.0, float("nan"), determined=False),
            Estimate("shared", "m", 0.0, 2e-4, float("nan"), determined=False),
            Estimate("distance", "m", 9.8e-3, 10.3e-3, 4.7e-6, determined=True),
            Estimate("turn", "rad", 0.0, np.radians(1.25), np.radians(0.03), determined=True),
        ]
    ).rows
    assert rows[0] == (
        "distance", "9.8000", "10.3000", "+0.5000", "0.0047", "mm", "determined",
    )  # fmt: skip
    assert rows[1] == ("turn", "0.000", "1.250", "+1.250", "0.030", "deg", "determined")
    assert rows[2] == ("shared", "0.0000", "0.2000", "+0.2000", "-", "mm", "partly")
    assert rows[3] == ("held", "1.0000", "1.0000", "-", "-", "", "held")
