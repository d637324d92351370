from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3
from scipy.spatial.transform import Rotation

from jaxtri.estimation.bound import filtering_bound
from jaxtri.estimation.two_view import refine
from jaxtri.filters import ekf, schmidt
from jaxtri.geometry.pose import retract, shear
from jaxtri.models import base_frames, trifocal
from jaxtri.models.base_frames import BaseFrames
from jaxtri.models.motion import POSE_ROWS
from jaxtri.models.trifocal import Trifocal
from jaxtri.synthetic.experiment import paper_experiment

SD = {"velocity_sd": 0.01, "angular_velocity_sd": 0.02}
MOTION = (jnp.asarray(0.01), jnp.asarray(0.02))
N = 40

begin_base_frames = jax.jit(partial(base_frames.start, **SD), static_argnums=5)
total = jax.jit(lambda model, belief: schmidt.total(model, belief, None).covariance)
start = jax.jit(partial(trifocal.start, **SD))
release, fresh_points = jax.jit(base_frames.release), jax.jit(base_frames.begin)


# What has a default is always given: without it the same would be compiled once more.
def begin(key, noise_px=0.1):
    return _begin(key, noise_px)


def follow(e, view, k=2, every=0, scale=1.0):
    """Poses and covariances of the base-frame filter; with `every` each such frame becomes a base frame."""
    return _follow(e, view, k, every, scale)


@jax.jit
def _begin(key, noise_px):
    e = paper_experiment(key, n_points=N, n_frames=8, noise_px=noise_px)
    R = SO3.from_matrix(e.rotations[1])
    return e, refine(e.translations[1], R, e.observed[0], e.observed[1], jnp.ones(N, bool), e.sigma)


@partial(jax.jit, static_argnames="k")
def _follow(e, view, k, every, scale):
    model = BaseFrames(e.sigma, *(scale * x for x in MOTION))
    everything = jnp.ones(N, bool)
    belief = base_frames.start(view, e.observed[0], e.observed[1], everything, e.sigma, k, **SD)

    def body(carry, z):
        belief, t = carry
        base = (t % jnp.maximum(every, 1) == 0) & (every > 0)
        slot = 1 + (t // jnp.maximum(every, 1) - 1) % max(k - 2, 1)
        belief, says = base_frames.step(model, belief, z, everything, base, jnp.where(base, slot, 0))
        whole = schmidt.total(model, belief, None)
        return (belief, t + 1), (belief.mean.motion, whole.covariance, says.log_likelihood)

    return jax.lax.scan(body, (belief, 1), e.observed[2:])


@jax.jit
def follow_trifocal(e, view):
    pairs = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1)
    everything = jnp.ones(N, bool)
    model = Trifocal(e.sigma, *MOTION, jnp.zeros(()), view.translation)
    belief = trifocal.consistent_start(view, pairs, everything, e.sigma, **SD)
    return schmidt.filter(model, belief, pairs, e.observed[2:], jnp.broadcast_to(everything, e.observed[2:].shape[:2]))


@pytest.mark.parametrize("seed", [0, 3])
def test_two_base_frames_are_the_trifocal_filter(seed):
    """To first order in the noise: the difference, in standard deviations, falls as the noise does."""
    apart = []
    for noise_px in (0.1, 0.01):
        e, view = begin(jax.random.key(seed), noise_px=noise_px)
        ours, theirs = follow(e, view)[1], follow_trifocal(e, view)[0]
        sd = np.sqrt(np.diagonal(theirs.covariance, axis1=1, axis2=2)[:, :6])
        apart.append(np.abs((ours[0].translation - theirs.mean.motion.translation) / sd[:, :3]).max())
        pose = np.ix_(range(len(sd)), POSE_ROWS, POSE_ROWS)
        a, b = (np.asarray(ours[1])[pose], np.asarray(theirs.covariance)[pose])
        s = np.sqrt(np.diagonal(b, axis1=1, axis2=2))
        assert np.abs((a - b) / (s[:, :, None] * s[:, None])).max() < 0.5 * noise_px
    assert apart[1] < 0.2 * apart[0] < 0.01


def test_the_measurement_is_that_of_the_trifocal_model():
    e, view = begin(jax.random.key(1))
    pairs = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1)
    model = Trifocal(e.sigma, *MOTION, jnp.zeros(()), view.translation)
    moved = jax.jit(lambda m, error: model.retract(m, error))(
        start(view).mean, 1e-3 * np.random.default_rng(2).normal(size=18)
    )
    got, noise = jax.jit(lambda m, x: (model.measured(m, x, jnp.zeros((N, 4))), model.item_noise(m, x)))(moved, pairs)
    one = jax.jit(jax.vmap(lambda m, x: (model.measure(m, x), model.noise(m, x)), (None, 0)))
    predicted, expected = one(moved, pairs)
    np.testing.assert_allclose(got.predicted, predicted, rtol=1e-12)
    spread = np.asarray(got.spread)
    np.testing.assert_allclose(spread @ noise @ spread.swapaxes(1, 2) + e.sigma**2 * np.eye(2), expected, rtol=1e-12)


def test_a_consistent_start_is_the_usual_one():
    """Its covariance, now owed to the pairs, is what the two-view estimate says of itself."""
    e, view = begin(jax.random.key(4))
    pairs = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1)
    plain = np.asarray(start(view).covariance)

    @jax.jit
    def consistent():
        noise = jnp.broadcast_to(e.sigma**2 * jnp.eye(4), (N, 4, 4))
        belief = trifocal.consistent_start(view, pairs, jnp.ones(N, bool), e.sigma, **SD)
        return belief.covariance(noise), jax.scipy.linalg.block_diag(jnp.eye(12), shear(view.translation))

    ours, J = map(np.asarray, consistent())
    s = np.sqrt(np.maximum(np.diagonal(plain), 1e-30))
    # Residuals beyond two sigmas, a twentieth of them, have no weight in the two-view covariance.
    np.testing.assert_allclose(ours / np.outer(s, s), plain / np.outer(s, s), atol=0.1)
    model = BaseFrames(e.sigma, *MOTION)
    based = begin_base_frames(view, e.observed[0], e.observed[1], jnp.ones(N, bool), e.sigma, 2)
    np.testing.assert_allclose(total(model, based), J @ ours @ J.T, atol=1e-3 * s.max() ** 2)


def test_with_every_frame_a_base_frame_the_bound_is_reached():
    """No information is lost and none counted twice: the covariance is the Cramer-Rao bound."""
    e, view = begin(jax.random.key(5), noise_px=1e-4)
    _, (_, covariance, _) = follow(e, view, k=8, every=1, scale=100.0)
    bound = jax.jit(filtering_bound)(e.points, e.rotations, e.translations, e.sigma)
    ours = np.asarray(covariance)[:, POSE_ROWS][:, :, POSE_ROWS]
    s = np.sqrt(np.diagonal(bound, axis1=1, axis2=2))
    np.testing.assert_allclose(np.diagonal(ours, axis1=1, axis2=2) / s**2, 1, atol=0.1)


@pytest.fixture(scope="module")
def based():
    """A filter of eight base frames after eight frames, slots 1 to 3 filled."""
    e, view = begin(jax.random.key(6))
    (belief, _), _ = follow(e, view, k=8, every=2)
    return BaseFrames(e.sigma, *MOTION), belief, e


def test_releasing_a_base_frame_leaves_the_pose_alone(based):
    model, belief, _ = based
    free = release(model, belief, jnp.asarray(1))
    before, after = (np.asarray(total(model, b)) for b in (belief, free))
    rest = np.r_[0:18, 24:54]
    s = np.sqrt(np.diagonal(before)[rest])
    s[s == 0] = 1
    np.testing.assert_allclose(
        after[np.ix_(rest, rest)] / np.outer(s, s), before[np.ix_(rest, rest)] / np.outer(s, s), atol=1e-9
    )
    assert not np.any(after[18:24])
    assert not np.any(free.mean.points.lever[:, :, 6:12])
    # Nothing becomes more certain: the whole covariance of each point.
    whole = []
    for b, C in ((belief, before), (free, after)):
        lever = np.asarray(b.mean.points.owed)
        own = float(model.sigma) ** 2 * np.asarray(b.mean.points.noise)
        whole.append(lever @ C[12:, 12:] @ np.swapaxes(lever, 1, 2) + own)
    assert np.linalg.eigvalsh(whole[1] - whole[0]).min() > -1e-6 * np.abs(whole[0]).max()


def test_releasing_an_empty_slot_changes_nothing(based):
    model, belief, _ = based
    free = release(model, belief, jnp.asarray(1))
    again = release(model, free, jnp.asarray(1))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(free), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-15)


def test_forgetting_points_leaves_the_covariance_alone(based):
    model, belief, _ = based
    gone = jnp.arange(N) < 25
    less = jax.jit(base_frames.forget)(model, belief, gone)
    assert not np.any(less.sensitivity[:, :25])
    before, after = (total(model, b) for b in (belief, less))
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-18)


def test_a_new_point_stands_where_it_was_seen_and_moves_with_its_base_frame(based):
    model, belief, e = based
    fresh = jnp.arange(N) < 3
    z = e.observed[-1]
    new = fresh_points(model, belief, jnp.asarray(2), z, fresh, jnp.asarray(2.0), jnp.asarray(1.0))
    assert not np.any(new.sensitivity[:, :3])
    pose, p = new.mean.motion.pose, jax.tree.map(np.asarray, new.mean.points)
    seen = jax.jit(jax.vmap(lambda X: base_frames._derivatives(pose, X)[0]))(p.point)[:3]
    np.testing.assert_allclose(seen, z[:3], atol=1e-12)
    # Move the base frame and the points with it: from there they look the same, and as deep.
    error = 1e-5 * np.random.default_rng(0).normal(size=6)
    X = p.point[:3] + p.lever[:3, :, 12:18] @ error
    there = np.asarray(jax.jit(lambda e: retract(pose, e).as_matrix())(error))
    x = X[:, :3] @ there[:3, :3].T + X[:, 3:] * there[:3, 3]
    np.testing.assert_allclose(x[:, :2] / x[:, 2:], z[:3], atol=1e-8)
    np.testing.assert_allclose(X[:, 3] / x[:, 2], 2.0, atol=1e-8)
    np.testing.assert_array_equal(p.point[3:], belief.mean.points.point[3:])
    # Twice as near, its lever is the one that the slope leads to.
    near = fresh_points(model, belief, jnp.asarray(2), z, fresh, jnp.asarray(4.0), jnp.asarray(1.0))
    np.testing.assert_allclose(near.mean.points.lever[:3], p.lever[:3] + 2 * p.slope[:3], atol=1e-12)


def test_the_lever_of_a_pair_is_that_of_the_point_as_it_moves():
    e, view = begin(jax.random.key(2))
    first, second, everything = e.observed[0], np.asarray(e.observed[1]), jnp.ones(N, bool)
    T = np.asarray(view.translation)
    along = T[:2] - second * T[2]
    moving = jax.jit(lambda z: base_frames.start(view, first, z, everything, e.sigma, 3, **SD).mean.points)
    here, there = (jax.tree.map(np.asarray, moving(z)) for z in (second, second + 1e-3 * along))
    moved = (there.point - here.point)[:, 3, None, None]
    change = there.lever - here.lever
    assert np.abs(change).max() > 1e-3
    np.testing.assert_allclose(change, here.slope * moved, atol=0.02 * np.abs(change).max())


def test_measured_derivatives(based):
    model, belief, _ = based
    mean, still = belief.mean, jnp.zeros((N, 3))

    def predicted(e, m):
        return model.measured(model.retract(mean, e), None, m).predicted

    got = jax.jit(lambda: model.measured(mean, None, still))()
    J, B = jax.jit(jax.jacfwd(predicted, argnums=(0, 1)))(jnp.zeros(54), still)
    np.testing.assert_allclose(got.jacobian, J, atol=1e-10)
    np.testing.assert_allclose(got.spread, B[jnp.arange(N), :, jnp.arange(N)], atol=1e-10)


def test_gradient_through_a_change_of_base_frames(based):
    """Of what is around the update, whose own gradient `test_schmidt` checks."""
    model, belief, e = based
    fresh, slot = jnp.arange(N) < 5, jnp.asarray(1)

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        scaled = BaseFrames(model.sigma * jnp.exp(x[0]), *MOTION)
        ready = base_frames.release(scaled, base_frames.forget(scaled, belief, fresh), slot)
        at = scaled.measured(ready.mean, None, jnp.zeros((N, 3)))
        gain = jnp.exp(x[1]) * at.spread.mT
        said = schmidt.ItemUpdate(jnp.einsum("npm,nm->np", gain, e.observed[-1] - at.predicted), gain, at)
        promoted = base_frames.promote(ready, slot, said)
        after = base_frames.begin(scaled, promoted, slot, e.observed[-1], fresh, jnp.exp(x[1]), jnp.exp(x[0]))
        whole = schmidt.total(scaled, after, None).covariance
        p = after.mean.points
        return jnp.sum(p.point) + 1e-6 * jnp.sum(p.noise) + 1e6 * jnp.trace(whole)

    x = jnp.array([0.1, -0.2])
    slope = loss(x)[1]
    step = 1e-5
    for i, d in enumerate(step * np.eye(2)):
        np.testing.assert_allclose(slope[i], (loss(x + d)[0] - loss(x - d)[0]) / (2 * step), rtol=1e-5)


def test_outliers_and_blind_frames():
    e, view = begin(jax.random.key(9))
    model, everything = BaseFrames(e.sigma, *MOTION), jnp.ones(N, bool)
    belief = begin_base_frames(view, e.observed[0], e.observed[1], everything, e.sigma, 4)
    step = jax.jit(partial(base_frames.step, passes=9))
    no, yes, slot = jnp.asarray(False), jnp.asarray(True), jnp.asarray(1)
    for t in range(2, 8):
        z = np.array(e.observed[t])
        z[t : t + 8] += 0.2
        blind = t == 4
        mask = everything & (not blind)
        belief, says = step(model, belief, z, mask, yes if t in (4, 6) else no, slot, robust=ekf.Robust())
        assert (int(says.used) == 0) if blind else (int(says.used) >= 30)
    turn = Rotation.from_matrix(np.asarray(e.rotations[7]) @ np.asarray(belief.mean.motion.R).T)
    assert np.rad2deg(turn.magnitude()) < 0.05
