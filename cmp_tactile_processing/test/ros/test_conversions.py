"""Messages carry what the core gave, and nothing wrong gets into the core from a message."""

from __future__ import annotations

from array import array
from dataclasses import is_dataclass, replace

import numpy as np
import pytest
from made_forces import made_contact

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import (
    Contact,
    ForceField,
    ForceFlag,
    Grid,
    GridFault,
    GridShape,
    ReferenceFault,
    SlipEstimate,
    SlipState,
    Status,
    Surface,
    Systematics,
)
from cmp_tactile_processing.ros.messages.conversions import (
    force_field_to_msg,
    grid_to_msg,
    organised_cloud,
    surface_to_msg,
)
from cmp_tactile_processing.ros.messages.reading import (
    force_field_from_msg,
    grid_from_msg,
    surface_from_msg,
)

pytestmark = pytest.mark.ros

# Not square, so that exchanged rows and columns show.
SHAPE = GridShape(rows=5, cols=7, points_per_segment=3)
# What travels as float64; all other numbers are float32 on the wire.
IN_FULL = {
    ForceField: {
        "wrench",
        "wrench_covariance",
        "systematic_covariance",
        "centre_of_pressure",
        "reference_point",
    },
    Contact: {"wrench", "covariance", "centre_of_pressure"},
}
HEADER = Header(stamp=Time(sec=1_700_000_000, nanosec=123_456_789), frame_id="rig_gel_frame")


def _points(rng: np.random.Generator, status: np.ndarray, size: int, scale: float) -> np.ndarray:
    points = rng.normal(size=(*status.shape, size)) * scale
    points[status == Status.MISSING] = np.nan
    return points


def _status(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.integers(0, 3, shape).astype(np.uint8)


def _deviations(rng: np.random.Generator, status: np.ndarray) -> np.ndarray:
    return np.where(status == Status.MISSING, np.nan, rng.uniform(0, 0.1, status.shape))


@pytest.fixture
def grid() -> Grid:
    rng = np.random.default_rng(1)
    corner, row, col = (
        _status(rng, shape) for shape in (SHAPE.corners, SHAPE.row_lines, SHAPE.col_lines)
    )
    return Grid(
        shape=SHAPE,
        corners=_points(rng, corner, 2, 300.0),
        corner_status=corner,
        row_lines=_points(rng, row, 2, 300.0),
        row_line_status=row,
        col_lines=_points(rng, col, 2, 300.0),
        col_line_status=col,
        residual_px=0.25,
        reason="glare",
        fault=GridFault.PARTLY_HIDDEN,
        corner_std=_deviations(rng, corner),
        row_line_std=_deviations(rng, row),
        col_line_std=_deviations(rng, col),
        confidence=0.75,
        followed=True,
    )


@pytest.fixture
def surface() -> Surface:
    rng = np.random.default_rng(2)
    status = _status(rng, SHAPE.corners)
    displacement = _points(rng, status, 3, 1e-3)
    reference = rng.normal(size=(*SHAPE.corners, 3)) * 1e-2
    symmetric = rng.normal(size=(*SHAPE.corners, 3, 3)) * 1e-11
    row, col = _status(rng, SHAPE.row_lines), _status(rng, SHAPE.col_lines)
    return Surface(
        shape=SHAPE,
        reference=reference,
        position=reference + displacement,
        displacement=displacement,
        status=status,
        fault=rng.integers(0, 8, SHAPE.corners).astype(np.uint8),
        covariance=symmetric + symmetric.swapaxes(-1, -2),
        ray_gap=displacement[..., 0] ** 2,
        row_position=_points(rng, row, 3, 1e-2),
        row_status=row,
        row_std=rng.uniform(size=SHAPE.row_lines) * 1e-5,
        col_position=_points(rng, col, 3, 1e-2),
        col_status=col,
        col_std=rng.uniform(size=SHAPE.col_lines) * 1e-5,
        reference_id=3,
        reference_stamp_ns=1_700_000_000_000_000_007,
        reference_faults=ReferenceFault.TOUCHED,
        systematics=Systematics(rng.uniform(size=(11, 11)), rng.uniform(size=(11, 11))),
    )


def _contact(rng: np.random.Generator, nodes: list[int], corners: int) -> Contact:
    return made_contact(
        nodes,
        wrench=rng.normal(size=6),
        covariance=rng.normal(size=(6, 6)),
        area=3e-6,
        centre_of_pressure=rng.normal(size=3) * 1e-2,
        outline=rng.normal(size=(corners, 3)) * 1e-2,
        at_border=bool(rng.random() < 0.5),
        slip=SlipEstimate(SlipState.FULL, 1.0, 0.4, 0.41, 0.02),
    )


@pytest.fixture
def field() -> ForceField:
    rng = np.random.default_rng(3)
    rows, cols = SHAPE.corners
    slip = SlipEstimate(SlipState.INCIPIENT, 0.25, 0.5)
    return ForceField(
        rows=rows,
        cols=cols,
        position=rng.normal(size=(rows * cols, 3)) * 1e-2,
        force=rng.normal(size=(rows * cols, 3)),
        contact=rng.random(rows * cols) < 0.5,
        wrench=rng.normal(size=6),
        contact_area=1e-5,
        centre_of_pressure=np.full(3, np.nan),
        reference_point=np.zeros(3),
        slip_state=slip.state,
        valid_fraction=0.75,
        regularization=1e-3,
        young=5e5,
        poisson=0.48,
        force_std=rng.uniform(size=(rows * cols, 3)),
        wrench_covariance=rng.normal(size=(6, 6)),
        systematic_covariance=rng.normal(size=(6, 6)),
        contacts=(
            _contact(rng, [34, 0, 7], 5),
            replace(_contact(rng, [3], 0), covariance=np.full((6, 6), np.nan)),
        ),
        slip=slip,
        flags=ForceFlag.AT_BORDER | ForceFlag.POOR_FIT,
        noise_scale=1.25,
        corrected=True,
        relaxed=True,
    )


def _assert_same(found: object, sent: object) -> None:
    """Every field equal: arrays as the wire carries them, NaN in the same places."""
    assert type(found) is type(sent)
    for name, expected in vars(sent).items():
        value = getattr(found, name)
        if isinstance(expected, np.ndarray):
            assert value.dtype == expected.dtype, name
            assert value.shape == expected.shape, name
            single = expected.dtype == np.float64 and name not in IN_FULL.get(type(sent), ())
            carried = expected.astype(np.float32) if single else expected
            np.testing.assert_array_equal(value, carried, err_msg=name)
        elif isinstance(expected, float):
            assert value == pytest.approx(expected, rel=1e-6, nan_ok=True), name
        elif is_dataclass(expected):
            _assert_same(value, expected)
        elif isinstance(expected, tuple) and expected and is_dataclass(expected[0]):
            assert len(value) == len(expected), name
            for one, other in zip(value, expected, strict=True):
                _assert_same(one, other)
        else:
            assert value == expected, name


def _returned(sent: Grid | Surface | ForceField) -> Grid | Surface | ForceField:
    """What a node reads of the message that another one made."""
    if isinstance(sent, Grid):
        return grid_from_msg(grid_to_msg(sent, HEADER), SHAPE)
    if isinstance(sent, Surface):
        return surface_from_msg(surface_to_msg(sent, HEADER), SHAPE)
    return force_field_from_msg(force_field_to_msg(sent, HEADER))


def test_what_is_sent_is_read_with_its_nan(grid, surface, field):
    """That DDS carries it: nodes/test_chain.py."""
    assert np.isnan(grid.corners).any()
    assert np.isnan(surface.position).any()
    for sent in (grid, surface, field):
        _assert_same(_returned(sent), sent)
    found = grid_to_msg(grid, HEADER).found_fraction
    assert found == pytest.approx(np.mean(grid.corner_status == 1), rel=1e-6)


def test_what_is_not_known_of_a_grid_is_not_known_when_it_is_read(grid):
    """The truth of a simulated frame has no standard deviations: None, not zeros."""
    deviations = dict.fromkeys(("corner_std", "row_line_std", "col_line_std"))
    plain = replace(grid, **deviations, confidence=np.nan, followed=False)
    _assert_same(_returned(plain), plain)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fault", "tired", r"^fault: found 'tired', expected one of '', 'dark', "),
        ("corner_status", array("B", [3] * 35), r"^corner_status: found code 3, expected one of 0"),
        ("row_line_status", array("B", [3] * 90), r"^row_line_status: found code 3, expected one"),
        ("rows", 7, r"rows, cols.*found 7, 7, 3, expected 5, 7, 3"),
    ],
)
def test_impossible_codes_of_a_grid_and_another_shape_are_refused(grid, name, value, message):
    msg = grid_to_msg(grid, HEADER)
    setattr(msg, name, value)
    with pytest.raises(InputError, match=message):
        grid_from_msg(msg, SHAPE)


def test_force_field_that_knows_little_comes_back_as_it_was(field):
    """Too few markers: all is NaN, and what is not known does not come back as numbers."""
    lost = replace(
        field,
        force=np.full(field.force.shape, np.nan),
        force_std=None,
        wrench=np.full(6, np.nan),
        wrench_covariance=np.full((6, 6), np.nan),
        contact_area=np.nan,
        contacts=(),
        slip=SlipEstimate(),
        slip_state=SlipState.UNKNOWN,
        flags=ForceFlag.FEW_MARKERS,
        noise_scale=np.nan,
        corrected=False,
        relaxed=False,
    )
    for some in (lost, replace(lost, force_std=np.full(field.force.shape, np.nan))):
        _assert_same(_returned(some), some)


def test_every_flag_has_its_bit_in_the_message_and_those_of_a_newer_sender_are_kept(field):
    bits = {flag.name: getattr(ForceFieldMsg, f"FLAG_{flag.name}") for flag in ForceFlag if flag}
    assert bits == {flag.name: flag.value for flag in ForceFlag if flag}
    msg = force_field_to_msg(field, HEADER)
    msg.flags = 0x8000 | ForceFlag.AT_BORDER
    read = force_field_from_msg(msg)
    assert ForceFlag.AT_BORDER in read.flags
    assert force_field_to_msg(read, HEADER).flags == msg.flags


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("corner_px", 70),
        ("corner_status", 35),
        ("row_line_px", 180),
        ("col_line_status", 84),
        ("corner_std_px", 35),
        ("row_line_std_px", 90),
        ("col_line_std_px", 84),
    ],
)
def test_short_and_long_grid_arrays_are_named(grid, name, count):
    for change in (lambda values: values[:-1], lambda values: values + values[:1]):
        msg = grid_to_msg(grid, HEADER)
        setattr(msg, name, change(getattr(msg, name)))
        found = len(getattr(msg, name))
        with pytest.raises(InputError, match=rf"^{name}: found {found} .* expected {count} "):
            grid_from_msg(msg, SHAPE)


def test_coordinates_must_agree_with_status(grid):
    seen = np.argwhere(grid.corner_status == Status.MEASURED)[0]
    lost = np.argwhere(grid.corner_status == Status.MISSING)[0]
    for index, value, reason in (
        (seen, np.nan, "corner_px: found NaN or inf at 1 points"),
        (seen, np.inf, "corner_px: found NaN or inf at 1 points"),
        (lost, 0.0, "corner_px: found numbers at 1 points"),
    ):
        corners = grid.corners.copy()
        corners[tuple(index)] = value
        msg = grid_to_msg(replace(grid, corners=corners), HEADER)
        with pytest.raises(InputError, match=reason):
            grid_from_msg(msg, SHAPE)


def test_surface_of_one_view_has_no_depth_and_is_taken(surface):
    """A monocular sensor measures x and y alone: its z is NaN although the marker is measured."""
    flat = replace(
        surface,
        position=surface.position * (1, 1, np.nan),
        displacement=surface.displacement * (1, 1, np.nan),
    )
    _assert_same(_returned(flat), flat)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("rows", 65535, r"^position: found 105 values, expected 1376235 "),
        ("force", array("f", [0.0] * 104), r"^force: found 104 values, expected 105 "),
        ("force_std", array("f", [0.0] * 35), r"^force_std: found 35 values, expected 105 "),
        ("contact", array("B"), r"^contact: found 0 values, expected 35 "),
        ("slip_state", 9, r"^slip_state: found 9"),
        ("nodes", array("H", [3, 35]), r"^contacts\[1\].nodes: found 35, expected .* below 35"),
        ("slip_state", 200, r"^contacts\[1\].slip_state: found 200"),
    ],
)
def test_inconsistent_force_field_or_contact_is_refused_by_field(field, name, value, reason):
    msg = force_field_to_msg(field, HEADER)
    setattr(msg.contacts[1] if reason.startswith("^contacts") else msg, name, value)
    with pytest.raises(InputError, match=reason):
        force_field_from_msg(msg)


def test_cloud_is_organised_and_keeps_nan(surface):
    cloud = organised_cloud(HEADER, surface.position, surface.displacement, ("dx", "dy", "dz"))
    names = [field.name for field in cloud.fields]
    assert names == ["x", "y", "z", "dx", "dy", "dz"]
    points = np.frombuffer(cloud.data, np.float32).reshape(cloud.height, cloud.width, 6)
    expected = np.concatenate([surface.position, surface.displacement], axis=-1)
    np.testing.assert_array_equal(points, expected.astype(np.float32))
    assert not cloud.is_dense
    full = np.nan_to_num(surface.position)
    lacking = full.copy()
    lacking[1, 2, 0] = np.nan
    for parts, is_dense in (
        ((full, full), True),
        ((lacking, full), False),
        ((full, lacking), False),
    ):
        assert organised_cloud(HEADER, *parts, ("dx", "dy", "dz")).is_dense == is_dense


def test_message_constants_are_the_cores_codes():
    assert tuple(Status) == (GridMsg.MISSING, GridMsg.MEASURED, GridMsg.PREDICTED)
    codes = {name: getattr(ForceFieldMsg, f"SLIP_{name}") for name in SlipState.__members__}
    assert codes == dict(SlipState.__members__)
    assert SurfaceMsg().reference_id == 0
