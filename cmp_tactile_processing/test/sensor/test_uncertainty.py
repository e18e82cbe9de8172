"""How well a description's values are known: read, written, refused, and joined with a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    sensor_description_of,
    sensor_description_text,
    write_sensor_description,
)
from cmp_tactile_processing.sensor.parts import USUAL_STD, Uncertainty
from cmp_tactile_processing.sensor.yaml_file import parse_yaml

TILT = "views.left.mirror: tilt towards x"
KNOWN = Uncertainty(
    {"camera.fx": 0.01, TILT: 0.02, "elastomer.young": 0.5},
    ((1.0, 0.25, 0.0), (0.25, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ("elastomer.young",),
)


def _read(text: str) -> SensorDescription:
    return sensor_description_of(parse_yaml(Path("sensor.yaml"), text))


def test_a_written_file_keeps_it(tmp_path: Path) -> None:
    sensor = replace(load_sensor("sample_rig"), uncertainty=KNOWN)
    write_sensor_description(tmp_path / "known.yaml", sensor)
    assert SensorDescription.load(tmp_path / "known.yaml").uncertainty == KNOWN


def test_a_file_without_it_has_the_usual_deviations() -> None:
    sensor = load_sensor("sample_rig")
    assert "uncertainty" not in sensor_description_text(sensor)
    assert sensor.uncertainty.of("elastomer.young") == USUAL_STD["elastomer.young"]


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("{std: {elastomer.yuong: 0.1}}", "did you mean 'elastomer.young'"),
        ("{std: {elastomer.young: -0.1}}", "uncertainty.std.elastomer.young"),
        ("{std: {elastomer.young: .nan}}", "uncertainty.std.elastomer.young"),
        ("{std: {camera.fx: 0.1}, correlation: [[1, 2]]}", "1 lists of 1 numbers"),
        ("{std: {camera.fx: 0.1, camera.cx: 1}, correlation: [[1, 2], [2, 1]]}", "eigenvalue"),
        ("{assumed: 3}", "uncertainty.assumed"),
    ],
)
def test_wrong_sections_are_refused(section: str, said: str) -> None:
    text = sensor_description_text(load_sensor("sample_rig")) + f"uncertainty: {section}\n"
    with pytest.raises(InputError) as caught:
        _read(text)
    assert said in str(caught.value)
    assert "sensor.yaml" in str(caught.value)


def test_a_fit_replaces_what_it_found_and_keeps_the_rest() -> None:
    names = ("gel: turn about x", "camera.fx", "camera.cx")
    covariance = np.array([[1.0, 0.0, 0.0], [0.0, 4e-6, 3e-3], [0.0, 3e-3, 9.0]])
    after = KNOWN.updated(names, covariance)
    assert after.std == {"camera.fx": 2e-3, "camera.cx": 3.0, TILT: 0.02, "elastomer.young": 0.5}
    asked = ("camera.cx", "pattern.pitch", "camera.fx")
    found = after.covariance(asked, np.array([1.0, 0.1, 1.0]))
    np.testing.assert_allclose(found, [[9, 0, 3e-3], [0, 0.01, 0], [3e-3, 0, 4e-6]])


@pytest.mark.parametrize(
    ("scale", "std", "doubted"),
    [(1, {}, False), (10, {}, True), (10, {"pattern.pitch": 0.01}, False)],
)
def test_lengths_that_may_be_in_cm_are_asked_for(
    scale: float, std: dict[str, float], doubted: bool
) -> None:
    sensor = load_sensor("sample_rig")
    pattern = replace(sensor.pattern, pitch=scale * sensor.pattern.pitch)
    large = replace(sensor, pattern=pattern, uncertainty=Uncertainty(std))
    assert ("cm" in large.size_doubt) == doubted
