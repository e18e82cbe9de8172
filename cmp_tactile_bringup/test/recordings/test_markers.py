"""Positions of markers that any tracker has found go through force and slip."""

from dataclasses import replace

import numpy as np
import pytest
from command_output import one_line_error, printed, run

from cmp_tactile_driver.sources.markers import read_markers
from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import ForceFlag
from cmp_tactile_processing.sensor.description import load_sensor, write_sensor_description
from cmp_tactile_processing.sensor.parts import PatternSurface

ROWS, COLS, FRAMES = 7, 9, 6
FORCE_N = np.array([0.5, -0.3, -3.0])
# Of an image: the middle of the pattern, and px per m.
MIDDLE_PX, SCALE = (160.0, 120.0), 12e3


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """A sensor with few markers on a flat gel, and the file of its description."""
    packaged = load_sensor("tac3d_ad2")
    plane = PatternSurface()
    flat = replace(packaged.pattern, rows=ROWS, cols=COLS, pitch=0.002, surface=plane)
    path = tmp_path_factory.mktemp("sensor") / "gel.yaml"
    write_sensor_description(path, replace(packaged, name="gel", pattern=flat))
    return load_sensor(str(path))


@pytest.fixture(scope="module")
def position(sensor):
    """(frames, rows, cols, 3) m in the gel frame: two frames at rest, then a press."""
    model = ElasticModel(sensor)
    x, y = model.node_position[:, :2].T
    spread = np.exp(-((x - 0.001) ** 2 + y**2) / (2 * 0.002**2))
    moved = model.compliance @ (spread[:, None] / spread.sum() * FORCE_N).ravel()
    share = np.clip(np.arange(FRAMES) - 1, 0, 4) / 4
    noise = np.random.default_rng(3).normal(0, 1e-6, (FRAMES, ROWS, COLS, 3))
    pressed = share[:, None, None, None] * moved.reshape(ROWS, COLS, 3)
    return sensor.pattern.corners() + pressed + noise


def imported(path, sensor, *words):
    """The table of the import, and its exit code."""
    output = path.parent / "out"
    given = ("--sensor", sensor.file, "--output", output)
    code = run("import", "markers", path, *given, *words)
    table = output / f"{path.stem}_wrench.csv"
    rows = np.genfromtxt(table, delimiter=",", names=True) if not code else None
    return rows, code, output


@pytest.mark.parametrize("kind", ["m", "mm", "flattened", "elsewhere"])
def test_positions_in_space_give_the_force(tmp_path, sensor, position, kind):
    given = {
        "m": position,
        "mm": 1e3 * position,
        "flattened": position.reshape(FRAMES, -1, 3),
        "elsewhere": position + [0.01, 0.02, 0.03],
    }
    path = tmp_path / "finger.npy"
    np.save(path, given[kind])
    table, code, _ = imported(path, sensor, "--unit", "mm" if kind == "mm" else "m")
    assert code == 0
    found = [table[f"f{axis}_N"][-1] for axis in "xyz"]
    assert found == pytest.approx(FORCE_N, abs=0.05 * np.linalg.norm(FORCE_N))
    assert np.diff(table["time_s"]) == pytest.approx(1 / 30)


def test_pixels_give_the_force_along_the_plane_and_say_that_depth_is_not_measured(
    tmp_path, sensor, position
):
    path = tmp_path / "gel_image.npz"
    hidden = position.copy()
    hidden[3:, 0, 0] = np.nan
    pixels = SCALE * hidden[..., :2] + MIDDLE_PX
    np.savez(path, position=pixels, time_s=5.0 + np.arange(FRAMES) / 60)
    table, code, output = imported(path, sensor, "--unit", "px")
    assert code == 0
    assert table["stamp_ns"][0] == 5_000_000_000
    assert table["fx_N"][-1] == pytest.approx(FORCE_N[0], abs=0.1)
    assert table["fy_N"][-1] == pytest.approx(FORCE_N[1], abs=0.1)
    assert (table["flags"].astype(int) & ForceFlag.NO_DEPTH).all()
    # Without the flag nobody would know that z was not measured; its deviation is large, too.
    assert table["std_fz_N"][-1] > 3 * table["std_fx_N"][-1]
    recording = read_markers(path, sensor.pattern, "px")
    assert np.isnan(recording.displacement[..., 2]).all()
    assert np.isnan(recording.displacement[-1, 0, 0, 0])
    assert run("process", output / "gel_image.mcap", "--output", tmp_path, "--jobs", 1) == 0


def test_a_lost_marker_that_stays_at_nought_is_warned_of(tmp_path, sensor, position, capsys):
    path = tmp_path / "finger.npy"
    lost = position.copy()
    lost[3:, 0, 0] = 0.0
    np.save(path, lost)
    assert imported(path, sensor)[1] == 0
    assert "warning: finger: in 3 of 6 frames implausible" in printed(capsys)


COLUMNS = "frame,row,col,x,y"


def _table(position, separator=",", point=".", quote="", label=""):
    rows = [
        (str(k), str(i), str(j), *(repr(float(v)).replace(".", point) for v in position[k, i, j]))
        for k, i, j in np.ndindex(position.shape[:3])
    ]
    lines = (label + separator.join(f"{quote}{cell}{quote}" for cell in row) for row in rows)
    header = f"label,{COLUMNS}" if label else COLUMNS
    return "\n".join([header.replace(",", separator), *lines, "# end", ""])


@pytest.mark.parametrize(
    ("before", "signs"),
    [
        ("\ufeff", {}),
        ("", {"separator": ";", "point": ","}),
        ("sep=;\n", {"separator": ";", "point": ","}),
        ("", {"separator": "\t"}),
        ("", {"quote": '"'}),
        ("# frame rate 30\n\n", {}),
        # Tried: rows that begin with # were markers that were not seen (numpy/numpy 13088).
        ("", {"label": '"#1, ""first""",'}),
    ],
)
def test_tables_that_spreadsheets_write_are_read(tmp_path, sensor, position, before, signs):
    """Tried: refused with "Some errors were detected !", or quoted numbers were NaN.

    Reports: dotCMS/core 36508 and molgenis/molgenis 6492 (mark of UTF-8), actualbudget/actual 1769
    and oroinc/crm 96 (German and French tables).
    """
    plane = position[..., :2]
    text = before + _table(plane, **signs)
    (tmp_path / "table.csv").write_text(text, encoding="utf-8")
    of_table = read_markers(tmp_path / "table.csv", sensor.pattern)
    np.save(tmp_path / "array.npy", plane)
    of_array = read_markers(tmp_path / "array.npy", sensor.pattern)
    np.testing.assert_array_equal(of_table.displacement, of_array.displacement)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda text: text + "1,2,3,0.0,0.0\n", "frame 1, row 2, col 3 in 2 lines"),
        (lambda text: text.replace("\n0,0,1,", "\n0,0\n0,0,1,"), "2 columns in line 3, expected 5"),
        (lambda _: "", "no table .it is empty"),
        # Tried: a marker that was not seen.  As in numpy/numpy 24900.
        (
            lambda text: text.replace("\n0,0,1,", "\n0,0,1,4 mm;"),
            "x '4 mm;.*' in line 3, expected a n",
        ),
    ],
)
def test_what_is_wrong_in_a_table_is_named(tmp_path, sensor, position, change, found):
    path = tmp_path / "table.csv"
    path.write_text(change(_table(position[..., :2])))
    with pytest.raises(FrameSourceError, match=rf"table\.csv: found .*{found}"):
        read_markers(path, sensor.pattern)


def test_tables_of_trackers_are_read(tmp_path, sensor, position):
    """The columns of GelSight's tracker, in px, and those of others."""
    pixels = SCALE * position[..., :2] + MIDDLE_PX
    rows = [
        (frame, i, j, *pixels[0, i, j], *pixels[frame, i, j])
        for frame, i, j in np.ndindex(FRAMES, ROWS, COLS)
        # What is not seen has no row.
        if (frame, i, j) != (4, 2, 3)
    ]
    path = tmp_path / "table.csv"
    header = "frameno, row, col, Ox, Oy, Cx, Cy"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    of_table = read_markers(path, sensor.pattern, "px")
    np.save(tmp_path / "array.npy", pixels)
    of_array = read_markers(tmp_path / "array.npy", sensor.pattern, "px")
    assert np.isnan(of_table.displacement[4, 2, 3]).all()
    assert of_table.reference == pytest.approx(of_array.reference)
    both = np.isfinite(of_table.displacement)
    assert of_table.displacement[both] == pytest.approx(of_array.displacement[both])
    text = "time_s,frame,row,col,x,y,z\n" + "".join(
        f"{frame / 10},{frame},{i},{j},{','.join(map(str, position[frame, i, j]))}\n"
        for frame, i, j in np.ndindex(FRAMES, ROWS, COLS)
    )
    path.write_text(text, "utf-8")
    recording = read_markers(path, sensor.pattern)
    assert recording.displacement == pytest.approx(position - position[0])
    assert recording.stamp_ns[1] == 100_000_000


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda p: {"position": 1e3 * p},
            r"distances of .* m between neighbours .*, expected the pitch .*--unit",
        ),
        (lambda p: {"position": p[:, ::-1]}, r"distances of -.*y with the row"),
        (lambda p: {"position": p - p[0]}, r"distances of 0 to 0 m between neighbours"),
        (
            lambda p: {"position": p[:, :5]},
            r"shape \(6, 5, 9, 3\), expected .*\(frames, 7, 9, 2 or",
        ),
        (lambda p: {"position": p.swapaxes(1, 2)}, r"shape \(6, 9, 7, 3\), expected"),
        (lambda p: {"position": p[0]}, r"shape \(7, 9, 3\), expected"),
        (lambda p: {"position": p[:0]}, r"shape \(0, 7, 9, 3\), expected"),
        (lambda p: {"position": np.nan * p}, r"0 of 63 markers at rest, expected at least half"),
        (lambda p: {"position": p.astype(object)}, "no arrays .*objects"),
        (lambda p: {"position": p.astype(str)}, "position with values that are not numbers"),
        (lambda p: {"displacement": p}, "displacement, expected an array position"),
        (lambda p: {"position": p, "reference": p}, r"reference of shape \(6, 7, 9, 3\)"),
        (lambda p: {"position": p, "time_s": [0, 1, 2, 1.5, 3, 4]}, "1.5 after 2.0, frame 3"),
        (lambda p: {"position": p, "time_s": [0, 1]}, "time_s of 2 numbers.*expected 6 numbers"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, sensor, position, change, expected):
    path = tmp_path / "markers.npz"
    np.savez(path, **{name: np.asarray(value) for name, value in change(position).items()})
    with pytest.raises(FrameSourceError, match=rf"markers\.npz: found .*{expected}"):
        read_markers(path, sensor.pattern)


@pytest.fixture
def here(tmp_path, capsys):
    """An empty folder, and what is printed."""
    return tmp_path, capsys


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("text.npy", b"1 2 3", "no arrays"),
        ("cut.npz", b"PK\x03\x04 cut", "no arrays"),
        ("cut.csv", b"frame,row\n1,2,3\n", "no column col; columns: frame, row"),
        ("other.csv", b"a,b\n1,2\n", "no column frame; columns: a, b"),
        ("empty.csv", b"frame,row,col,x,y\n", "no row"),
        ("large.csv", b"frame,row,col,x,y\n0,9,0,1,1\n", "row 9, col 0, expected whole numbers"),
    ],
)
def test_a_file_that_is_none_is_one_line_and_nothing_is_written(
    here, sensor, name, content, expected
):
    tmp_path, capsys = here
    path = tmp_path / name
    path.write_bytes(content)
    _, code, output = imported(path, sensor)
    assert code == 1
    one_line_error(capsys, name, expected)
    assert not output.exists()
    _, code, _ = imported(tmp_path / "nowhere.npy", sensor)
    assert code == 1
    one_line_error(capsys, "nowhere.npy: found no such file")


def test_a_unit_that_is_none_is_refused(tmp_path, sensor, capsys):
    assert imported(tmp_path / "a.npy", sensor, "--unit", "inch")[1] == 2
    assert "expected one of m, mm, px" in printed(capsys)
