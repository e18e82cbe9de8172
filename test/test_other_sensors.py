"""docs/other_sensors.md: its files, commands and example with the markers of other trackers."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_output import output_of
from documents import blocks, shell_lines

from cmp_tactile_bringup.command import main

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

from sensor_msgs.msg import PointCloud2, PointField

from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.measured import MarkerFault, Status
from cmp_tactile_processing.ros.messages.reading import surface_from_msg
from cmp_tactile_processing.sensor.description import load_sensor

DOCS = Path(__file__).resolve().parent.parent / "docs"
TEXT = (DOCS / "other_sensors.md").read_text("utf-8")
# Bytes after each row.
ROW_END = 12
MOVED_M = np.array([1e-4, 0.0, -2e-4])


def cloud_of(points, kind, names="xyz"):
    """An organised cloud with padding after each point and each row."""
    rows, cols = points.shape[:2]
    code = {"f4": PointField.FLOAT32, "f8": PointField.FLOAT64}[kind]
    size = int(kind[1])
    layout = {"names": list(names), "formats": [kind] * len(names), "itemsize": 32}
    layout = np.dtype(layout | {"offsets": [4 + size * k for k in range(len(names))]})
    packed = np.zeros((rows, cols), layout)
    for axis, name in enumerate(names):
        packed[name] = points[..., axis]
    data = np.zeros((rows, cols * layout.itemsize + ROW_END), np.uint8)
    data[:, :-ROW_END] = packed.view(np.uint8).reshape(rows, -1)
    fields = [
        PointField(name=name, offset=layout.fields[name][1], datatype=code, count=1)
        for name in names
    ]
    return PointCloud2(
        height=rows,
        width=cols,
        fields=fields,
        point_step=layout.itemsize,
        row_step=data.shape[1],
        data=data.tobytes(),
        is_dense=False,
    )


@pytest.mark.parametrize(("kind", "names"), [("f4", "xyz"), ("f8", "xy")])
def test_clouds_become_surfaces(ros, tmp_path, kind, names):
    sensor = load_sensor("tac3d_ad2")
    name = f"other_{kind}"
    path = tmp_path / "other.yaml"
    text = Path(sensor.file).read_text("utf-8").replace("name: tac3d_ad2", f"name: {name}")
    path.write_text(text.replace("rows: 20", "rows: 12"), "utf-8")
    rest = load_sensor(str(path)).pattern.corners()
    moved = rest + MOVED_M
    moved[2, 3] = np.nan
    found = ros.listen(SurfaceMsg, f"/{name}/surface")
    words = [
        sys.executable,
        str(DOCS / "examples" / "other_sensor.py"),
        str(path),
        f"{ros.namespace}/points",
    ]
    example = subprocess.Popen(words)
    try:
        publisher = ros.publisher(PointCloud2, f"{ros.namespace}/points")
        publisher.publish(cloud_of(rest.swapaxes(0, 1), kind, names))  # another grid: warned of
        publisher.publish(cloud_of(rest, kind, names))
        ros.run(1.0)
        # Again and again: the example may not know its listener yet.
        for _ in range(30):
            publisher.publish(cloud_of(moved, kind, names))
            ros.run(0.2)
            if len(found) > 1:
                break
        example.send_signal(signal.SIGINT)
        assert example.wait(timeout=60) == 0
    finally:
        example.kill()
    surface = surface_from_msg(found[-1], load_sensor(str(path)).pattern.shape)
    hidden = np.zeros(rest.shape[:2], bool)
    hidden[2, 3] = True
    assert (surface.status == np.where(hidden, Status.MISSING, Status.MEASURED)).all()
    assert surface.fault[2, 3] == MarkerFault.NOT_SEEN
    measured = len(names)
    displacement = surface.displacement[~hidden]
    assert displacement[:, :measured] == pytest.approx(
        np.tile(MOVED_M[:measured], (len(displacement), 1)), abs=1e-8
    )
    assert np.isnan(displacement[:, measured:]).all()


def test_documented_files_are_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (description,) = blocks(TEXT, "yaml")
    Path("dotted_gel.yaml").write_text(description, "utf-8")
    rest = load_sensor("dotted_gel.yaml").pattern.corners()
    np.save("finger.npy", 1e3 * np.stack([rest, rest - [0.0, 0.0, 1e-5]]))
    rows = [(0, *at, *2e4 * rest[at][:2], *2e4 * rest[at][:2]) for at in np.ndindex(7, 9)]
    header = "frameno, row, col, Ox, Oy, Cx, Cy"
    np.savetxt("tracking_data.csv", rows, delimiter=",", header=header, comments="")
    commands = [line.split() for line in shell_lines(TEXT) if "import markers" in line]
    assert len(commands) == 2
    for words in commands:
        assert main(words[1:]) == 0
        name = Path(words[3]).stem
        assert {path.suffix for path in Path("results").glob(f"{name}*")} == {
            ".mcap",
            ".csv",
            ".yaml",
        }


def test_documented_python_gives_a_press():
    (code,) = blocks(TEXT, "python")
    printed = output_of("-c", code)
    fx, fy, fz = (float(word) for word in printed.split("]")[0].strip("[").split())
    assert -10 < fz < -0.1
    assert abs(fx) + abs(fy) < 0.01 * abs(fz)
