"""Recordings of Tac3D sensors are read into the gel frame, and their forces found again."""

from dataclasses import replace

import numpy as np
import pytest
from command_output import printed, run
from mcap.reader import make_reader

from cmp_tactile_bringup.offline.imported import agreement
from cmp_tactile_driver.sources.tac3d import read_tac3d, tac3d_folders
from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import PatternSurface

SERIAL = "AD2-0001L"
# The sensor's own frame begins below the gel.
ORIGIN_MM = np.array([-0.4, 0.3, 11.4])
PITCH_M, RADIUS_M, FORCE_N = 0.00099, 0.032, np.array([0.6, -0.4, -4.0])


@pytest.fixture(scope="module")
def sensor():
    """The packaged description with the pattern of one sensor."""
    packaged = load_sensor("tac3d_ad2")
    surface = PatternSurface("sphere_cap", RADIUS_M)
    return replace(packaged, pattern=replace(packaged.pattern, pitch=PITCH_M, surface=surface))


@pytest.fixture(scope="module")
def arrays(sensor):
    """What the vendor's recorder keeps of a press in 12 frames, the first three at rest."""
    model = ElasticModel(sensor)
    x, y = model.node_position[:, :2].T
    spread = np.exp(-((x - 0.001) ** 2 + y**2) / (2 * 0.002**2))
    spread /= spread.sum()
    moved = (model.compliance @ (spread[:, None] * FORCE_N).ravel()).reshape(20, 20, 3)
    rest = 1e3 * sensor.pattern.corners() + ORIGIN_MM
    share = np.clip(np.arange(12) - 2, 0, 6) / 6
    noise = np.random.default_rng(3).normal(0, [1e-3, 1e-3, 3e-3], (12, 20, 20, 3))
    displacement = 1e3 * share[:, None, None, None] * moved + noise
    force = share[:, None] * FORCE_N
    moment = np.cross(ORIGIN_MM + [1.0, 0.0, 0.0], force)
    turned = displacement[:, ::-1, ::-1], (rest + displacement)[:, ::-1, ::-1]
    return {
        "3D_Displacements": turned[0].reshape(12, 400, 3),
        "3D_Positions": turned[1].reshape(12, 400, 3),
        "3D_Forces": np.zeros((12, 400, 3)),
        "3D_ResultantForce": force[:, None],
        "3D_ResultantMoment": moment[:, None],
        "index": np.array([7, 8, 9, 10, 13, 14, 15, 16, 17, 18, 19, 20]),
        "sendTimestamp": 68.0 + np.arange(12) / 30,
    }


@pytest.fixture
def folder(arrays, tmp_path):
    """The recording as files."""
    path = tmp_path / "press" / SERIAL
    path.mkdir(parents=True)
    for name, values in arrays.items():
        np.save(path / f"{name}.npy", values)
    return path


def test_a_recording_is_turned_into_the_gel_frame(folder, sensor, arrays):
    recording = read_tac3d(folder)
    assert recording.name == SERIAL
    assert recording.lost == 2
    assert recording.stamp_ns[:2].tolist() == [68_000_000_000, 68_033_333_333]
    # To the noise of a marker, and what the middle of a cap lies above that of its four corners.
    assert np.abs(recording.reference - sensor.pattern.corners())[..., :2].max() < 3e-6
    assert np.abs(recording.reference - sensor.pattern.corners())[..., 2].max() < 2e-5
    first = arrays["3D_Displacements"][5, 0]
    assert recording.displacement[5, -1, -1] == pytest.approx(1e-3 * first)
    # About the gel's origin: 1 mm along x from where the force acts.
    assert recording.wrench[-1, 3:] == pytest.approx(np.cross([1e-3, 0, 0], FORCE_N), abs=2e-4)
    described = recording.described(sensor)
    assert described.pattern.pitch == pytest.approx(PITCH_M, rel=1e-3)
    assert described.pattern.surface.radius == pytest.approx(RADIUS_M, rel=0.02)


def test_a_flat_sensor_is_described_as_flat(folder, sensor, arrays):
    flat = arrays["3D_Positions"].copy()
    flat[..., 2] = 11.4 + arrays["3D_Displacements"][..., 2]
    np.save(folder / "3D_Positions.npy", flat)
    assert read_tac3d(folder).described(sensor).pattern.surface == PatternSurface()


def test_the_force_is_found_again_and_lies_beside_the_sensors_own(folder, tmp_path, capsys):
    output = tmp_path / "out"
    assert run("import", "tac3d", folder.parent, "--output", output) == 0
    assert sorted(path.name for path in output.iterdir()) == [
        f"{SERIAL}.mcap",
        f"{SERIAL}.yaml",
        f"{SERIAL}_wrench.csv",
    ]
    table = np.genfromtxt(output / f"{SERIAL}_wrench.csv", delimiter=",", names=True)
    found = np.array([table[f"f{axis}_N"][-1] for axis in "xyz"])
    # The load is not made of the mesh's own hats; noise takes the rest.
    assert found == pytest.approx(FORCE_N, abs=0.03 * np.linalg.norm(FORCE_N))
    with (output / f"{SERIAL}.mcap").open("rb") as file:
        counts = make_reader(file).get_summary()
        topics = {channel.topic for channel in counts.channels.values()}
    space = f"/{load_sensor(str(output / f'{SERIAL}.yaml')).ros_name}"
    assert topics >= {f"{space}/{name}" for name in ("surface", "force_field", "tac3d/wrench")}
    assert "correlation" in capsys.readouterr().out
    # What was made before is kept, unless asked otherwise.
    again = ("import", "tac3d", folder, "--output", output)
    assert run(*again) == 1
    assert "--overwrite replaces it" in capsys.readouterr().err
    assert run(*again, "--overwrite") == 0


@pytest.fixture
def imported(folder, arrays, tmp_path):
    """The bag of an imported press, by a sensor with a force half as large again."""
    np.save(folder / "3D_ResultantForce.npy", 1.5 * arrays["3D_ResultantForce"])
    assert run("import", "tac3d", folder, "--output", tmp_path / "imported") == 0
    return tmp_path / "imported" / f"{SERIAL}.mcap"


def test_the_sensors_own_force_calibrates_the_gel(imported, tmp_path):
    topic, new = "/AD2_0001L/tac3d/wrench", tmp_path / "new.yaml"
    words = ["calibrate", "force", str(imported), "--wrench-topic", topic, "--output", str(new)]
    assert run(*words, "--every-frame", "--poisson-std", "0") == 0
    found = load_sensor(str(new)).elastomer
    assert found.young == pytest.approx(1.5 * load_sensor("tac3d_ad2").elastomer.young, rel=0.03)
    assert found.calibration.source == f"{imported}: {topic}"
    assert 0 < found.calibration.young_std < 0.1


def test_processing_goes_on_from_the_surfaces(imported, tmp_path, capsys):
    words = ["process", str(imported), "--output", str(tmp_path), "--jobs", "1"]
    assert run(*words, "--arrays") == 0
    assert "recorded surfaces" in printed(capsys)
    tables = [
        np.genfromtxt(path / f"{SERIAL}_wrench.csv", delimiter=",", names=True)
        for path in (imported.parent, tmp_path)
    ]
    for name in ("stamp_ns", "fx_N", "fy_N", "fz_N", "slip_state"):
        # Messages hold float32.
        assert tables[1][name] == pytest.approx(tables[0][name], rel=1e-4, abs=1e-4), name
    with np.load(tmp_path / f"{SERIAL}.npz") as arrays:
        assert arrays["displacement"].shape == (12, 20, 20, 3)
    # Another reference is taken from the surfaces themselves.
    assert run(*words, "--reference", "first-3", "--overwrite") == 0
    assert "mean of 3 frames" in printed(capsys)


@pytest.mark.parametrize(
    ("other", "complaint"), [("rows_10", "found 20, 20, 0"), ("prototype", "no frame can be used")]
)
def test_surfaces_of_another_grid_are_refused(imported, tmp_path, capsys, other, complaint):
    if other == "rows_10":
        other = str(tmp_path / "rows_10.yaml")
        text = imported.with_suffix(".yaml").read_text("utf-8").replace("rows: 20", "rows: 10")
        (tmp_path / "rows_10.yaml").write_text(text, "utf-8")
    words = ["process", str(imported), "--output", str(tmp_path / "out"), "--sensor", other]
    assert run(*words, "--jobs", "1") == 1
    said = printed(capsys)
    assert said.count("error: ") == 1
    assert complaint in said
    assert not list((tmp_path / "out").glob("*.mcap"))


def test_markers_that_are_no_numbers_are_missing_and_what_is_not_recorded_is_unknown(
    folder, arrays
):
    moved = arrays["3D_Displacements"].copy()
    moved[4, 10] = np.nan
    np.save(folder / "3D_Displacements.npy", moved)
    for name in ("3D_Forces", "3D_ResultantForce", "3D_ResultantMoment", "index"):
        (folder / f"{name}.npy").unlink()
    recording = read_tac3d(folder)
    assert np.isnan(recording.displacement[4]).any(axis=-1).sum() == 1
    assert np.isnan(recording.wrench).all()
    assert recording.lost == 0
    assert agreement(np.ones((12, 3)), recording.wrench[:, :3]) is None


def test_a_marker_that_is_never_seen_is_missing_and_the_others_serve(folder, arrays, tmp_path):
    for name in ("3D_Positions", "3D_Displacements"):
        values = arrays[name].copy()
        values[:, [25, 209]] = np.nan
        np.save(folder / f"{name}.npy", values)
    assert run("import", "tac3d", folder, "--output", tmp_path) == 0
    table = np.genfromtxt(tmp_path / f"{SERIAL}_wrench.csv", delimiter=",", names=True)
    assert table["fz_N"][-1] == pytest.approx(FORCE_N[2], rel=0.05)
    found = load_sensor(str(tmp_path / f"{SERIAL}.yaml")).pattern
    assert found.pitch == pytest.approx(PITCH_M, rel=1e-3)
    assert found.surface.radius == pytest.approx(RADIUS_M, rel=0.02)


def test_sensors_with_fewer_markers_are_described(folder, arrays, sensor):
    """As those of the kinds DS1 and B1, of 16 x 16."""
    for name in ("3D_Positions", "3D_Displacements", "3D_Forces"):
        part = arrays[name].reshape(12, 20, 20, 3)[:, :16, :16]
        np.save(folder / f"{name}.npy", part.reshape(12, 256, 3))
    recording = read_tac3d(folder)
    pattern = recording.described(sensor).pattern
    assert (pattern.rows, pattern.cols) == (16, 16)
    assert np.abs(recording.reference - pattern.corners())[..., :2].max() < 3e-6


def test_an_index_that_begins_again_counts_nothing_as_lost(folder):
    np.save(folder / "index.npy", np.array([100, 101, 103, 0, 1, 2, 3, 4, 5, 6, 7, 8]))
    assert read_tac3d(folder).lost == 1


def test_frames_out_of_order_and_repeated_ones_are_put_right(folder, arrays):
    order = [0, 2, 1, *range(3, 12), 11]
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values[order])
    recording = read_tac3d(folder)
    assert len(recording.stamp_ns) == 12
    assert (np.diff(recording.stamp_ns) > 0).all()


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("3D_Positions", lambda a: a[0], r"3D_Positions.*shape \(400, 3\).*\(frames, markers, 3\)"),
        ("3D_Positions", lambda a: a[:, :399], r"3D_Displacements.*shape.*3D_Positions"),
        ("3D_Positions", lambda a: np.nan * a, r"3D_Positions.*0 of 400 markers with numbers"),
        ("3D_Positions", lambda a: 1e-3 * a, r"3D_Positions.*neighbours.*0\.1 to 20 mm"),
        ("3D_Displacements", lambda a: 1e-3 * a, r"change by .* mm, expected the markers at rest"),
        ("3D_Displacements", lambda a: a[:-1], r"3D_Displacements.*12 frames of 1200 numbers"),
        ("sendTimestamp", lambda a: -a, r"sendTimestamp.*negative"),
        ("sendTimestamp", lambda a: a.astype(object), r"sendTimestamp.*without an array"),
        ("3D_Forces", lambda a: a[..., :2], r"3D_Forces.*shape \(12, 400, 2\)"),
    ],
)
def test_what_cannot_be_used_is_named(folder, arrays, name, change, expected):
    np.save(folder / f"{name}.npy", change(arrays[name]), allow_pickle=True)
    with pytest.raises(FrameSourceError, match=expected):
        read_tac3d(folder)


def test_files_that_are_cut_or_absent_are_named_and_nothing_is_written(folder, tmp_path, capsys):
    path = folder / "3D_Positions.npy"
    path.write_bytes(path.read_bytes()[:5000])
    output = tmp_path / "out"
    assert run("import", "tac3d", folder, "--output", output) == 1
    assert "3D_Positions.npy: found a file without an array" in capsys.readouterr().err
    assert not output.exists()
    path.unlink()
    with pytest.raises(FrameSourceError, match=r"expected 3D_Positions\.npy, or folders"):
        tac3d_folders(folder)
