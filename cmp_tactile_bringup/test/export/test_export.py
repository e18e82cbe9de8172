"""`cmp_tactile export` writes LeRobot datasets v3.0 of bags and datasets, or says why not."""

import errno
import json
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import made_bags
import made_results
import numpy as np
import pyarrow.parquet as pq
import pytest
import xarray as xr

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.export import lerobot
from cmp_tactile_processing import load
from cmp_tactile_processing.errors import InputError

COUNT = 6
POINTS, WRENCH = "observation.tactile.rig.points", "observation.tactile.rig.wrench"
IMAGE, STATE = "observation.images.rig", "observation.state"
JOINTS = ("shoulder", "elbow")
# Messages of the arm come so long after a frame; the next frame has them.
DELAY_NS = 10_000_000


def joint_rows(count: int, first: int = 0, step: int = 1) -> list[made_results.Row]:
    """Joint states of an arm, numbered by their frames: the first position is that number."""
    types = made_bags.STORE.types
    rows = []
    for number in range(first, count, step):
        stamp_ns = made_bags.stamps(count)[number] + DELAY_NS
        position = np.array([number, -number], np.float64)
        message = types["sensor_msgs/msg/JointState"](
            made_bags.header(stamp_ns), list(JOINTS), position, np.zeros(2), np.zeros(0)
        )
        rows.append(("/joint_states", stamp_ns, message))
    return rows


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return made_results.write(tmp_path / "bag", [*made_results.rows(COUNT), *joint_rows(COUNT)])


@pytest.fixture
def mapping(tmp_path: Path) -> Callable[[str], str]:
    """A file that maps observation.state, of its topic and field."""

    def write(text: str) -> str:
        path = tmp_path / "map.yaml"
        path.write_text(f"version: 1\nfeatures:\n  {STATE}: {text}\n")
        return str(path)

    return write


@pytest.fixture
def export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, Path]]:
    """Runs the command; returns its code, what it printed, and its folder."""

    def run(sources: Sequence[Path], *words: str) -> tuple[int, str, Path]:
        output = tmp_path / "out"
        named = ["--to", "lerobot", "--output", str(output), *words]
        code = main(["export", *map(str, sources), *named])
        said = capsys.readouterr()
        return code, said.out + said.err, output

    return run


def made_dataset(folder: Path) -> Path:
    """Two samples of three and two frames, in two shards."""
    folder.mkdir()
    (folder / "dataset.yaml").write_text("version: 1\n")
    markers = made_results.lattice(4, 5, made_results.PITCH_M)
    nodes = made_results.lattice(3, 4, made_results.NODE_PITCH_M)
    generator = np.random.default_rng(3)
    for sample, count in enumerate((3, 2)):
        moved = generator.normal(0, 1e-5, (count, *markers.shape))
        grid, node = ("frame", "row", "col", "component"), ("node_row", "node_col", "component")
        xr.Dataset(
            {
                "image": (("frame", "y", "x"), generator.integers(0, 255, (count, 6, 8), np.uint8)),
                "position": (grid, (markers + moved).astype(np.float32)),
                "displacement": (grid, moved.astype(np.float32)),
                "node_position": (("frame", *node), np.tile(nodes, (count, 1, 1, 1))),
                "node_force": (("frame", *node), generator.normal(size=(count, *nodes.shape))),
                "wrench": (("frame", "wrench_component"), generator.normal(size=(count, 6))),
            },
            {
                "sample": ("frame", np.full(count, sample, np.int32)),
                "stamp_ns": ("frame", np.arange(count) * made_bags.FRAME_NS),
            },
            {"rate_hz": 20.0, "sensor": "rig"},
        ).to_netcdf(folder / f"samples_{sample:06d}.nc", engine="h5netcdf")
    return folder


def read(folder: Path, name: str = "data") -> dict[str, list[Any]]:
    """The columns of the parquet files of `data` or `meta/episodes`."""
    files = sorted((folder / name).glob("chunk-*/file-*.parquet"))
    columns: dict[str, list[Any]] = pq.read_table(files).to_pydict()
    return columns


def info_of(folder: Path) -> dict[str, Any]:
    info: dict[str, Any] = json.loads((folder / "meta" / "info.json").read_text())
    return info


def test_a_bag_is_an_episode_with_the_values_of_its_topics(bag: Path, export, mapping):
    code, said, output = export([bag], "--map", mapping("{topic: joint_states, field: position}"))
    assert code == 0, said
    # The first frame is before the first joint state.
    assert f"1 episodes, {COUNT - 1} frames -> {output}" in said
    assert "left out 1 frames before the first message of a mapped topic" in said
    found, source = read(output), load(bag).isel(frame=slice(1, None))
    assert np.allclose(found[WRENCH], source["wrench"].values)
    points = np.array(found[POINTS])
    np.testing.assert_array_equal(points[..., :3], source["displacement"].values)
    # Shared among the markers, the forces of the nodes keep their sum.
    total = source["node_force"].values.sum(axis=(1, 2))
    np.testing.assert_allclose(points[..., 3:].sum(axis=(1, 2)), total, rtol=1e-5)
    for item, image in zip(found[IMAGE], made_bags.frames(COUNT)[1:], strict=True):
        shown = cv2.imdecode(np.frombuffer(item["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(shown, np.repeat(image[..., None], 3, axis=-1))
    # A frame has the latest state before it: that of the frame before.
    assert found[STATE] == [[n - 1, 1 - n] for n in range(1, COUNT)]
    assert found["tactile.rig.usable"] == [True, False, True, True, True]
    assert found["tactile.rig.stamp_ns"] == made_bags.stamps(COUNT)[1:]
    assert found["timestamp"] == pytest.approx([n / 20 for n in range(COUNT - 1)])


def test_the_meta_files_are_those_of_v3(bag: Path, export, mapping):
    code, said, output = export(
        [bag, bag],
        "--task",
        "hold a cup",
        "--map",
        mapping("{topic: /joint_states, field: position}"),
    )
    assert code == 0, said
    info = info_of(output)
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 20)
    assert (info["total_episodes"], info["total_frames"]) == (2, 2 * (COUNT - 1))
    assert info["splits"] == {"train": "0:2"}
    features = info["features"]
    assert features[POINTS]["shape"] == [4, 5, 6]
    assert features[STATE]["names"] == list(JOINTS)
    assert features[IMAGE]["dtype"] == "image"
    assert features[IMAGE]["names"] == ["height", "width", "channels"]
    clock = info["cmp_tactile"]["synchronisation"]
    assert clock["largest_error_s"][STATE] == pytest.approx((made_bags.FRAME_NS - DELAY_NS) / 1e9)
    assert clock["limit_s"] == pytest.approx(1.5 / 20)
    episodes = read(output, "meta/episodes")
    assert episodes["dataset_from_index"] == [0, COUNT - 1]
    assert episodes["dataset_to_index"] == [COUNT - 1, 2 * (COUNT - 1)]
    assert episodes["tasks"] == [["hold a cup"]] * 2
    assert episodes["data/file_index"] == episodes["meta/episodes/chunk_index"] == [0, 0]
    tasks = pq.read_table(output / "meta" / "tasks.parquet").to_pandas()
    assert list(tasks.index) == ["hold a cup"]
    stats = json.loads((output / "meta" / "stats.json").read_text())
    assert set(stats) == set(features)
    values = np.array(read(output)[WRENCH])
    np.testing.assert_allclose(stats[WRENCH]["mean"], values.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats[WRENCH]["std"], values.std(axis=0), rtol=1e-5, atol=1e-9)
    assert np.shape(stats[IMAGE]["mean"]) == (3, 1, 1)
    assert stats[IMAGE]["count"] == [2 * (COUNT - 1)]


def test_the_samples_of_a_dataset_are_episodes(tmp_path: Path, export):
    folder = made_dataset(tmp_path / "presses")
    code, said, output = export([folder])
    assert code == 0, said
    found, source = read(output), load(folder)
    assert found["episode_index"] == [0, 0, 0, 1, 1]
    assert found["frame_index"] == [0, 1, 2, 0, 1]
    assert all(found["tactile.rig.usable"])
    np.testing.assert_allclose(found[WRENCH], source["wrench"].values, rtol=1e-6)
    force = np.array(found[POINTS])[..., 3:].sum(axis=(1, 2))
    np.testing.assert_allclose(force, source["node_force"].values.sum(axis=(1, 2)), rtol=1e-5)


def test_lerobot_reads_it_back(bag: Path, export, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    code, said, output = export([bag, bag])
    assert code == 0, said
    found = datasets.LeRobotDataset("local/made", root=output)
    assert (len(found), found.num_episodes) == (2 * COUNT, 2)
    source = load(bag)
    for number in range(COUNT):
        frame = found[COUNT + number]
        displacement = source["displacement"][number].values
        np.testing.assert_array_equal(frame[POINTS][..., :3].numpy(), displacement)
        shown = frame[IMAGE][0].numpy() * 255
        np.testing.assert_allclose(shown, source["image"][number].values, atol=1e-3)


def test_a_video_shows_the_frames_of_each_episode(bag: Path, export):
    av = pytest.importorskip("av")
    code, said, output = export([bag, bag], "--images", "video")
    assert code == 0, said
    episodes = read(output, "meta/episodes")
    assert episodes[f"videos/{IMAGE}/from_timestamp"] == pytest.approx([0, COUNT / 20])
    assert episodes[f"videos/{IMAGE}/to_timestamp"] == pytest.approx([COUNT / 20, 2 * COUNT / 20])
    assert info_of(output)["features"][IMAGE]["dtype"] == "video"
    assert IMAGE not in read(output)
    with av.open(str(output / "videos" / IMAGE / "chunk-000" / "file-000.mp4")) as file:
        found = [(frame.time, frame.to_ndarray(format="gray")) for frame in file.decode(video=0)]
    assert [time for time, _ in found] == pytest.approx([n / 20 for n in range(2 * COUNT)])
    for number, (_, shown) in enumerate(found):
        image = made_bags.frames(COUNT)[number % COUNT]
        # Compressed noise is still far more like itself than like any other.
        assert np.corrcoef(shown.ravel(), image.ravel())[0, 1] > 0.9


def test_two_fingers_have_features_each(tmp_path: Path, export):
    rows = [
        *made_results.rows(COUNT, "left_finger"),
        *made_results.rows(COUNT, "right_finger", offset_ns=4_000_000),
    ]
    code, said, output = export([made_results.write(tmp_path / "bag", rows)])
    assert code == 0, said
    errors = info_of(output)["cmp_tactile"]["synchronisation"]["largest_error_s"]
    assert errors["observation.tactile.left_finger.points"] == 0.0
    assert errors["observation.tactile.right_finger.points"] == pytest.approx(0.004)


def test_a_lost_frame_repeats_its_neighbour_within_the_limit(tmp_path: Path, export):
    lost = made_bags.stamps(COUNT)[3]
    rows = [row for row in made_results.rows(COUNT) if row[1] != lost]
    code, said, output = export([made_results.write(tmp_path / "bag", rows)])
    assert code == 0, said
    expected = made_bags.stamps(COUNT)
    expected[3] = expected[2]
    assert read(output)["tactile.rig.stamp_ns"] == expected
    strict = ("--max-error", "0.01", "--output", str(tmp_path / "strict"))
    code, said, _ = export([tmp_path / "bag"], *strict)
    assert code == 1
    assert "points: found the nearest frame 0.05 s from a tick" in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{topic: /joint_state, field: position}", "did you mean '/joint_states'?"),
        ("{topic: /joint_states, field: positions}", "did you mean 'position'?"),
        ("{topic: /joint_states, field: name}", "expected a field with numbers of sensor_msgs"),
        ("{topic: /joint_states, feild: position}", "did you mean 'field'?"),
        ("{topic: /joint_states, field: position, names: [one]}", "expected 2 names"),
        ("{topic: /joint_states}\n  a/b: {topic: /b}", "found 'a/b', expected a name without /"),
    ],
)
def test_a_wrong_map_is_named_by_file_and_line(
    bag: Path, export, mapping, text: str, expected: str
):
    code, said, output = export([bag], "--map", mapping(text))
    assert code == 1
    assert re.fullmatch("error: .*", said.strip())
    assert re.search(r"map\.yaml:[23]: features", said)
    assert expected in said
    assert not output.exists()


def test_rates_that_do_not_fit_are_refused(tmp_path: Path, export, mapping):
    seldom = made_results.write(
        tmp_path / "seldom", [*made_results.rows(COUNT), *joint_rows(COUNT, step=4)]
    )
    joints = ("--map", mapping("{topic: /joint_states, field: position}"))
    code, said, output = export([seldom], *joints)
    assert code == 1
    assert "observation.state: found the latest message 0.19 s from a tick of the clock" in said
    assert "expected at most 0.075 s; --fps sets the clock, --max-error the limit" in said
    slow = [
        row for row in made_results.rows(COUNT) if made_bags.stamps(COUNT).index(row[1]) % 2 == 0
    ]
    halved = made_results.write(tmp_path / "halved", slow)
    code, said, output = export([seldom, halved])
    assert code == 1
    assert f"{halved}: found 10 Hz, expected 20 Hz as {seldom}; --fps gives all one" in said
    assert list(tmp_path.glob(".out*")) == []
    assert not output.exists()


def test_a_jump_of_the_clock_is_refused_and_images_alone_are_exported(tmp_path: Path, export):
    rows = [(topic, stamp, item) for topic, stamp, item in made_results.rows(2) if "image" in topic]
    later = [row for row in made_results.rows(2, offset_ns=10**17) if "image" in row[0]]
    bag = made_results.write(tmp_path / "jump", [*rows, *later])
    code, said, _ = export([bag], "--fps", "20")
    assert code == 1
    assert "observation.images.rig: found the nearest frame 5e+07 s from a tick" in said
    code, said, output = export([made_results.write(tmp_path / "camera", rows)])
    assert code == 0, said
    assert IMAGE in read(output)
    assert "tactile.rig.usable" not in read(output)


def test_results_have_images_and_topics_of_their_recording(tmp_path: Path, export, mapping):
    rows = [row for row in made_results.rows(COUNT, "finger") if "image" in row[0]]
    # One image was lost.
    camera = made_results.write(
        tmp_path / "bags" / "grasp", [*rows[:2], *rows[3:], *joint_rows(COUNT)]
    )
    result = made_results.write(tmp_path / "grasp", made_results.rows(COUNT, images=False))
    found = load(result, images=camera)
    assert found["image"].chunks
    assert found["has_image"].values.tolist() == [1, 1, 0, 1, 1, 1]
    shown = np.array(made_bags.frames(COUNT))[[1, 3]]
    np.testing.assert_array_equal(found["image"][[1, 3]].values, shown)
    words = ["--map", mapping("{topic: joint_states, field: position}")]
    code, said, output = export([result], "--recordings", str(camera.parent), *words)
    assert code == 0, said
    assert {IMAGE, STATE, WRENCH} <= read(output).keys()
    with pytest.raises(InputError, match="found no image at any stamp of the results"):
        load(result, images=result)
    shutil.rmtree(output)
    code, said, _ = export([result], "--recordings", str(tmp_path / "bags" / "absent"))
    assert code == 1
    assert "found no bag grasp, expected the recording of" in said


def test_sensors_that_differ_are_refused(bag: Path, tmp_path: Path, export):
    other = made_results.write(tmp_path / "other", made_results.rows(COUNT, "finger"))
    code, said, _ = export([bag, other])
    assert code == 1
    assert f"{other}: found no {POINTS}, expected {POINTS} of 4x5x6 as {bag}; different" in said


def test_an_output_that_exists_and_a_full_disk_leave_nothing_new(
    bag: Path, export, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr(lerobot.LeRobotWriter, "close", full)
        code, said, output = export([bag])
    assert code == 1
    assert f"{output.parent}: its disk: No space left on device; nothing was written" in said
    assert list(tmp_path.iterdir()) == [bag]
    output.mkdir()
    code, said, _ = export([bag])
    assert code == 1
    assert f"{output}: exists already, expected a new folder" in said


def test_video_without_its_library_says_what_to_install(
    bag: Path, export, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "av", None)
    code, said, _ = export([bag], "--images", "video")
    assert code == 1
    assert "expected the package: pip install av" in said
