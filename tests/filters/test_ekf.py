from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from intervals import nees_interval
from jaxlie import SO3
from jaxtyping import Array, Float
from scipy.stats import multivariate_normal

from jaxtri.filters import ekf
from jaxtri.filters.model import transition
from jaxtri.geometry import pose

N = 24  # landmarks, the same number everywhere: one compilation for all tests
ROBUST = ekf.Robust(*(jnp.asarray(x) for x in (1e4, 16.0, 13.8)))

update = jax.jit(ekf.update, static_argnames="passes")
filter_ = jax.jit(ekf.filter, static_argnames="passes")
retract = jax.jit(lambda model, mean, delta: model.retract(mean, jnp.asarray(delta)))
local = jax.jit(lambda model, mean, other: model.local(mean, other))
measure = jax.jit(lambda model, mean, items: jax.vmap(model.measure, (None, 0))(mean, items))
noise = jax.jit(lambda model, mean, items: jax.vmap(model.noise, (None, 0))(mean, items))


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


class Ranger(eqx.Module):
    """A vehicle, position and velocity in the plane; an item is a beacon, its measurement the distance to it."""

    sigma: Float[Array, ""]
    acceleration: Float[Array, ""]

    def retract(self, mean, delta):
        return mean + delta

    def local(self, mean, other):
        return other - mean

    def predict(self, mean, dt):
        return mean + dt * jnp.concatenate([mean[2:], jnp.zeros_like(mean[2:])])

    def process_noise(self, mean, dt):
        step = jnp.stack([dt**2 / 2, dt])
        return self.acceleration**2 * jnp.kron(jnp.outer(step, step), jnp.eye(2, dtype=step.dtype))

    def measure(self, mean, item):
        return jnp.linalg.norm(mean[:2] - item)[None]

    def noise(self, mean, item):
        return jnp.square(self.sigma * (1 + 0.1 * self.measure(mean, item)))[None]


def ranger(frames=2, n=8):
    """A model, a belief at the origin, beacons, noisy distances and a mask with two in eight missing."""
    rng = np.random.default_rng(0)
    model = Ranger(*jnp.array([0.05, 0.1]))
    belief = ekf.Belief(jnp.zeros(4), jnp.diag(jnp.array([0.1, 0.1, 0.05, 0.05])))
    beacons = rng.uniform(-3, 3, (n, 2))
    path = 0.2 + 0.3 * np.arange(frames)[:, None] * np.array([1.0, 0.5])
    distances = np.linalg.norm(path[:, None] - beacons, axis=-1)
    observed = distances + 0.05 * rng.normal(size=(frames, n))
    mask = np.arange(n) % 4 != 1
    return model, belief, jnp.asarray(beacons), jnp.asarray(observed)[..., None], jnp.asarray(mask)


def sextant(dtype=jnp.float64):
    model = Sextant(jnp.asarray(1e-2), jnp.asarray(0.02), jnp.array([0.01, -0.02, 0.03]))
    mean = {"R": SO3.exp(jnp.array([0.1, -0.2, 0.1])), "T": jnp.array([0.1, 0.2, -0.1])}
    A = np.random.default_rng(0).normal(size=(6, 6))
    belief = ekf.Belief(mean, jnp.asarray(0.02 * (A @ A.T / 6 + np.eye(6))))
    return jax.tree.map(lambda x: x.astype(dtype), (model, belief))


@cache
def sextant_frames():
    """Landmarks, measurements and states drawn from the model, and a mask with one item in five missing."""
    rng, frames = np.random.default_rng(0), 200
    landmarks = jnp.asarray(np.concatenate([rng.uniform(-2, 2, (N, 2)), rng.uniform(3, 8, (N, 1))], -1))
    model, belief = sextant()

    def advance(mean, draws):
        mean = model.retract(model.predict(mean, jnp.asarray(1.0)), model.drift * draws[0])
        R = noise(model, mean, landmarks)
        z = measure(model, mean, landmarks) + jnp.einsum("nij,nj->ni", jnp.linalg.cholesky(R), draws[1])
        return mean, (mean, z)

    first = retract(model, belief.mean, np.linalg.cholesky(belief.covariance) @ rng.normal(size=6))
    draws = jnp.asarray(rng.normal(size=(frames, 6))), jnp.asarray(rng.normal(size=(frames, N, 2)))
    states, observed = jax.jit(lambda *x: jax.lax.scan(advance, *x)[1])(first, draws)
    return landmarks, observed, jnp.asarray(rng.uniform(size=(frames, N)) > 0.2), states


def central(f, x, h=1e-6):
    return np.stack([(np.asarray(f(x + e)) - np.asarray(f(x - e))) / (2 * h) for e in h * np.eye(x.size)], -1)


def block_diagonal(blocks):
    n, m, _ = blocks.shape
    whole = np.zeros((n, m, n, m))
    whole[np.arange(n), :, np.arange(n), :] = blocks
    return whole.reshape(n * m, n * m)


def dense_update(model, belief, items, observed, passes):
    """The textbook's iterated EKF: all measurements in one vector, numerical Jacobians, an explicit gain."""
    P, prior = np.asarray(belief.covariance), belief.mean
    z, delta = np.asarray(observed).ravel(), np.zeros(len(P))
    for _ in range(passes):
        here = retract(model, prior, delta)
        H = central(lambda e: np.ravel(measure(model, retract(model, prior, e), items)), delta)
        innovation = z - np.ravel(measure(model, here, items)) + H @ delta
        S = H @ P @ H.T + block_diagonal(np.asarray(noise(model, here, items)))
        K = P @ H.T @ np.linalg.inv(S)
        delta = K @ innovation
    mean = retract(model, prior, delta)
    reset = central(lambda e: local(model, mean, retract(model, prior, e)), delta)
    log_likelihood = multivariate_normal(np.zeros(z.size), S).logpdf(innovation)
    nis = innovation @ np.linalg.inv(S) @ innovation
    return mean, reset @ (np.eye(len(P)) - K @ H) @ P @ reset.T, log_likelihood, nis


def assert_trees_close(one, two, **tolerances):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, **tolerances)


@pytest.mark.parametrize("m", [1, pytest.param(2, marks=pytest.mark.as_users), 3])
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
        S = rows @ P @ rows.T + block_diagonal(R[mask[t]])
        innovation, K = z - rows @ x, P @ rows.T @ np.linalg.inv(S)
        log_likelihood = -(innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
        np.testing.assert_allclose(diagnostics.nis[t], innovation @ np.linalg.solve(S, innovation), atol=1e-11)
        np.testing.assert_allclose(diagnostics.log_likelihood[t], log_likelihood, atol=1e-11)
        assert diagnostics.used[t] == mask[t].sum()
        x, P = x + K @ innovation, P - K @ S @ K.T
        np.testing.assert_allclose(beliefs.mean[t], x, atol=1e-11)
        np.testing.assert_allclose(beliefs.covariance[t], P, atol=1e-11)
        after = observed[t] - H @ x
        distance = np.einsum("ni,nij,nj->n", after, np.linalg.inv(R), after)
        np.testing.assert_allclose(diagnostics.distance[t], np.where(mask[t], distance, 0), atol=1e-10)


@pytest.mark.parametrize("passes", [1, 4])
def test_update_equals_the_dense_iterated_filter(passes):
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    seen = np.flatnonzero(mask[0])
    expected = dense_update(model, belief, np.asarray(landmarks)[seen], np.asarray(observed)[0][seen], passes)
    posterior, diagnostics = update(model, belief, landmarks, observed[0], mask[0], passes=passes)
    np.testing.assert_allclose(local(model, expected[0], posterior.mean), 0, atol=1e-8)
    np.testing.assert_allclose(posterior.covariance, expected[1], rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(diagnostics.log_likelihood, expected[2], rtol=1e-7)
    np.testing.assert_allclose(diagnostics.nis, expected[3], rtol=1e-6)


def test_a_blank_frame_with_noise_scales_has_a_gradient_of_zero():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()

    def loss(sigma, mask):
        told = eqx.tree_at(lambda m: m.sigma, model, sigma)
        says = update(told, belief, landmarks, observed[0], mask, noise_scale=jnp.full(mask.shape, 2.0))
        return says[1].log_likelihood + jnp.trace(says[0].covariance)

    slope = jax.jit(jax.grad(loss))
    assert slope(model.sigma, jnp.asarray(mask[0])) != 0
    assert slope(model.sigma, jnp.zeros(mask[0].shape, bool)) == 0


@pytest.mark.parametrize("m", [1, 2])
def test_noise_scales_and_the_likelihood_after_robust_weights(m):
    """A scaled noise is another noise; every item that is used counts in full, about the robust estimate."""
    rng = np.random.default_rng(m)
    A, H = rng.standard_normal((4, 4)), rng.standard_normal((20, m, 4))
    R, scale = np.tile(0.2 * np.eye(m), (20, 1, 1)), rng.uniform(0.5, 2, 20)
    observed, mask = H @ rng.standard_normal(4) + 0.3 * rng.standard_normal((20, m)), np.arange(20) > 0
    observed[1:4] += 30
    belief = ekf.Belief(jnp.zeros(4), jnp.asarray(A @ A.T))
    model, robust = Linear(jnp.eye(4), jnp.eye(4)), ekf.Robust()
    scaled = R * scale[:, None, None] ** 2
    seen = jnp.asarray(observed), jnp.asarray(mask)
    junk = jnp.where(mask, scale, jnp.nan)
    items, other = ({"H": jnp.asarray(H), "R": jnp.asarray(r)} for r in (R, scaled))
    found, says = update(model, belief, items, *seen, passes=9, robust=robust, noise_scale=junk)
    expected, told = update(model, belief, other, *seen, passes=9, robust=robust)
    assert_trees_close((found, says), (expected, told), rtol=1e-9, atol=1e-12)

    used, P = np.asarray(says.weights) > 0, np.asarray(belief.covariance)
    assert (int(says.measured), int(says.used)) == (19, used.sum())
    assert 3 < used[4:].sum() == used.sum()
    e, after = np.asarray(found.mean), observed - H @ np.asarray(found.mean)
    nis = e @ np.linalg.solve(P, e) + np.einsum("ni,nij,nj->n", after, np.linalg.inv(scaled), after)[used].sum()
    np.testing.assert_allclose(says.nis, nis, rtol=1e-9)
    weighted = np.einsum("n,nia,nij,njb->ab", says.weights, H, np.linalg.inv(scaled), H)
    log_det = np.linalg.slogdet(np.eye(4) + P @ weighted)[1] + np.linalg.slogdet(2 * np.pi * scaled[used])[1].sum()
    np.testing.assert_allclose(says.log_likelihood, -(nis + log_det) / 2, rtol=1e-9)


class PartlyConsidered(Linear):
    considered = np.array([False, True, False, True])


def test_considered_components_are_counted_and_not_corrected():
    """Schmidt's filter in its textbook form: rows of the gain are struck out, Joseph's form does the rest."""
    rng = np.random.default_rng(0)
    A, H = rng.standard_normal((4, 4)), rng.standard_normal((6, 2, 4))
    R = np.tile(np.array([[0.5, 0.1], [0.1, 0.3]]), (6, 1, 1))
    belief = ekf.Belief(jnp.asarray(rng.standard_normal(4)), jnp.asarray(A @ A.T))
    observed, items = rng.standard_normal((6, 2)), {"H": jnp.asarray(H), "R": jnp.asarray(R)}
    arguments = belief, items, jnp.asarray(observed), jnp.ones(6, bool)
    models = [kind(jnp.eye(4), jnp.eye(4)) for kind in (PartlyConsidered, Linear)]
    (found, told), (_, plain) = (update(m, *arguments, passes=3) for m in models)

    P, G = np.asarray(belief.covariance), H.reshape(12, 4)
    D = block_diagonal(R)
    K = P @ G.T @ np.linalg.inv(G @ P @ G.T + D)
    K[PartlyConsidered.considered] = 0
    keep = np.eye(4) - K @ G
    np.testing.assert_allclose(found.covariance, keep @ P @ keep.T + K @ D @ K.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.mean, belief.mean + K @ (observed.ravel() - G @ belief.mean), rtol=1e-9)
    # What the innovations say is the same whoever is corrected.
    np.testing.assert_allclose(told.log_likelihood, plain.log_likelihood, rtol=1e-9)
    np.testing.assert_allclose(told.nis, plain.nis, rtol=1e-9)


@pytest.mark.parametrize("kind", [Linear, PartlyConsidered])
def test_smoothed_covariances_are_those_of_the_errors(kind):
    """Exactly: a linear smoother's error is a linear function of all that is drawn."""
    rng, d, n, frames = np.random.default_rng(4), 4, 3, 5
    static = np.array([False, True, False, True])
    F, A, B = (rng.normal(size=(d, d)) for _ in range(3))
    F, A = np.where(static[:, None], 0, 0.3 * F), np.where(static[:, None], 0, A)
    B[2] = 0  # one component is known at the start
    H, C = rng.normal(size=(n, 2, d)), 0.5 * rng.normal(size=(n, 2, 2))
    mask, dt = rng.uniform(size=(frames, n)) > 0.3, rng.uniform(0.5, 2, frames)
    model, items = kind(jnp.asarray(F), jnp.asarray(A @ A.T)), {"H": jnp.asarray(H), "R": jnp.asarray(C @ C.mT)}

    def draw(w):
        first, accelerations, noises = jnp.split(w, [d, d + d * frames])
        x, states = B @ first, []
        for k, a in enumerate(accelerations.reshape(frames, d)):
            x = x + dt[k] * F @ x + np.sqrt(dt[k]) * A @ a
            states.append(x)
        states = jnp.stack(states)
        noises = noises.reshape(frames, n, 2)
        return states, jnp.einsum("nij,tj->tni", H, states) + jnp.einsum("nij,tnj->tni", C, noises)

    def run(w):
        (states, observed), times = draw(w), jnp.asarray(dt)
        belief = ekf.Belief(jnp.zeros(d), jnp.asarray(B @ B.T))
        filtered, _ = ekf.filter(model, belief, items, observed, jnp.asarray(mask), times, passes=1)
        smoothed = ekf.smooth(model, filtered, times)
        return (smoothed.mean - states, observed), (smoothed, filtered)

    (J, seen), (smoothed, filtered) = jax.jit(jax.jacfwd(run, has_aux=True))(jnp.zeros(d + frames * (d + 2 * n)))
    np.testing.assert_allclose(smoothed.covariance, J @ J.mT, atol=1e-9)
    np.testing.assert_array_equal(smoothed.covariance[-1], filtered.covariance[-1])
    if kind is Linear:
        less = np.linalg.eigvalsh(filtered.covariance - smoothed.covariance)
        assert less.min() > -1e-9
        assert (less.max(axis=1)[:-1] > 1e-3).all()
        # The best there is: nothing is left in common with what was seen.
        np.testing.assert_allclose(np.einsum("tiw,snjw->snjti", J, seen)[mask], 0, atol=1e-9)


def test_smoothing_a_rotating_camera():
    """Closer to the truth than the filter, and by as much as it says."""
    model, belief = sextant()
    landmarks, observed, mask, states = sextant_frames()
    filtered, _ = filter_(model, belief, landmarks, observed, mask, passes=4)
    smoothed = jax.jit(ekf.smooth)(model, filtered)

    def nees_and_square(beliefs):
        error = jax.vmap(model.local)(beliefs.mean, states)
        return jnp.einsum("ti,tij,tj->t", error, jnp.linalg.inv(beliefs.covariance), error), jnp.sum(error**2, axis=1)

    (nees, square), (_, before) = (jax.jit(nees_and_square)(x) for x in (smoothed, filtered))
    # Errors are forgotten within three frames: that is the correlation time of the NEES over these 200.
    low, high = nees_interval(6, nees.size / 3)
    assert low < nees.mean() < high
    assert square.mean() < 0.75 * before.mean()


def test_prediction_equals_the_dense_one():
    model, belief = sextant()
    dt = jnp.asarray(1.5)
    predicted = jax.jit(ekf.predict)(model, belief, dt)
    move = jax.jit(lambda mean: model.predict(mean, dt))
    mean = move(belief.mean)
    F = central(lambda e: local(model, mean, move(retract(model, belief.mean, e))), np.zeros(6))
    np.testing.assert_allclose(local(model, mean, predicted.mean), 0, atol=1e-14)
    expected = F @ belief.covariance @ F.T + model.process_noise(mean, dt)
    np.testing.assert_allclose(predicted.covariance, expected, atol=1e-9)
    np.testing.assert_allclose(jax.jit(transition)(model, belief.mean, dt), F, atol=1e-8)


def test_an_update_that_overflows_is_not_taken():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    mask = mask[0].at[0].set(True)
    z = observed[0].at[0].set(1e200)  # its square is infinite
    after, says = update(model, belief, landmarks, z, mask)
    jax.tree.map(np.testing.assert_array_equal, after, belief)
    assert (int(says.used), float(says.log_likelihood), float(says.nis)) == (0, -np.inf, 0)
    assert not np.any(says.weights)
    assert not np.any(says.distance)


@jax.jit
def log_likelihood(model, belief, items, observed, mask):
    mask = jnp.broadcast_to(mask, observed.shape[:2])
    diagnostics = ekf.filter(model, belief, items, observed, mask, passes=4, robust=ROBUST)[1]
    return jnp.sum(diagnostics.log_likelihood)


# Over a batch of models, items and measurements.
gradient = jax.jit(jax.vmap(jax.grad(log_likelihood, argnums=(0, 1, 2, 3)), (0, None, 0, 0, None)))


def test_masked_item_is_an_absent_item_in_values_and_gradients():
    # At the origin, where the belief stands, the distance to a beacon of zeros has no derivative.
    model, belief, beacons, observed, seen = ranger()
    junk = np.array([0.0, np.nan, np.inf, 1e30])
    beacons, observed, seen = map(np.asarray, (beacons, observed, seen))
    absent = log_likelihood(model, belief, beacons[seen], observed[:, seen], np.ones(6, bool))
    filled = (
        np.where(seen[:, None], beacons, junk[:, None, None]),
        np.where(seen[:, None], observed, junk[:, None, None, None]),
    )
    for one in zip(*filled, strict=True):
        np.testing.assert_allclose(log_likelihood(model, belief, *one, seen), absent, rtol=1e-12)
    models = jax.tree.map(lambda x: jnp.broadcast_to(x, (4, *x.shape)), model)
    slopes = jax.tree.map(np.asarray, gradient(models, belief, *filled, seen))
    for leaf in jax.tree.leaves(slopes):
        np.testing.assert_allclose(leaf, np.broadcast_to(leaf[:1], leaf.shape), rtol=1e-12)
    assert not np.any(slopes[2][:, ~seen])
    assert not np.any(slopes[3][:, :, ~seen])
    assert np.all(slopes[3][:, :, seen] != 0)


def test_gradients_through_the_filter_equal_central_differences():
    _, belief, beacons, observed, seen = ranger()
    theta = np.array([[0.03, 0.1], [0.05, 0.2], [0.07, 0.05], [0.1, 0.1]])
    repeated = (np.broadcast_to(x, (4, *x.shape)) for x in (beacons, observed))
    models = Ranger(*map(jnp.asarray, theta.T))
    slopes = jax.tree.map(np.asarray, gradient(models, belief, *repeated, seen))

    def value(theta, mean):
        model = Ranger(*map(jnp.asarray, theta))
        return log_likelihood(model, ekf.Belief(jnp.asarray(mean), belief.covariance), beacons, observed, seen)

    for i in range(4):
        by_model = central(lambda x: value(x, np.zeros(4)), theta[i])
        np.testing.assert_allclose(slopes[0].sigma[i], by_model[0], rtol=1e-6)
        np.testing.assert_allclose(slopes[0].acceleration[i], by_model[1], rtol=1e-6)
        by_mean = central(lambda x, i=i: value(theta[i], x), np.zeros(4))
        np.testing.assert_allclose(slopes[1].mean[i], by_mean, rtol=1e-5)


def test_order_of_items_changes_nothing():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    landmarks, observed, mask = map(np.asarray, (landmarks, observed, mask))
    order = np.random.default_rng(1).permutation(N)
    one = update(model, belief, landmarks, observed[0], mask[0], passes=9, robust=ROBUST)
    two = update(model, belief, landmarks[order], observed[0][order], mask[0][order], passes=9, robust=ROBUST)
    assert_trees_close(one[0], two[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one[1].log_likelihood, two[1].log_likelihood, rtol=1e-9)
    np.testing.assert_allclose(one[1].weights[order], two[1].weights, rtol=1e-7)
    np.testing.assert_allclose(one[1].distance[order], two[1].distance, rtol=1e-7)


def test_pinned_direction_stays_pinned():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    # The leaves stand in the order of their keys: R, then T.
    direction = np.array([0, 0, 0, 1.0, 2.0, -1.0]) / np.sqrt(6)
    project = np.eye(6) - np.outer(direction, direction)
    pinned = ekf.Belief(belief.mean, project @ belief.covariance @ project)
    posterior, diagnostics = update(model, pinned, landmarks, observed[0], mask[0], passes=4)
    moved = local(model, belief.mean, posterior.mean)
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved @ direction, 0, atol=1e-12)
    np.testing.assert_allclose(posterior.covariance @ direction, 0, atol=1e-14)
    assert np.linalg.eigvalsh(posterior.covariance)[1] > 1e-7
    assert np.isfinite(diagnostics.log_likelihood)


def test_gross_outliers_are_rejected_and_the_clean_answer_returns():
    model, belief = sextant()
    landmarks, observed, _, states = sextant_frames()
    bad = np.arange(N) % 4 == 0
    shift = np.random.default_rng(0).uniform(0.2, 0.6, (N, 2)) * np.where(np.arange(N)[:, None] % 8, 1, -1)
    broken = observed[0] + np.where(bad[:, None], shift, 0)
    run = partial(update, model, belief, landmarks)
    clean, _ = run(observed[0], jnp.asarray(~bad), passes=4)
    plain, _ = run(broken, jnp.ones(N, bool), passes=4)
    robust, diagnostics = run(broken, jnp.ones(N, bool), passes=9, robust=ROBUST)
    sd = np.sqrt(np.diag(clean.covariance))
    assert np.max(np.abs(local(model, clean.mean, plain.mean)) / sd) > 5
    assert np.max(np.abs(local(model, clean.mean, robust.mean)) / sd) < 1
    truth = jax.tree.map(lambda x: x[0], states)
    assert np.max(np.abs(local(model, truth, robust.mean)) / sd) < 4
    weights = np.asarray(diagnostics.weights)
    assert not weights[bad].any()
    assert (diagnostics.distance[bad] > 100).all()
    assert np.median(weights[~bad]) > 0.6
    assert diagnostics.used == np.sum(weights > 0) >= N - bad.sum() - 2
    np.testing.assert_allclose(np.sqrt(np.diag(robust.covariance)), sd, rtol=0.3)


def test_a_large_scale_makes_the_robust_update_the_plain_one():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    large = ekf.Robust(*(jnp.asarray(x) for x in (1e14, 1e14, jnp.inf)))
    one = update(model, belief, landmarks, observed[0], mask[0], passes=9, robust=large)
    two = update(model, belief, landmarks, observed[0], mask[0], passes=9)
    assert_trees_close(one, two, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one[1].weights, mask[0], rtol=1e-10)


def test_filter_is_a_loop_of_step():
    model, belief = sextant()
    landmarks, observed, mask, _ = sextant_frames()
    dt = jnp.array([1.0, 0.5, 1.0, 2.0])
    beliefs, diagnostics = filter_(model, belief, landmarks, observed[:4], mask[:4], dt, passes=4)
    predict = jax.jit(ekf.predict)
    observed, mask = np.asarray(observed), np.asarray(mask)
    beliefs, diagnostics = jax.tree.map(np.asarray, (beliefs, diagnostics))
    for t in range(4):
        predicted = predict(model, belief, dt[t])
        belief, report = update(model, predicted, landmarks, observed[t], mask[t], passes=4)
        here = jax.tree.map(lambda x, t=t: x[t], (beliefs, diagnostics))
        assert_trees_close(here, (belief, report), rtol=1e-9, atol=1e-11)


def test_float32_stays_float32_and_positive_over_a_long_run():
    single = partial(jax.tree.map, lambda x: x.astype(jnp.float32))
    landmarks, observed, mask, states = sextant_frames()
    model, belief = sextant(jnp.float32)
    arguments = model, belief, single(landmarks), single(observed), mask
    beliefs, diagnostics = filter_(*arguments, passes=9, robust=ROBUST)
    for leaf in jax.tree.leaves((beliefs, eqx.filter(diagnostics, eqx.is_inexact_array))):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()
    P = np.asarray(beliefs.covariance, np.float64)
    asymmetry = np.abs(P - P.swapaxes(1, 2)).max(axis=(1, 2))
    assert (asymmetry < 1e-6 * np.abs(P).max(axis=(1, 2))).all()
    assert (np.linalg.eigvalsh((P + P.swapaxes(1, 2)) / 2)[:, 0] > 0).all()
    errors = jax.jit(jax.vmap(lambda a, b: model.local(a, b)))(beliefs.mean, single(states))
    nees = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(P), errors)
    low, high = nees_interval(6, nees.size / 3)  # as in `test_smoothing_a_rotating_camera`
    assert low < nees.mean() < high


def wrapped(angle):
    """An angle from -pi to pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class RawBearing(Linear):
    """Position and velocity in the plane; an item is where a bearing, and a distance with it, are measured from."""

    sigma: Float[Array, "2"]  # of distance and bearing

    def measure(self, mean, item):
        x, y = mean[:2] - item
        return jnp.stack([jnp.hypot(x, y), jnp.arctan2(y, x)])

    def noise(self, mean, item):
        return jnp.diag(self.sigma**2)


class Bearing(RawBearing):
    def residual(self, observed, predicted):
        error = observed - predicted
        return error.at[1].set(wrapped(error[1]))


def around(frames=40):
    """A model of each kind, a belief, where is measured from, and what is seen of a target that goes around it once."""
    angle = np.linspace(0, 2 * np.pi, frames)
    truth = 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    items = np.array([[0.0, 0.0], [0.3, -0.2], [-0.4, 0.1]])
    seen = truth[:, None] - items
    observed = np.stack([np.hypot(*seen.T).T, np.arctan2(*seen.T[::-1]).T], axis=-1)
    sigma = np.array([0.05, 0.03])
    observed = observed + sigma * np.random.default_rng(0).normal(size=observed.shape)
    observed[..., 1] = wrapped(observed[..., 1])
    F, Q = np.eye(4, k=2), np.diag([0.01, 0.01, 0.05, 0.05]) ** 2
    models = [kind(jnp.asarray(F), jnp.asarray(Q), jnp.asarray(sigma)) for kind in (Bearing, RawBearing)]
    belief = ekf.Belief(jnp.asarray([*truth[0], 0.0, 0.3]), jnp.eye(4) * 0.1)
    return models, belief, jnp.asarray(items), jnp.asarray(observed), truth


def bearing_update(belief, items, observed, sigma, passes):
    """The textbook's iterated filter, item below item, numerical Jacobians of residuals that are wrapped by hand."""
    prior, P = np.asarray(belief.mean), np.asarray(belief.covariance)

    def residual(x):
        seen = x[:2] - items
        error = observed - np.stack([np.hypot(*seen.T), np.arctan2(*seen.T[::-1])], axis=-1)
        return np.stack([error[:, 0], wrapped(error[:, 1])], axis=-1).ravel()

    x, R = prior, np.diag(np.tile(sigma**2, len(items)))
    for _ in range(passes):
        H = -central(residual, x)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        innovation = residual(x) + H @ (x - prior)
        x = prior + K @ innovation
    return x, (np.eye(4) - K @ H) @ P, multivariate_normal(np.zeros(len(R)), H @ P @ H.T + R).logpdf(innovation)


@pytest.mark.parametrize("passes", [1, 4])
def test_a_wrapped_residual_equals_the_dense_filter(passes):
    (model, _), belief, items, observed, truth = around()
    k = 19  # just before the bearing jumps from pi to -pi: predicted on one side, seen on the other
    near = ekf.Belief(jnp.asarray([*truth[k], 0.0, -0.3]), belief.covariance)
    assert np.abs(observed[k + 1, :, 1] - measure(model, near.mean, items)[:, 1]).max() > 6
    found, says = update(model, near, items, observed[k + 1], jnp.ones(3, bool), passes=passes)
    arrays = (np.asarray(a) for a in (items, observed[k + 1], model.sigma))
    x, P, log_likelihood = bearing_update(near, *arrays, passes)
    np.testing.assert_allclose(found.mean, x, atol=1e-8)
    np.testing.assert_allclose(found.covariance, P, atol=1e-8)
    np.testing.assert_allclose(says.log_likelihood, log_likelihood, rtol=1e-6)


def test_a_bearing_is_followed_through_pi_where_a_plain_difference_is_not():
    models, belief, items, observed, truth = around(
        200
    )  # so slow that the noise takes a bearing across pi where the prediction is not
    seen = jnp.ones(observed.shape[:2], bool)
    # In one pass: more of them may find the way around to where the raw bearing fits again.
    right, wrong = (filter_(m, belief, items, observed, seen, passes=1)[0].mean[:, :2] - truth for m in models)
    assert np.abs(right).max() < 0.15
    assert np.abs(wrong).max() > 1


def test_a_residual_may_be_robust_masked_and_differentiated():
    """What is masked changes nothing, NaN included; outliers are left out; the gradient is that of differences."""
    (model, _), belief, items, observed, truth = around()
    rng = np.random.default_rng(1)
    mask, wild = rng.random(observed.shape[:2]) < 0.8, np.zeros(observed.shape[:2], bool)
    mask[2::4], wild[2::4, 1] = True, True  # one of three, all of them seen
    mask, observed = jnp.asarray(mask), observed + jnp.asarray(wild)[..., None] * jnp.array([3.0, 2.0])

    def run(observed):
        return filter_(model, belief, items, observed, mask, passes=9, robust=ROBUST)

    beliefs, said = run(observed)
    assert np.abs(beliefs.mean[:, :2] - truth).max() < 0.2
    assert not said.weights[wild].any()
    for junk in (jnp.nan, jnp.inf, 1e30):
        assert_trees_close(run(jnp.where(mask[..., None], observed, junk)), (beliefs, said), rtol=1e-12)

    def loss(sigma, observed):
        told = eqx.tree_at(lambda m: m.sigma, model, sigma)
        said = ekf.filter(told, belief, items, observed, mask, passes=9, robust=ROBUST)[1]
        return jnp.sum(said.log_likelihood)

    dirty = jnp.where(mask[..., None], observed, jnp.nan)
    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    _, (by_sigma, by_observed) = both(model.sigma, dirty)
    differences = central(lambda x: both(x, dirty)[0], np.asarray(model.sigma))
    np.testing.assert_allclose(by_sigma, differences, rtol=1e-4)
    assert np.isfinite(by_observed).all()
    assert not by_observed[~mask].any()
