"""The comparison of everything that is computed notices whatever has changed."""

import golden
import numpy as np
import pytest

KEPT = {
    "still/rest/corners": np.array([[1.0, np.nan], [3.0, -4.0]]),
    "still/rest/status": np.array([1, 2], np.uint8),
    "process/bag_wrench.csv/time": np.array(["0.1", "0.2"]),
}


def changed(name, index, value):
    arrays = {key: array.copy() for key, array in KEPT.items()}
    arrays[name][index] = value
    return arrays


def check(tmp_path, monkeypatch, found, *options):
    file = tmp_path / "golden.npz"
    for arrays, action in ((KEPT, "--write"), (found, "--check")):
        monkeypatch.setattr(golden, "collect", lambda _data, arrays=arrays: arrays)
        code = golden.main([action, str(file), *options])
    return code


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("still/rest/corners", (1, 0), np.nextafter(3.0, 4.0)), "1 of 4 elements, by 4.44e-16"),
        (("still/rest/corners", (0, 1), 5.0), "1 of 4 elements, by 0 at most"),
        (("still/rest/corners", (1, 1), np.nan), "1 of 4 elements"),
        (("still/rest/status", 1, 0), "1 of 2 elements, by 2 at most"),
        (("process/bag_wrench.csv/time", 1, "0.3"), "1 of 2 elements, 0.2 became 0.3"),
    ],
)
def test_a_changed_element_is_reported(tmp_path, monkeypatch, capsys, change, line):
    assert check(tmp_path, monkeypatch, changed(*change)) == 1
    assert f"{change[0]}: {line}" in capsys.readouterr().out


def test_equal_arrays_pass_and_others_are_reported(tmp_path, monkeypatch, capsys):
    assert check(tmp_path, monkeypatch, changed("still/rest/status", 0, 1)) == 0
    assert "all arrays are equal" in capsys.readouterr().out
    corners = KEPT["still/rest/corners"].astype(np.float32)
    found = {**KEPT, "still/rest/more": np.zeros(1), "still/rest/corners": corners}
    del found["still/rest/status"]
    assert check(tmp_path, monkeypatch, found) == 1
    output = capsys.readouterr().out
    assert "still/rest/more: new" in output
    assert "still/rest/status: missing" in output
    assert "still/rest/corners: float64 (2, 2) became float32 (2, 2)" in output
