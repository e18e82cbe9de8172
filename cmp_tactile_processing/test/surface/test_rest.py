"""Stillness, touch, reference and drift, from markers of known motion and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.rigid_motion import fit_motion
from cmp_tactile_processing.measured import (
    GridShape,
    MarkerFault,
    Markers3D,
    Status,
    Surface,
    no_virtual_markers,
)
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.reference_keeping import (
    DriftParameters,
    ReferenceKeeper,
    ZeroParameters,
)
from cmp_tactile_processing.surface.stillness import RestParameters, StillnessWatch, judge_frames

SHAPE = GridShape(20, 20, 1)
UM = 1e-6
# Noise of a marker in x, y and z, m: that of a usual camera.
NOISE = np.array([1.5, 1.5, 4.0]) * UM
FRAMES = 20
SECOND = 10**9
TAKEN = "reference {} is the mean of 20 frames, taken automatically"


@pytest.fixture(scope="module")
def nominal(sensor) -> np.ndarray:
    return sensor.pattern.corners()


def _markers(position: np.ndarray, noise: np.ndarray | None = NOISE) -> Markers3D:
    """Markers that a rig would hand over; noise None: of unknown covariance."""
    known = np.isfinite(position[..., 0])
    variance = np.full(3, np.nan) if noise is None else noise**2
    covariance = np.where(known[..., None, None], np.zeros((3, 3)), np.nan)
    covariance[..., [0, 1, 2], [0, 1, 2]] += variance
    if noise is None:
        covariance[:] = np.nan
    return Markers3D(
        shape=SHAPE,
        position=position,
        status=known.astype(np.uint8),
        fault=np.where(known, MarkerFault.NONE, MarkerFault.NOT_SEEN).astype(np.uint8),
        covariance=covariance,
        ray_gap=np.zeros(SHAPE.corners),
        **no_virtual_markers(SHAPE),
    )


def _frames(position, motion=None, count=FRAMES, seed=0, noise=NOISE) -> tuple[Markers3D, ...]:
    """Frames of markers with noise; motion: what they have moved in all by the last frame."""
    rng = np.random.default_rng(seed)
    moved = np.zeros(3) if motion is None else motion
    return tuple(
        _markers(
            position + moved * k / (count - 1) + noise * rng.normal(size=position.shape), noise
        )
        for k in range(count)
    )


def _bump(nominal, depth, radius=2.5e-3, centre=(1e-3, -2e-3)) -> np.ndarray:
    distance = np.linalg.norm(nominal[..., :2] - centre, axis=-1)
    out = np.zeros(nominal.shape)
    out[..., 2] = -depth * np.exp(-((distance / radius) ** 2))
    return out


def _turned(points, turn, shift, scale=1.0) -> np.ndarray:
    centre = points.reshape(-1, 3).mean(axis=0)
    R = Rotation.from_rotvec(turn).as_matrix()
    return centre + shift + scale * (points - centre) @ R.T


class TestMotion:
    TURN, SHIFT = np.array([2e-3, -3e-3, 1e-3]), np.array([30.0, -20.0, 50.0]) * UM

    def test_a_motion_is_found_to_the_last_digits(self, nominal):
        after = _turned(nominal, self.TURN, self.SHIFT, 1.01)
        motion = fit_motion(nominal, after, scaled=True)
        np.testing.assert_allclose(motion.shift, self.SHIFT, atol=1e-12)
        np.testing.assert_allclose(motion.turn, self.TURN, atol=1e-9)
        assert motion.scale == pytest.approx(1.01, abs=1e-9)
        assert np.abs(motion.residual).max() < 1e-12

    def test_a_bump_does_not_move_the_whole(self, nominal):
        bump = _bump(nominal, 300 * UM)
        motion = fit_motion(nominal, _turned(nominal, self.TURN, self.SHIFT) + bump)
        # Plain least squares would move the whole by 31 um; what is left is the bump's faint skirt.
        np.testing.assert_allclose(motion.shift, self.SHIFT, atol=7 * UM)
        np.testing.assert_allclose(motion.residual, bump, atol=20 * UM)


def _one_bad_frame(nominal, seed) -> tuple[Markers3D, ...]:
    good, *rest = _frames(nominal, seed=seed)
    return (*rest, replace(good, position=good.position + 1e-3))


# Frames of a gel at rest by what is unusual about them.
AT_REST = {
    "noise": lambda nominal, seed: _frames(nominal, seed=seed),
    # As of a blurred image, whose rim is seen at a slant.
    "unequal noise": lambda nominal, seed: _frames(
        nominal, seed=seed, noise=NOISE * (1 + 300 * np.abs(nominal[..., :1]))
    ),
    "a bad frame": _one_bad_frame,
    # A sensor description whose pose is off by a little is that of many labs.
    "mount and scale": lambda nominal, seed: _frames(
        _turned(nominal, [0, 0.01, 0.005], np.array([100.0, 50.0, -80.0]) * UM, 1.01), seed=seed
    ),
    # Corners of a ragged print are off by 11 um each, as on the worn samples.
    "worn print": lambda nominal, seed: _frames(
        nominal + np.random.default_rng(1).normal(0, 11 * UM, nominal.shape), seed=seed
    ),
}


class TestStillness:
    @pytest.mark.parametrize("make", AT_REST.values(), ids=AT_REST)
    def test_a_gel_at_rest_is_still_and_untouched(self, nominal, make):
        for seed in range(3):
            found = judge_frames(make(nominal, seed), nominal, RestParameters())
            assert found.at_rest, found.reason
            assert found.shape.bump < 25 * UM

    @pytest.mark.parametrize("speed_um", [12.0, 50.0, 500.0])
    def test_a_slow_slide_is_motion(self, nominal, speed_um):
        motion = np.array([speed_um, 0.0, 0.0]) * UM
        found = judge_frames(_frames(nominal, motion), nominal, RestParameters())
        assert not found.still
        assert "the gel moves by" in found.reason

    def test_a_press_is_a_touch(self, nominal):
        found = judge_frames(_frames(nominal + _bump(nominal, 80 * UM)), nominal, RestParameters())
        assert found.still
        assert not found.untouched
        # The bump is at x = 1 mm, y = -2 mm.
        assert "markers around (7, 11) are" in found.reason

    def test_a_drag_of_the_whole_is_a_touch_beyond_the_limit_only(self, nominal):
        """What is not seen: a drag of the whole pattern below rest_shift."""
        moved = nominal + [0.6e-3, 0, 0]
        assert not judge_frames(_frames(moved), nominal, RestParameters()).untouched
        wide = RestParameters(rest_shift=1e-3)
        assert judge_frames(_frames(moved), nominal, wide).untouched

    def test_hidden_markers_give_no_verdict(self, nominal):
        seen = nominal.copy()
        seen[:5] = np.nan
        found = judge_frames(_frames(seen), nominal, RestParameters())
        assert not found.seen
        assert not found.at_rest
        assert found.reason == "found 75% of the markers, expected 90%"
        nothing = judge_frames(_frames(np.full_like(nominal, np.nan)), nominal, RestParameters())
        assert nothing.shape is None
        assert not nothing.at_rest

    def test_frames_are_checked_in_numbers_and_again_when_stamps_go_back(self, nominal):
        watch = StillnessWatch(nominal, RestParameters(rest_frames=4))
        frames = _frames(nominal, count=4)
        verdicts = [watch.add(item, k) for k, item in enumerate([*frames, *frames])]
        assert [v is not None for v in verdicts] == [False] * 3 + [True] + [False] * 3 + [True]
        for k, item in enumerate([*frames[:3], *frames[:3]]):
            assert watch.add(item, k % 3) is None
        assert watch.add(frames[3], 3) is not None

    @pytest.mark.parametrize(("shown", "said"), [((0, 1), "found 50%"), ((0, 1, 2), "too few")])
    def test_frames_that_drop_out_are_reported_and_are_no_rest(self, nominal, shown, said):
        nothing = _markers(np.full_like(nominal, np.nan))
        frames = [item if k % 4 in shown else nothing for k, item in enumerate(_frames(nominal))]
        found = judge_frames(tuple(frames), nominal, RestParameters())
        assert not found.at_rest
        assert said in found.reason

    def test_one_view_shows_stillness_and_a_spread_in_the_plane(self, nominal):
        flat = nominal.copy()
        flat[..., 2] = np.nan
        noise = np.array([1.5, 1.5, np.nan]) * UM
        found = judge_frames(_frames(flat, noise=noise), nominal, RestParameters())
        assert found.at_rest, found.reason
        spread = flat.copy()
        spread[..., :2] += 0.06 * nominal[..., :2] * _bump(nominal, 1.0, centre=(0, 0))[..., 2:]
        touched = judge_frames(_frames(spread, noise=noise), nominal, RestParameters())
        assert not touched.untouched


class TestReference:
    def test_mean_and_covariance_are_those_of_the_frames(self, nominal):
        frames = _frames(nominal, count=16)
        reference = Reference.average(frames, 3, 77)
        assert (reference.id, reference.stamp_ns, reference.frames) == (3, 77, 16)
        mean = np.mean([item.position for item in frames], axis=0)
        np.testing.assert_allclose(reference.position, mean, rtol=0, atol=1e-15)
        wanted = np.broadcast_to(np.diag(NOISE**2) / 16, (20, 20, 3, 3))
        np.testing.assert_allclose(reference.covariance, wanted, rtol=1e-12)
        # The displacement's errors: as many again as the covariance says, to 4 standard errors.
        surface = reference.surface(_frames(nominal, count=2, seed=9)[0])
        ratio = surface.displacement / np.sqrt(np.diagonal(surface.covariance, 0, -2, -1))
        assert np.std(ratio) == pytest.approx(1, abs=4 / np.sqrt(2 * ratio.size))

    def test_a_bad_frame_and_a_bad_marker_are_left_out(self, nominal):
        frames = list(_frames(nominal, count=10))
        frames[4] = replace(frames[4], position=frames[4].position + 7e-4)
        frames[6].position[3, 5] += 2e-4
        reference = Reference.average(frames, 1)
        assert reference.frames == 9
        assert np.abs(reference.position - nominal).max() < 4 * NOISE[2]
        np.testing.assert_allclose(reference.covariance[3, 5], np.diag(NOISE**2) / 8)

    def test_more_bad_frames_are_a_gel_that_moves(self, nominal):
        frames = list(_frames(nominal, count=10))
        for k in (1, 4, 7):
            frames[k] = replace(frames[k], position=frames[k].position + 7e-4)
        with pytest.raises(CalibrationError, match=r"found markers moving by 9\d\d um"):
            Reference.average(frames, 1)

    @pytest.mark.parametrize("depth_um", [60, 250, 700])
    @pytest.mark.parametrize("pressed", [1, 2, 3, 4])
    def test_a_press_that_begins_in_the_last_frames_is_no_part_of_it(
        self, nominal, pressed, depth_um
    ):
        """Most markers move less than 50 um aside; a dent of 700 um in 4 of 20 feigned 0.08 N."""
        frames = list(_frames(nominal))
        for k in range(1, pressed + 1):
            dent = _bump(nominal, depth_um * UM * (pressed + 1 - k) / pressed)
            frames[-k] = replace(frames[-k], position=frames[-k].position + dent)
        if pressed > 2:
            with pytest.raises(CalibrationError, match="of 20 frames in which"):
                Reference.average(frames, 1)
            return
        reference = Reference.average(frames, 1)
        assert reference.frames == FRAMES - pressed
        # Errors of the mean of 18 frames, the largest of 400 markers.
        assert np.abs(reference.position - nominal).max() < 5 * NOISE[2] / np.sqrt(18)

    @pytest.mark.parametrize("count", [3, 5, 8])
    def test_a_touch_in_the_middle_of_few_frames_is_no_part_of_it(self, nominal, count):
        frames = list(_frames(nominal, count=count))
        dent = _bump(nominal, 250 * UM)
        frames[count // 2] = replace(frames[count // 2], position=nominal + dent)
        reference = Reference.average(frames, 1)
        assert reference.frames == count - 1
        assert np.abs(reference.position - nominal).max() < 5 * NOISE[2] / np.sqrt(count - 1)

    def test_a_touch_is_found_beside_frames_that_show_nothing(self, nominal):
        hidden = np.full(nominal.shape, np.nan)
        frames = [_markers(hidden) if k % 2 else item for k, item in enumerate(_frames(nominal))]
        frames[10] = replace(frames[10], position=frames[10].position + _bump(nominal, 2e-4))
        assert Reference.average(frames, 1).frames == 9

    @pytest.mark.parametrize("noise", [NOISE, 10 * NOISE])
    def test_frames_of_a_camera_that_shakes_or_is_noisy_serve(self, nominal, noise):
        rng = np.random.default_rng(3)
        frames = [
            _markers(_turned(item.position, rng.normal(size=3) * 2e-4, rng.normal(size=3) * 1e-5))
            for item in _frames(nominal, noise=noise)
        ]
        assert Reference.average(frames, 1).frames == FRAMES

    def test_marker_without_reference_says_so(self, nominal):
        hidden = nominal.copy()
        hidden[4, 6] = np.nan
        now = nominal.copy()
        now[9, 9] = np.nan
        surface = Reference.average(_frames(hidden, count=3), 1).surface(_markers(now))
        assert surface.fault[4, 6] == MarkerFault.NO_REFERENCE
        assert surface.fault[9, 9] == MarkerFault.NOT_SEEN
        assert np.count_nonzero(surface.fault) == 2
        np.testing.assert_array_equal(surface.status == Status.MISSING, surface.fault > 0)
        for lost in (surface.displacement, surface.covariance):
            assert np.isnan(lost[4, 6]).all()
        assert np.isfinite(surface.position[4, 6]).all()

    def test_markers_of_another_sensor_have_the_std_they_are_given(self, sensor, nominal):
        moved = nominal + 1e-4
        surface = Surface.from_positions(sensor.pattern.shape, nominal, moved, std=3e-6)
        np.testing.assert_allclose(surface.displacement, 1e-4, rtol=1e-9)
        wanted = np.broadcast_to(9e-12 * np.eye(3), (20, 20, 3, 3))
        np.testing.assert_allclose(surface.covariance, wanted)

    def test_no_frames_are_refused(self):
        with pytest.raises(CalibrationError, match="found no frames"):
            Reference.average([], 1)


def _keeper(sensor, auto="when_still", *, rezero=False, frames=FRAMES) -> ReferenceKeeper:
    keeper = ReferenceKeeper(Reference.nominal(sensor))
    keeper.zero(ZeroParameters(auto_reference=auto, auto_rezero=rezero))
    keeper.watch(RestParameters(rest_frames=frames), DriftParameters())
    return keeper


def _feed(keeper: ReferenceKeeper, frames, start_s=0.0) -> list[str]:
    said = [keeper.add(item, round((start_s + k / 20) * SECOND)) for k, item in enumerate(frames)]
    return [text for text in said if text]


class TestKeeping:
    def test_zero_is_taken_from_the_first_frames_at_rest(self, sensor, nominal):
        keeper = _keeper(sensor)
        assert _feed(keeper, _frames(nominal)) == [TAKEN.format(1)]
        assert keeper.warning() == ""
        assert _feed(keeper, _frames(nominal, seed=1), 1) == []

    def test_zero_waits_until_contact_is_over(self, sensor, nominal):
        keeper = _keeper(sensor)
        press = nominal + _bump(nominal, 200 * UM)
        assert _feed(keeper, _frames(press)) == []
        assert "no reference yet" in keeper.warning()
        assert "something touches the gel" in keeper.warning()
        assert keeper.reference.id == 0
        leaving = _frames(press, nominal - press, seed=1)
        assert _feed(keeper, leaving, 1) == []
        assert "the gel moves" in keeper.warning() or "touches" in keeper.warning()
        assert len(_feed(keeper, _frames(nominal, seed=2), 2)) == 1
        assert keeper.warning() == ""

    def test_at_start_or_not_at_all(self, sensor, nominal):
        keeper = _keeper(sensor, "at_start")
        nothing = _frames(np.full_like(nominal, np.nan))
        _feed(keeper, nothing)
        assert keeper.waiting, "frames that show nothing are no start"
        _feed(keeper, _frames(nominal + _bump(nominal, 2e-4)), 1)
        assert _feed(keeper, _frames(nominal), 2) == []
        assert "none was taken at start" in keeper.warning()
        keeper.take(_frames(nominal), 1)
        assert keeper.warning() == ""

    def test_the_doubt_holds_until_a_reference_is_taken_of_a_free_gel(self, sensor, nominal):
        keeper = _keeper(sensor)
        keeper.take(_frames(nominal + _bump(nominal, 2e-4)), 1)
        for k in range(2, 5):
            _feed(keeper, _frames(nominal, seed=k), k)
            assert keeper.warning().startswith("reference 1 is doubtful: markers around")
            assert "zero" in keeper.warning()
        keeper.take(_frames(nominal, seed=9), 6)
        assert keeper.warning() == ""

    def test_drift_is_followed_at_rest_and_reported(self, sensor, nominal):
        keeper = _keeper(sensor)
        _feed(keeper, _frames(nominal))
        turn, shift = np.array([0, 0, 1e-3]), np.array([12.0, 0, -16.0]) * UM
        drifted = _turned(nominal, turn, shift)
        for k in range(1, 60):
            assert _feed(keeper, _frames(drifted, seed=k), k) == []
        # The reference's own noise, 4 um / sqrt(20), is in every figure.
        assert keeper.drift.shift == pytest.approx(20 * UM, abs=1 * UM)
        assert keeper.drift.turn == pytest.approx(1e-3, abs=1e-4)
        assert keeper.drift.shape < 4 * UM
        assert "drifted by" in keeper.warning()
        assert "zero" in keeper.warning()
        assert keeper.reference.id == 1, "without auto_rezero nothing is set by itself"

    def test_drift_is_averaged_over_its_time_constant(self, sensor, nominal):
        """With stamps of today: 5 s after rest without drift, 1 - exp(-5 / 10) of it is seen."""
        keeper, today_s = _keeper(sensor, "never"), 1.7e9
        exact = np.array([1.0, 1.0, 1.0]) * 1e-3 * UM
        _feed(keeper, _frames(nominal, noise=exact), today_s)
        _feed(keeper, _frames(nominal + [0, 0, 30 * UM], noise=exact), today_s + 5)
        assert keeper.drift.shift == pytest.approx(30 * UM * (1 - np.exp(-0.5)), rel=1e-3)

    def test_contact_is_no_drift_and_never_zeroed(self, sensor, nominal):
        keeper = _keeper(sensor, rezero=True)
        _feed(keeper, _frames(nominal))
        _feed(keeper, _frames(nominal, seed=1), 1)
        before = keeper.drift
        for k in range(2, 12):
            assert _feed(keeper, _frames(nominal + _bump(nominal, 1.5e-4), seed=k), k) == []
        assert keeper.drift == before
        assert keeper.warning() == ""

    def test_rezero_takes_the_drift_away_where_it_is_wanted(self, sensor, nominal):
        keeper = _keeper(sensor, rezero=True)
        _feed(keeper, _frames(nominal))
        drifted = nominal + [0, 0, 30 * UM]
        said = [text for k in range(1, 5) for text in _feed(keeper, _frames(drifted, seed=k), k)]
        assert said == [TAKEN.format(2)]
        assert np.abs(keeper.reference.position - drifted).max() < 6 * UM
        assert keeper.warning() == ""
