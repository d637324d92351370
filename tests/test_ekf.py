from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3
from jaxtyping import Array, Float
from scipy.stats import multivariate_normal

from jaxtri import ekf
from jaxtri.geometry import pose

update = jax.jit(ekf.update, static_argnames="passes")
filter_ = jax.jit(ekf.filter, static_argnames="passes")


class Linear(eqx.Module):
    """A linear model; an item is its measurement matrix and its noise."""

    F: Float[Array, "d d"]
    Q: Float[Array, "d d"]

    def retract(self, mean, delta):
        return mean + delta

    def local(self, mean, other):
        return other - mean

    def predict(self, mean, dt):
        return mean + dt * (self.F @ mean)

    def process_noise(self, mean, dt):
        return dt * self.Q

    def measure(self, mean, item):
        return item["H"] @ mean

    def noise(self, mean, item):
        return item["R"]


class Sextant(eqx.Module):
    """A camera among known landmarks: an item is a landmark, its measurement two image coordinates."""

    sigma: Float[Array, ""]
    drift: Float[Array, ""]
    rate: Float[Array, "3"]

    def retract(self, mean, delta):
        return pose.retract(mean, delta)

    def local(self, mean, other):
        return pose.local(mean, other)

    def predict(self, mean, dt):
        turn = SO3.exp(self.rate * dt)
        return {"T": turn.as_matrix() @ mean["T"] + 0.05 * dt, "R": turn @ mean["R"]}

    def process_noise(self, mean, dt):
        return self.drift**2 * dt * jnp.eye(6, dtype=self.drift.dtype)

    def _camera(self, mean, landmark):
        return mean["R"].as_matrix() @ landmark + mean["T"]

    def measure(self, mean, item):
        X = self._camera(mean, item)
        return X[:2] / X[2]

    def noise(self, mean, item):
        X = self._camera(mean, item)
        a = jnp.array([[1.0, 0.3], [0.3, 2.0]], X.dtype)
        return self.sigma**2 * (a + 0.1 * jnp.outer(X[:2], X[:2]))


def sextant(dtype=jnp.float64, sigma=1e-2):
    model = Sextant(jnp.asarray(sigma), jnp.asarray(0.02), jnp.array([0.01, -0.02, 0.03]))
    mean = {"R": SO3.exp(jnp.array([0.1, -0.2, 0.1])), "T": jnp.array([0.1, 0.2, -0.1])}
    A = np.random.default_rng(0).normal(size=(6, 6))
    belief = ekf.Belief(mean, jnp.asarray(0.02 * (A @ A.T / 6 + np.eye(6))))
    return jax.tree.map(lambda x: x.astype(dtype), (model, belief))


def sextant_frames(frames, n=12, seed=0, noise=1e-2):
    """Landmarks, measurements from a true state beside the belief, and a mask with one in five missing."""
    rng = np.random.default_rng(seed)
    landmarks = jnp.asarray(np.concatenate([rng.uniform(-2, 2, (n, 2)), rng.uniform(3, 8, (n, 1))], -1))
    model, belief = sextant()
    true = pose.retract(belief.mean, jnp.asarray(rng.normal(0, 0.15, 6)))
    predict = jax.jit(lambda mean: model.predict(mean, jnp.asarray(1.0)))
    measure = jax.jit(lambda mean: jax.vmap(model.measure, (None, 0))(mean, landmarks))
    observed, states = [], []
    for _ in range(frames):
        true = predict(true)
        states.append(true)
        observed.append(measure(true) + noise * rng.normal(size=(n, 2)))
    return landmarks, jnp.stack(observed), jnp.asarray(rng.uniform(size=(frames, n)) > 0.2), states


def central(f, x, h=1e-6):
    return np.stack([(np.asarray(f(x + e)) - f(x - e)) / (2 * h) for e in h * np.eye(x.size)], -1)


def dense_update(model, belief, items, observed, passes):
    """The textbook's iterated EKF: all measurements in one vector, numerical Jacobians, an explicit gain."""
    P, d = np.asarray(belief.covariance), belief.covariance.shape[0]
    retract, local = jax.jit(model.retract), jax.jit(model.local)
    measure = jax.jit(lambda mean: jax.vmap(model.measure, (None, 0))(mean, items).ravel())
    noise = jax.jit(lambda mean: jax.vmap(model.noise, (None, 0))(mean, items))
    z, delta = np.asarray(observed).ravel(), np.zeros(d)
    for _ in range(passes):
        here = retract(belief.mean, delta)
        H = central(lambda e: measure(retract(belief.mean, e)), delta)
        R = jax.scipy.linalg.block_diag(*noise(here))
        innovation = z - measure(here) + H @ delta
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        delta = np.asarray(K @ innovation)
    mean = retract(belief.mean, delta)
    reset = central(lambda e: local(mean, retract(belief.mean, e)), delta)
    log_likelihood = multivariate_normal(np.zeros(z.size), np.asarray(S)).logpdf(innovation)
    nis = innovation @ np.linalg.inv(S) @ innovation
    return mean, reset @ (np.eye(d) - K @ H) @ P @ reset.T, log_likelihood, nis


def assert_trees_close(one, two, **tolerances):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, **tolerances)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_linear_model_is_solved_exactly(m):
    rng = np.random.default_rng(m)
    d, n, frames = 4, 5, 4
    H, A = rng.normal(size=(n, m, d)), rng.normal(size=(n, m, m))
    R = A @ A.swapaxes(1, 2) + 0.1 * np.eye(m)
    F, B = 0.3 * rng.normal(size=(d, d)), rng.normal(size=(2, d, d))
    Q, P = B[0] @ B[0].T, B[1] @ B[1].T
    x, dt = rng.normal(size=d), rng.uniform(0.5, 2, frames)
    observed, mask = rng.normal(size=(frames, n, m)), rng.uniform(size=(frames, n)) > 0.3
    mask[2] = False  # a frame without any measurement
    model, belief = Linear(jnp.asarray(F), jnp.asarray(Q)), ekf.Belief(jnp.asarray(x), jnp.asarray(P))
    items = {"H": jnp.asarray(H), "R": jnp.asarray(R)}
    beliefs, diagnostics = filter_(
        model, belief, items, jnp.asarray(observed), jnp.asarray(mask), jnp.asarray(dt), passes=2
    )
    for t in range(frames):
        step = np.eye(d) + dt[t] * F
        x, P = step @ x, step @ P @ step.T + dt[t] * Q
        rows, z = H[mask[t]].reshape(-1, d), observed[t][mask[t]].ravel()
        noise = np.zeros((z.size, z.size))
        for i, block in enumerate(R[mask[t]]):
            noise[i * m : (i + 1) * m, i * m : (i + 1) * m] = block
        S = rows @ P @ rows.T + noise
        innovation, K = z - rows @ x, P @ rows.T @ np.linalg.inv(S)
        log_likelihood = -(innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
        np.testing.assert_allclose(diagnostics.nis[t], innovation @ np.linalg.solve(S, innovation), atol=1e-11)
        np.testing.assert_allclose(diagnostics.log_likelihood[t], log_likelihood, atol=1e-11)
        assert diagnostics.used[t] == mask[t].sum()
        x, P = x + K @ innovation, P - K @ S @ K.T
        np.testing.assert_allclose(beliefs.mean[t], x, atol=1e-11)
        np.testing.assert_allclose(beliefs.covariance[t], P, atol=1e-11)
        left = np.einsum("nd,ned->ne", innovation_by_item(observed[t], H, x), np.linalg.inv(R))
        distance = np.einsum("ne,ne->n", left, innovation_by_item(observed[t], H, x))
        np.testing.assert_allclose(diagnostics.distance[t], np.where(mask[t], distance, 0), atol=1e-10)


def innovation_by_item(observed, H, x):
    return observed - H @ x


@pytest.mark.parametrize("passes", [1, 4])
def test_update_equals_the_dense_iterated_filter(passes):
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames(1)
    seen = np.flatnonzero(mask[0])
    mean, covariance, log_likelihood, nis = dense_update(model, belief, landmarks[seen], observed[0][seen], passes)
    posterior, diagnostics = update(model, belief, landmarks, observed[0], mask[0], passes=passes)
    np.testing.assert_allclose(model.local(mean, posterior.mean), 0, atol=1e-8)
    np.testing.assert_allclose(posterior.covariance, covariance, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(diagnostics.log_likelihood, log_likelihood, rtol=1e-7)
    np.testing.assert_allclose(diagnostics.nis, nis, rtol=1e-7)


def test_prediction_equals_the_dense_one():
    model, belief = sextant()
    dt = jnp.asarray(1.5)
    predicted = jax.jit(ekf.predict)(model, belief, dt)
    mean = model.predict(belief.mean, dt)
    error = jax.jit(lambda e: model.local(mean, model.predict(model.retract(belief.mean, e), dt)))
    F = central(error, np.zeros(6))
    np.testing.assert_allclose(model.local(mean, predicted.mean), 0, atol=1e-14)
    expected = F @ belief.covariance @ F.T + model.process_noise(mean, dt)
    np.testing.assert_allclose(predicted.covariance, expected, atol=1e-9)


def log_likelihood(model, belief, items, observed, mask, passes=3):
    return jnp.sum(ekf.filter(model, belief, items, observed, mask, passes=passes)[1].log_likelihood)


value_and_gradient = jax.jit(
    jax.value_and_grad(log_likelihood, argnums=(0, 1, 2, 3), allow_int=True), static_argnames="passes"
)


@pytest.mark.parametrize("junk", [np.nan, np.inf, 1e30])
def test_masked_item_is_an_absent_item(junk):
    model, belief = sextant()
    landmarks, observed, _, _ = sextant_frames(2)
    seen = jnp.arange(12) % 3 != 1
    value, gradient = value_and_gradient(
        model,
        belief,
        jnp.where(seen[:, None], landmarks, junk),
        jnp.where(seen[:, None], observed, junk),
        jnp.stack([seen, seen]),
    )
    expected, slope = value_and_gradient(model, belief, landmarks[seen], observed[:, seen], jnp.ones((2, 8), bool))
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert_trees_close(gradient[:2], slope[:2], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gradient[2][seen], slope[2], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gradient[3][:, seen], slope[3], rtol=1e-9, atol=1e-9)
    assert not np.any(gradient[2][~seen])
    assert not np.any(gradient[3][:, ~seen])


@pytest.mark.parametrize("robust", [None, ekf.Robust()])
def test_order_of_items_changes_nothing(robust):
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames(1)
    order = np.random.default_rng(1).permutation(12)
    one = update(model, belief, landmarks, observed[0], mask[0], passes=8, robust=robust)
    two = update(model, belief, landmarks[order], observed[0][order], mask[0][order], passes=8, robust=robust)
    assert_trees_close(one[0], two[0], rtol=1e-9, atol=1e-12)
    assert_trees_close(one[1].log_likelihood, two[1].log_likelihood, rtol=1e-9)
    assert_trees_close(one[1].weights[order], two[1].weights, rtol=1e-7)
    assert_trees_close(one[1].distance[order], two[1].distance, rtol=1e-7)


def test_pinned_direction_stays_pinned():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames(1)
    # The tree's leaves stand in the order of their keys: R, then T.
    direction = np.array([0, 0, 0, 1.0, 2.0, -1.0])
    direction /= np.linalg.norm(direction)
    project = np.eye(6) - np.outer(direction, direction)
    pinned = ekf.Belief(belief.mean, project @ belief.covariance @ project)
    posterior, diagnostics = update(model, pinned, landmarks, observed[0], mask[0], passes=4)
    moved = model.local(belief.mean, posterior.mean)
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved @ direction, 0, atol=1e-14)
    np.testing.assert_allclose(posterior.covariance @ direction, 0, atol=1e-14)
    assert np.linalg.eigvalsh(posterior.covariance)[1] > 1e-6
    assert np.isfinite(diagnostics.log_likelihood)


def test_gross_outliers_are_rejected_and_the_clean_answer_returns():
    model, belief = sextant()
    landmarks, observed, _, states = sextant_frames(1, n=60)
    bad = np.arange(60) < 18
    broken = observed[0] + np.where(bad, 1.0, 0.0)[:, None] * np.random.default_rng(0).uniform(-0.6, 0.6, (60, 2))
    everything = jnp.ones(60, bool)
    run = partial(update, model, belief, landmarks, passes=9)
    clean, _ = run(observed[0], jnp.asarray(~bad))
    robust, diagnostics = run(broken, everything, robust=ekf.Robust())
    plain, _ = run(broken, everything)
    sd = np.sqrt(np.diag(clean.covariance))
    assert np.max(np.abs(model.local(clean.mean, robust.mean)) / sd) < 1
    assert np.max(np.abs(model.local(clean.mean, plain.mean)) / sd) > 5
    assert np.max(np.abs(model.local(states[0], robust.mean)) / sd) < 4
    gross = bad & (np.asarray(diagnostics.distance) > 30)
    assert gross.sum() >= 15
    assert not np.any(np.asarray(diagnostics.weights)[gross])
    assert np.median(np.asarray(diagnostics.weights)[~bad]) > 0.7
    assert diagnostics.used == np.sum(np.asarray(diagnostics.weights) > 0)
    # Judged by a plain filter on what was kept, the weights have cost little information.
    np.testing.assert_allclose(np.sqrt(np.diag(robust.covariance)), sd, rtol=0.2)


def test_a_large_scale_makes_the_robust_update_the_plain_one():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames(1)
    large = ekf.Robust(*(jnp.asarray(x) for x in (1e14, 1e14, jnp.inf)))
    one = update(model, belief, landmarks, observed[0], mask[0], passes=8, robust=large)
    two = update(model, belief, landmarks, observed[0], mask[0], passes=8)
    assert_trees_close(one, two, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(one[1].weights, mask[0], rtol=1e-10)


def test_filter_is_a_loop_of_step():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames(4)
    dt = jnp.array([1.0, 0.5, 1.0, 2.0])
    robust = ekf.Robust()
    beliefs, diagnostics = filter_(model, belief, landmarks, observed, mask, dt, passes=8, robust=robust)
    step = jax.jit(ekf.step, static_argnames="passes")
    for t in range(4):
        belief, report = step(model, belief, landmarks, observed[t], mask[t], dt[t], passes=8, robust=robust)
        here = jax.tree.map(lambda x, t=t: x[t], (beliefs, diagnostics))
        assert_trees_close(here, (belief, report), rtol=1e-9, atol=1e-11)


def test_gradients_through_the_filter_equal_central_differences_in_a_batch():
    landmarks, observed, mask, _ = sextant_frames(3)
    model, belief = sextant()

    @jax.jit
    @jax.vmap
    def value(theta):
        tuned = eqx.tree_at(lambda m: (m.sigma, m.drift), model, (jnp.exp(theta[0]), jnp.exp(theta[1])))
        return log_likelihood(tuned, belief, landmarks, observed, mask)

    theta = jnp.log(jnp.array([[0.01, 0.02], [0.02, 0.01], [0.005, 0.1]]))
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(value(x))))(theta)
    h = 1e-5
    for i, e in enumerate(np.eye(2)):
        np.testing.assert_allclose(gradient[:, i], (value(theta + h * e) - value(theta - h * e)) / (2 * h), rtol=1e-6)
    # A batch is a stack of single runs.
    np.testing.assert_allclose(value(theta)[1], value(theta[1:2])[0], rtol=1e-12)


@pytest.mark.parametrize("robust", [None, ekf.Robust()])
def test_float32_stays_float32_and_positive_over_a_long_run(robust):
    landmarks, observed, mask, states = sextant_frames(200)
    single = partial(jax.tree.map, lambda x: x.astype(jnp.float32))
    model, belief = sextant(jnp.float32)
    passes = 1 if robust is None else 8
    beliefs, diagnostics = filter_(
        model, belief, single(landmarks), single(observed), mask, passes=passes, robust=robust
    )
    for leaf in jax.tree.leaves((beliefs, eqx.filter(diagnostics, eqx.is_inexact_array))):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()
    P = np.asarray(beliefs.covariance, np.float64)
    size = np.abs(P).max(axis=(1, 2))
    assert (np.abs(P - P.swapaxes(1, 2)).max(axis=(1, 2)) < 1e-6 * size).all()
    assert (np.linalg.eigvalsh((P + P.swapaxes(1, 2)) / 2)[:, 0] > 0).all()
    errors = jax.vmap(model.local)(beliefs.mean, single(jax.tree.map(lambda *x: jnp.stack(x), *states)))
    nees = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(P), errors)
    assert 4 < nees[20:].mean() < 9
