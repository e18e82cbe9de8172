"""Several sensors of one description: their frames begin with names of their own."""

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from tf2_msgs.msg import TFMessage

from cmp_tactile_processing.nodes.view_splitter import ViewSplitter


def test_two_splitters_of_one_description_share_no_tf_frame(ros):
    statics = ros.listen(TFMessage, "/tf_static", latched=True)
    for name in ("left_finger", "right_finger"):
        ros.start(ViewSplitter, name=name, sensor_name=name)
    ros.wait(lambda: len(statics) >= 2, "both trees")
    trees = {item.header.frame_id: set() for message in statics for item in message.transforms}
    for message in statics:
        for item in message.transforms:
            trees[item.header.frame_id].add(item.child_frame_id)
    assert set(trees) == {"left_finger_gel_frame", "right_finger_gel_frame"}
    for parent, children in trees.items():
        prefix = parent.removesuffix("gel_frame")
        assert children == {f"{prefix}{eye}_optical_frame" for eye in ("camera", "left", "right")}
