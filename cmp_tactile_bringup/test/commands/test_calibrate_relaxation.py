"""`cmp_tactile calibrate relaxation`: finds how a gel creeps under a weight."""

from dataclasses import replace
from functools import partial

import made_bags
import numpy as np
import pytest
from command_output import printed, run
from rosbags.rosbag2 import Reader

from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_processing.ros.messages.making import SURFACE
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    write_sensor_description,
)
from cmp_tactile_processing.sensor.parts import MaterialRecord
from cmp_tactile_simulation.recording.truth import read_truth

SHARE, TIME_S = 0.25, 0.3
FRAME_NS = 33_333_333
REST_FRAMES, HELD_FRAMES = 5, 60
# The gel of the recording is stiffer than described by this factor.
STIFFER = 1.2
NOISE_M = 2e-6


calibrate = partial(run, "calibrate", "relaxation")


def creep(time_s):
    """Displacement under a weight over that at the first moment: one Prony term, closed form."""
    return 1 + SHARE / (1 - SHARE) * (1 - np.exp(-(1 - SHARE) * time_s / TIME_S))


@pytest.fixture(scope="module")
def creep_bag(weigh_bag, tmp_path_factory):
    """Surfaces of a gel that creeps under 500 g: the simulator's own shape, growing."""
    store, random = simulation_typestore(), np.random.default_rng(4)
    folder = tmp_path_factory.mktemp("creep") / "bag"
    with Reader(weigh_bag) as reader:
        (source,) = (c for c in reader.connections if c.topic.endswith("truth/surface"))
        surfaces = [store.deserialize_cdr(data, SURFACE) for *_, data in reader.messages([source])]
    pressed = surfaces[int(np.argmin(read_truth(weigh_bag).wrench[:, 2]))]
    shape = np.array(pressed.displacement) / STIFFER
    rows = []
    for frame in range(REST_FRAMES + HELD_FRAMES):
        # The weight comes down between two frames.
        held = frame - REST_FRAMES + 0.5
        size = creep(held * FRAME_NS * 1e-9) if held > 0 else 0.0
        moved = shape * size + random.normal(0, NOISE_M, shape.shape)
        header = made_bags.header(FRAME_NS * frame)
        surface = replace(pressed, header=header, displacement=moved.astype(np.float32))
        rows.append(("/sample_rig/surface", FRAME_NS * frame, surface))
    return made_bags.write_rows(folder, rows, store=store)


def test_a_weight_that_is_held_shows_share_time_and_stiffness(creep_bag, tmp_path, capsys):
    """What weights have shown of the stiffness stays, with the doubt of the new one in it."""
    old, new = tmp_path / "old.yaml", tmp_path / "new.yaml"
    sensor = load_sensor("sample_rig")
    record = MaterialRecord("weights", "2026-07-01T12:00:00Z", 4, 1e-4, 0.02, young_std=1e-4)
    gel = replace(sensor.elastomer, calibration=record)
    write_sensor_description(old, replace(sensor, elastomer=gel))
    given = (creep_bag, "--mass", "0.5", "--sensor", old, "--output", new)
    assert calibrate(*given) == 0, capsys.readouterr()
    assert f"Written: {new}" in capsys.readouterr().out
    found = SensorDescription.load(new).elastomer
    assert found.relaxation.share == pytest.approx(SHARE, abs=0.01)
    assert found.relaxation.time == pytest.approx(TIME_S, rel=0.05)
    assert found.young == pytest.approx(STIFFER * 5e5, rel=0.02)
    assert found.shading_layer.young == pytest.approx(found.young)
    doubt = np.sqrt(found.calibration.normal_std**2 - record.normal_std**2)
    assert 1e-5 < doubt < 0.02
    assert found.calibration.young_std == pytest.approx(found.calibration.normal_std)
    assert found.calibration.tangential_std == pytest.approx(np.hypot(0.02, doubt))
    assert found.calibration.samples == record.samples
    assert (tmp_path / "new_calibration" / "relaxation.png").stat().st_size > 10_000
    assert calibrate(*given) == 1
    assert "exists already; --overwrite replaces it" in printed(capsys)


def test_without_the_load_the_stiffness_stays(creep_bag, tmp_path, capsys):
    new = tmp_path / "new.yaml"
    given = (creep_bag, "--sensor", "sample_rig", "--output", new)
    assert calibrate(*given) == 0, capsys.readouterr()
    found = SensorDescription.load(new).elastomer
    assert found.relaxation.share == pytest.approx(SHARE, abs=0.02)
    assert found.young == 5e5
