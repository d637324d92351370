from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from intervals import nees_interval
from jaxlie import SE3, SO3
from scipy.spatial.transform import Rotation

from jaxtri.errors import InputError
from jaxtri.estimation.two_view import TwoView
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.pose import compose, exp_pose, local, log_pose, multiply, relative, retract
from jaxtri.models.point_noise import PointNoise
from jaxtri.odometry import single_pair, track_pairs
from jaxtri.odometry.settings import Settings, Status

N, FRAMES, SECOND = 64, 25, 5  # slots, frames, the second base frame
CAMERA = Camera.from_parameters(500, 500, 320, 240, width=640, height=480)
SETTINGS = Settings.of(CAMERA)
PRECISE = Settings.of(CAMERA, noise_px=0.02)  # the motion model's pull on the pose goes with the square

init = jax.jit(partial(track_pairs.init, keyframes=8))
step = jax.jit(track_pairs.step)
segment_init, segment_step = jax.jit(single_pair.init), jax.jit(single_pair.step)


class Scene:
    """Tracks in slots whose points change: half of the slots hold a second track, after a frame of nothing."""

    def __init__(self, noise_px=0.0, seed=0):
        rng = np.random.default_rng(seed)
        t = np.arange(FRAMES)[:, None]
        self.R = Rotation.from_rotvec(-np.sin(t / 9) * [0.02, 0.06, 0.04]).as_matrix()
        self.centres = t * [0.06, 0.004, 0.01] + 0.02 * (1 - np.cos(t / 5))
        self.T = -np.einsum("tij,tj->ti", self.R, self.centres)
        self.points = rng.uniform([-2, -1.5, 3], [3.5, 1.5, 5.5], (2, N, 3))
        change = np.where(np.arange(N) % 2, rng.integers(SECOND + 2, FRAMES - 8, N), FRAMES)
        X = self.points[(t > change).astype(int), np.arange(N)]
        Y = np.einsum("tij,tnj->tni", self.R, X) + self.T[:, None]
        self.observed = Y[..., :2] / Y[..., 2:] + rng.normal(size=(FRAMES, N, 2)) * noise_px / 500
        self.visible, self.fresh = t != change, t == change + 1

    def pose(self, k):
        return compose(SO3.from_matrix(jnp.asarray(self.R[k])), jnp.asarray(self.T[k]))

    def frame(self, k, dtype=jnp.float64):
        return jnp.asarray(self.observed[k], dtype), jnp.asarray(self.visible[k]), jnp.asarray(self.fresh[k])

    def begin(self, dtype=jnp.float64, settings=SETTINGS):
        cast = partial(jax.tree.map, lambda x: x.astype(dtype))
        ends = (self.frame(k, dtype)[0] for k in (0, SECOND))
        pose = cast(relative(self.pose(0), self.pose(SECOND)))
        return init(cast(settings), *ends, jnp.ones(N, bool), pose)


def follow(scene, dtype=jnp.float64, settings=SETTINGS):
    """The state after the second base frame, and the reports of all frames after the first."""
    settings = jax.tree.map(lambda x: x.astype(dtype), settings)
    state, reports = scene.begin(dtype), []
    for k in range(1, FRAMES):
        state, report = step(settings, state, *scene.frame(k, dtype), hold=jnp.asarray(k <= SECOND))
        reports.append(report)
        if k == SECOND:
            middle = state
    return middle, jax.tree.map(lambda *x: np.stack(x), *reports)


def matrices(poses):
    return np.asarray(SE3(jnp.asarray(poses.wxyz_xyz)).as_matrix())


def position_errors(scene, reports):
    T = matrices(reports.pose)
    centres = -np.einsum("tji,tj->ti", T[:, :3, :3], T[:, :3, 3])
    return np.linalg.norm(centres - scene.centres[1:], axis=-1)


@jax.jit
@jax.vmap
def off(pose, R, T):
    return log_pose(relative(SE3(pose), compose(SO3.from_matrix(R), T)))


def squares(scene, reports):
    """NEES of the poses."""
    errors = off(reports.pose.wxyz_xyz, scene.R[1:], scene.T[1:])
    return np.einsum("ti,ti->t", errors, np.linalg.solve(reports.covariance, errors[..., None])[..., 0])


@pytest.fixture(scope="module")
def exact():
    scene = Scene()
    return scene, *follow(scene, settings=PRECISE)


@pytest.fixture(scope="module")
def noisy():
    scene = Scene(noise_px=0.3)
    return scene, *follow(scene)


def test_exact_tracks_give_exact_poses_through_births_and_deaths(exact):
    scene, _, reports = exact
    T = matrices(reports.pose)
    np.testing.assert_allclose(T[:, :3, :3], scene.R[1:], atol=1e-6)
    np.testing.assert_allclose(T[:, :3, 3], scene.T[1:], atol=1e-6)
    assert (reports.status == Status.TRACKING).all()
    assert not reports.drop.any()
    # The new tracks take part: all slots are in use again at the end.
    assert reports.diagnostics.used[-1] > 0.9 * N
    assert not reports.keyframe[:SECOND].any()
    assert reports.keyframe[SECOND:].sum() > 3


def test_errors_are_those_that_the_covariance_says(noisy):
    scene, _, reports = noisy
    nees = squares(scene, reports)
    assert position_errors(scene, reports).max() < 0.03
    # One run, whose frames share the errors of the first keyframes: no more than one independent frame.
    low, high = nees_interval(6, 1)
    assert low < np.mean(nees[SECOND:]) < high


def test_noise_above_the_assumed_one_is_found_and_stated():
    found, nees = [], []
    for seed in range(6):
        scene = Scene(noise_px=1.2, seed=seed)  # three times what is assumed
        _, reports = follow(scene)
        found.append(reports.noise[-1])
        nees.append(squares(scene, reports)[-1])
    np.testing.assert_allclose(np.mean(found), 3.0, rtol=0.1)
    low, high = nees_interval(6, 6)
    assert low < np.mean(nees) < high


def test_noise_below_the_assumed_one_changes_nothing():
    scene = Scene(noise_px=0.2)
    _, reports = follow(scene)
    _, fixed = follow(scene, settings=eqx.tree_at(lambda s: s.noise_gain, SETTINGS, jnp.asarray(0.0, float)))
    np.testing.assert_array_equal(reports.noise, 1.0)
    for a, b in zip(jax.tree.leaves(reports), jax.tree.leaves(fixed), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_stands_in_an_invisible_slot_changes_nothing(noisy):
    _, _, reports = noisy
    other = Scene(noise_px=0.3)
    other.observed[~other.visible] = np.nan
    assert np.isnan(other.observed).any()
    for a, b in zip(jax.tree.leaves(follow(other)[1]), jax.tree.leaves(reports), strict=True):
        np.testing.assert_array_equal(a, b)


def test_order_of_slots_changes_nothing(noisy):
    _, _, reports = noisy
    other, order = Scene(noise_px=0.3), np.random.default_rng(0).permutation(N)
    for name in ("observed", "visible", "fresh"):
        setattr(other, name, getattr(other, name)[:, order])
    _, found = follow(other)
    np.testing.assert_allclose(matrices(found.pose), matrices(reports.pose), atol=1e-10)
    np.testing.assert_allclose(found.covariance, reports.covariance, rtol=1e-5, atol=1e-14)
    np.testing.assert_array_equal(found.drop, reports.drop[:, order])


def test_changing_tracks_never_recompile(exact, noisy):
    before = step._cache_size()
    rng = np.random.default_rng(0)
    scene = Scene()
    scene.visible &= rng.uniform(size=scene.visible.shape) > 0.2
    scene.visible[:, N // 2 :] = False
    scene.fresh = scene.visible & ~np.roll(scene.visible, 1, axis=0)
    follow(scene)
    assert step._cache_size() == before


def test_scan_is_a_loop_of_step_and_its_derivative_is_finite(noisy):
    scene, middle, reports = noisy
    frames = [jnp.stack(x) for x in zip(*(scene.frame(k) for k in range(SECOND + 1, SECOND + 9)), strict=True)]

    def run(sigma):
        settings = eqx.tree_at(lambda s: s.sigma, SETTINGS, sigma)
        _, found = track_pairs.filter(settings, middle, *frames)
        return found.pose.wxyz_xyz[-1, 4:], found

    with_slope = jax.jit(lambda sigma: jax.jvp(run, (sigma,), (jnp.ones_like(sigma),), has_aux=True))
    _, slope, found = with_slope(SETTINGS.sigma)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(reports), strict=True):
        np.testing.assert_allclose(a, b[SECOND : SECOND + 8], rtol=1e-7, atol=1e-10)
    assert np.isfinite(slope).all()
    h = 1e-4 * SETTINGS.sigma
    numerical = (with_slope(SETTINGS.sigma + h)[0] - with_slope(SETTINGS.sigma - h)[0]) / (2 * h)
    assert np.linalg.norm(slope) > 1e-3
    np.testing.assert_allclose(slope, numerical, rtol=1e-4, atol=1e-4 * np.linalg.norm(slope))


def test_garbage_makes_it_coast_and_then_lose_the_camera(exact):
    scene = Scene()
    scene.observed[12:] = np.random.default_rng(0).uniform(-0.5, 0.5, scene.observed[12:].shape)
    scene.fresh[:] = False
    _, reports = follow(scene, settings=eqx.tree_at(lambda s: s.patience, SETTINGS, jnp.asarray(3.0, float)))
    expected = [Status.TRACKING] * 11 + [Status.COASTING] * 3 + [Status.LOST] * (FRAMES - 15)
    np.testing.assert_array_equal(reports.status, expected)
    assert np.isfinite(reports.pose.wxyz_xyz).all()
    # Coasting is constant velocity, and growing doubt.
    T = jnp.asarray(reports.pose.wxyz_xyz)
    first, second = (log_pose(relative(SE3(T[k]), SE3(T[k + 1]))) for k in (11, 12))
    np.testing.assert_allclose(first, second, atol=1e-12)
    sizes = np.trace(reports.covariance[10:], axis1=1, axis2=2)
    assert (np.diff(sizes) > 0).all()


def test_too_few_tracks_lose_the_camera_at_once(exact):
    scene = Scene()
    scene.visible[12:, 5:] = False
    _, reports = follow(scene)
    np.testing.assert_array_equal(reports.status[11:], Status.LOST)
    assert np.isfinite(reports.pose.wxyz_xyz).all()


def test_tracks_that_jump_are_given_up_and_the_pose_stays_right(noisy):
    _, _, clean = noisy
    scene = Scene(noise_px=0.3)
    jumpers = [0, 10, 20, 30, 40, 50]  # none of them changes its point
    scene.observed[9:, jumpers] += np.random.default_rng(0).choice([-0.05, 0.05], (6, 2))
    _, reports = follow(scene)
    np.testing.assert_array_equal(np.flatnonzero(reports.drop[8]), jumpers)
    assert position_errors(scene, reports)[8] < 1.5 * position_errors(scene, clean)[8] + 2e-3
    assert position_errors(scene, reports).max() < 0.03


def test_tracks_that_move_by_themselves_are_left_out_as_if_they_were_gone():
    movers, begun = [0, 10, 20, 30, 40, 50], 9  # none of them changes its point
    moving, without = Scene(), Scene()
    # To and fro, by more than the gate leaves; and none is given up at once, as what is far off is.
    moving.observed[begun:, movers, 1] += (5 / 500 * (-1.0) ** np.arange(begun, FRAMES))[:, None]
    without.visible[begun:, movers] = False
    patient = eqx.tree_at(lambda s: s.outlier, SETTINGS, jnp.asarray(1e6))
    (_, found), (_, gone) = follow(moving, settings=patient), follow(without, settings=patient)
    # Three frames in a row are enough; reports begin with frame 1.
    assert not found.moving[: begun + 1].any()
    assert found.moving[begun + 1 :].any(axis=0)[movers].all()
    assert not np.delete(found.moving, movers, axis=1).any()
    np.testing.assert_allclose(position_errors(moving, found), position_errors(without, gone), atol=1e-3)
    trusting = eqx.tree_at(lambda s: s.suspicion, patient, jnp.asarray(0.0))
    assert not follow(moving, settings=trusting)[1].moving.any()


def test_a_window_needs_four_keyframes():
    scene = Scene()
    with pytest.raises(InputError, match="at least 4"):
        track_pairs.init(SETTINGS, *(scene.frame(k)[0] for k in (0, 1)), jnp.ones(N, bool), scene.pose(1), keyframes=3)


def test_float32_stays_float32():
    single = jax.tree.map(lambda x: x.astype(jnp.float32), SETTINGS)
    state = jax.eval_shape(lambda: Scene().begin(jnp.float32))
    new, report = jax.eval_shape(track_pairs.step, single, state, *Scene().frame(6, jnp.float32))
    assert jax.tree.map(lambda x: x.dtype, new) == jax.tree.map(lambda x: x.dtype, state)
    assert report.pose.wxyz_xyz.dtype == report.covariance.dtype == jnp.float32


class TestSegments:
    @staticmethod
    def begin(scene, dtype=jnp.float64):
        pose = relative(scene.pose(0), scene.pose(SECOND))
        T, known = pose.translation(), 1e-8 * jnp.eye(6)
        n = T / jnp.linalg.norm(T)
        known = known.at[:3, :3].set(1e-8 * (jnp.eye(3) - jnp.outer(n, n)))
        two_view = TwoView(T, pose.rotation(), known, jnp.ones(()), jnp.asarray(True))
        two_view = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(dtype), two_view)
        ends = (scene.frame(k, dtype)[0] for k in (0, SECOND))
        settings, origin = jax.tree.map(lambda x: x.astype(dtype), SETTINGS), single_pair.origin(jnp.dtype(dtype))
        return segment_init(settings, *ends, jnp.ones(N, bool), two_view, origin, jnp.asarray(SECOND, dtype))

    @pytest.fixture(scope="class")
    @classmethod
    def state(cls):
        return cls.begin(Scene())

    def test_exact_tracks_give_exact_poses(self, state):
        scene = Scene()
        scene.observed[~scene.visible] = np.nan
        for k in range(SECOND + 1, FRAMES):
            state, report = segment_step(PRECISE, state, *scene.frame(k))
            np.testing.assert_allclose(report.pose.as_matrix()[:3, :3], scene.R[k], atol=1e-6)
            np.testing.assert_allclose(report.pose.as_matrix()[:3, 3], scene.T[k], atol=1e-6)
            assert report.status == Status.TRACKING
        # A track that has ended is out, whatever its slot holds later.
        assert state.inside.sum() == N // 2 - (~self.begin(Scene()).inside[::2]).sum()

    def test_float32_is_float32(self):
        single = partial(jax.tree.map, lambda x: x if x.dtype == bool else x.astype(jnp.float32))
        state = jax.eval_shape(lambda: self.begin(Scene(), dtype=jnp.float32))
        new, report = jax.eval_shape(single_pair.step, single(SETTINGS), state, *Scene().frame(6, jnp.float32))
        assert jax.tree.map(lambda x: x.dtype, new) == jax.tree.map(lambda x: x.dtype, state)
        assert report.covariance.dtype == report.pose.wxyz_xyz.dtype == jnp.float32

    def test_covariance_of_the_world_pose(self, state):
        rng = np.random.default_rng(0)
        A, B = rng.normal(size=(7, 7)), rng.normal(size=(18, 18))
        placed = single_pair.Placement(exp_pose(jnp.asarray(rng.normal(size=6))), jnp.asarray(A @ A.T))
        belief = eqx.tree_at(lambda b: b.covariance, state.belief, jnp.asarray(B @ B.T))
        pose, covariance = single_pair.world_pose(state._replace(belief=belief, placement=placed))

        @jax.jit
        def moved(e):
            """Lengths of the segment grow by the scale, its poses move by their errors, each as it is defined."""
            motion = retract(belief.mean, e[:18]).motion
            own = compose(motion.rotation, motion.translation * jnp.exp(e[24]))
            return local(pose, multiply(own, retract(placed.pose, e[18:24])))

        np.testing.assert_allclose(moved(jnp.zeros(25)), 0, atol=1e-13)
        J = np.stack([moved(h) - moved(-h) for h in 1e-6 * jnp.eye(25)], -1) / 2e-6
        whole = np.zeros((25, 25))
        whole[:18, :18], whole[18:, 18:] = B @ B.T, A @ A.T
        np.testing.assert_allclose(covariance, J @ whole @ J.T, rtol=1e-6, atol=1e-7)

    def test_depths_and_their_precision(self, state):
        scene = Scene()
        depths = jax.jit(single_pair.depths)
        view = relative(scene.pose(0), scene.pose(3))
        value, sd = depths(state, view)
        expected = (scene.points[0] @ scene.R[3].T + scene.T[3])[:, 2]
        np.testing.assert_allclose(value, expected, rtol=1e-9)
        squares = 0
        for h in 1e-6 * jnp.eye(4):
            up, down = (depths(state._replace(pairs=state.pairs + s * h), view)[0] for s in (1, -1))
            squares += ((jnp.log(up) - jnp.log(down)) / 2e-6) ** 2
        np.testing.assert_allclose(sd, np.sqrt(squares), rtol=1e-5)

    def test_common_scale_survives_outliers(self):
        rng, n = np.random.default_rng(0), 101
        common_scale = jax.jit(single_pair.common_scale)
        after, sds, sigma = rng.uniform(2, 6, n), rng.uniform(5, 20, (2, n)), 1e-3
        true = 1.7
        found = []
        for seed in range(100):
            noise = sigma * sds * np.random.default_rng(seed).normal(size=(2, n))
            before = true * after * np.exp(noise[0] - noise[1])
            scale, variance = common_scale(*map(jnp.asarray, (before, sds[0], after, sds[1])), jnp.ones(n, bool), sigma)
            found.append((np.log(scale / true), variance))
        errors, variances = np.transpose(found)
        assert abs(np.mean(errors)) < 4 * np.std(errors) / 10
        # A median of weights, not a weighted mean: its variance is the stated one within a quarter.
        assert 0.75 < np.mean(errors**2) / np.mean(variances) < 1.5

        mask = np.ones(n, bool)
        mask[::7] = False
        before[::7], before[1::3] = np.nan, 5 * before[1::3]
        before[2] = -1.0
        scale, variance = common_scale(*map(jnp.asarray, (before, sds[0], after, sds[1], mask)), sigma)
        assert abs(np.log(scale / true)) < 0.02
        assert variance > variances[-1]
        # The slow twin.
        good = np.flatnonzero(mask & (before > 0))
        ratios = sorted((np.log(before[i] / after[i]), 1 / (sds[0, i] ** 2 + sds[1, i] ** 2)) for i in good)
        half, total = sum(w for _, w in ratios) / 2, 0.0
        while total < half:
            median, weight = ratios.pop(0)
            total += weight
        np.testing.assert_allclose(np.log(scale), median, rtol=1e-12)


def test_a_points_noise_follows_its_quality():
    """1 where a figure is unknown or counts nothing, without a NaN gradient; ratios no more than 30."""
    quality = jnp.asarray([[0.1, 0.03], [1.0, 0.03], [0.1, 0.0003], [0.0, 1e9], [jnp.nan, 1.0], [1.0, jnp.nan]])
    noise = PointNoise(jnp.asarray(0.5), jnp.asarray(0.25))
    variances = np.array([1.75, 1 + 50 + 0.25, 1 + 0.5 + 0.25 * 30, 1 + 0.5 / 900 + 0.25 / 30, 1.75, 1.75])
    expected = np.sqrt(variances / 1.75)
    np.testing.assert_allclose(noise.scale(quality), expected, rtol=1e-12)
    np.testing.assert_array_equal(PointNoise().scale(quality), 1)
    slope = jax.grad(lambda n: jnp.sum(n.scale(quality)))(noise)
    assert np.isfinite(jax.tree.leaves(slope)).all()
