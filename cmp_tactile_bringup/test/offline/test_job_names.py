"""The names of results: what the user gave, without the suffix of a file.

Public reports, tried here (report: trial: result):
- equinor/xtgeo 592: several points in a name: only the known suffix is cut
- beetbox/beets 5774: a folder's name is cut at its point: kept whole
"""

import pytest

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.jobs import plan_jobs


def test_numbers_after_a_point_are_no_suffix(tmp_path):
    folders = [tmp_path / name for name in ("press_0.5N", "press_0.7N", "run.mcap.d")]
    for folder in folders:
        folder.mkdir()
    files = [tmp_path / name for name in ("a_0.5N.mcap", "b.v2.PNG", "c_0.1.mp4", "d_0.5N")]
    for file in files:
        file.touch()
    names = [job.name for job in plan_jobs([*folders, *files], tmp_path / "out")]
    assert names == [*(folder.name for folder in folders), "a_0.5N", "b.v2", "c_0.1", "d_0.5N"]


def test_the_same_name_names_both(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "press.mcap").touch()
    given = [tmp_path / name / "press.mcap" for name in ("a", "b")]
    with pytest.raises(OutputError, match=r"b/press.mcap: found the same name as .*a/press.mcap"):
        plan_jobs(given, tmp_path / "out")
