"""What `cmp_tactile_processing.load` gives of a bag."""

from pathlib import Path

import made_bags
import made_results
import numpy as np
import pytest

from cmp_tactile_processing import load
from cmp_tactile_processing.errors import FrameSourceError

COUNT = 5


@pytest.mark.parametrize("prefix", ["", "truth/"])
def test_the_topics_of_a_sensor_become_arrays_over_its_frames(tmp_path: Path, prefix: str):
    bag = made_results.write(tmp_path / "bag", made_results.rows(COUNT, prefix=prefix))
    found = load(bag)
    assert found.attrs["sensor"] == "rig"
    assert found["stamp_ns"].values.tolist() == made_bags.stamps(COUNT)
    assert found["image"].chunks
    np.testing.assert_array_equal(found["image"].values, made_bags.frames(COUNT))
    np.testing.assert_array_equal(found["image"][3, 2:4].values, made_bags.frames(COUNT)[3][2:4])
    for number in range(COUNT):
        frame, field = found.isel(frame=number), made_results.force(number)
        moved = made_results.surface(number).displacement
        np.testing.assert_array_equal(frame["displacement"], moved.astype(np.float32))
        np.testing.assert_allclose(frame["wrench"], field.wrench, rtol=1e-6)
        force = frame["node_force"].values.reshape(-1, 3)
        np.testing.assert_array_equal(force, field.force.astype(np.float32))
    assert found["node_position"].dims == ("node_row", "node_col", "component")
    assert found["usable"].values.tolist() == [1, 1, 0, 1, 1]


def test_what_a_frame_lacks_is_nan_and_a_lost_image_is_said(tmp_path: Path):
    lost = made_bags.stamps(COUNT)[1]
    rows = [
        row for row in made_results.rows(COUNT) if row[1] != lost or row[0] == "/rig/force_field"
    ]
    found = load(made_results.write(tmp_path / "bag", rows))
    assert np.isnan(found["displacement"][1]).all()
    assert found["has_image"].values.tolist() == [1, 0, 1, 1, 1]
    assert not found["image"][1].values.any()


def test_several_sensors_are_named_and_one_is_chosen(tmp_path: Path):
    rows = [*made_results.rows(COUNT, "left_finger"), *made_results.rows(COUNT, "right_finger")]
    bag = made_results.write(tmp_path / "bag", rows)
    with pytest.raises(FrameSourceError, match="found 2 sensors, expected one of left_finger, r"):
        load(bag)
    assert load(bag, "right_finger").attrs["sensor"] == "right_finger"
    with pytest.raises(FrameSourceError, match=r"'right_fingr'.* did you mean 'right_finger'\?"):
        load(bag, "right_fingr")


def test_a_bag_of_a_camera_alone_has_its_images(frame_bag: Path, frames: list[np.ndarray]):
    found = load(frame_bag)
    assert list(found.data_vars) == ["image"]
    np.testing.assert_array_equal(found["image"].values, frames)


def test_a_bag_without_our_topics_is_refused(tmp_path: Path):
    wrench = made_bags.wrench(made_bags.FIRST_STAMP_NS, range(6))
    bag = made_bags.write(tmp_path / "bag", {"/ft": [wrench]})
    with pytest.raises(FrameSourceError, match="found /ft, expected topics such as /my_sensor/for"):
        load(bag)
