from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxtri.filters import ekf, schmidt
from jaxtri.filters.schmidt import Measured

N, D, P = 7, 4, 3

update = jax.jit(schmidt.update, static_argnames="passes")


class Linear(eqx.Module):
    """y_i = H_i x + B_i m_i + v; the items are (H, B, Q)."""

    sigma: Float[Array, ""]
    F: Float[Array, "d d"]

    def retract(self, mean, delta):
        return mean + delta

    def local(self, mean, other):
        return other - mean

    def predict(self, mean, dt):
        return self.F @ mean

    def process_noise(self, mean, dt):
        return 0.01 * jnp.eye(D, dtype=mean.dtype)

    def measured(self, mean, items, moved):
        H, B, _ = items
        return Measured(H @ mean + jnp.einsum("nmp,np->nm", B, moved), H, B)

    def item_noise(self, mean, items):
        return items[2]


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(N, P, P))
    items = (rng.normal(size=(N, 2, D)), rng.normal(size=(N, 2, P)), root @ np.swapaxes(root, 1, 2))
    model = Linear(jnp.asarray(0.3), jnp.asarray(np.eye(D) + 0.1 * rng.normal(size=(D, D))))
    belief = schmidt.ConsiderBelief(
        jnp.asarray(rng.normal(size=D)), jnp.diag(jnp.arange(1.0, D + 1)), jnp.zeros((D, N, P))
    )
    observed, mask = rng.normal(size=(5, N, 2)), rng.random((5, N)) < 0.8
    return model, belief, jax.tree.map(jnp.asarray, items), jnp.asarray(observed), jnp.asarray(mask)


class Textbook:
    """Schmidt's filter with the whole covariance of state and items (Bar-Shalom et al. 2001, section 8.2.4)."""

    def __init__(self, model, belief, items):
        self.F, self.sigma = np.asarray(model.F), float(model.sigma)
        self.items, self.mean = [np.asarray(x) for x in items], np.asarray(belief.mean)
        self.P = np.zeros((D + N * P, D + N * P))
        self.P[:D, :D] = belief.own
        for i in range(N):
            at = D + P * i
            self.P[at : at + P, at : at + P] = self.items[2][i]

    def step(self, z, mask):
        F = np.eye(len(self.P))
        F[:D, :D] = self.F
        self.mean = F[:D, :D] @ self.mean
        self.P = F @ self.P @ F.T
        self.P[:D, :D] += 0.01 * np.eye(D)
        H, B, _ = self.items
        G = np.zeros((2 * N, len(self.P)))
        for i in range(N):
            G[2 * i : 2 * i + 2, :D] = H[i]
            G[2 * i : 2 * i + 2, D + P * i : D + P * (i + 1)] = B[i]
        G, r = G[np.repeat(mask, 2)], (np.asarray(z) - H @ self.mean).reshape(-1)[np.repeat(mask, 2)]
        S = G @ self.P @ G.T + self.sigma**2 * np.eye(len(G))
        K = self.P @ G.T @ np.linalg.inv(S)
        K[D:] = 0
        self.mean = self.mean + K[:D] @ r
        keep = np.eye(len(self.P)) - K @ G
        self.P = keep @ self.P @ keep.T + self.sigma**2 * K @ K.T
        _, log_det = np.linalg.slogdet(2 * np.pi * S)
        return -(r @ np.linalg.solve(S, r) + log_det) / 2, r @ np.linalg.solve(S, r)


@pytest.mark.parametrize("passes", [1, pytest.param(3, marks=pytest.mark.as_users)])
def test_equals_the_textbook_filter(problem, passes):
    model, belief, items, observed, mask = problem
    beliefs, diagnostics = jax.jit(partial(schmidt.filter, passes=passes))(model, belief, items, observed, mask)
    twin = Textbook(model, belief, items)
    for t in range(len(observed)):
        log_likelihood, nis = twin.step(observed[t], np.asarray(mask[t]))
        np.testing.assert_allclose(beliefs.mean[t], twin.mean, atol=1e-10)
        np.testing.assert_allclose(beliefs.covariance[t], twin.P[:D, :D], atol=1e-10)
        np.testing.assert_allclose(diagnostics.log_likelihood[t], log_likelihood, rtol=1e-10)
        np.testing.assert_allclose(diagnostics.nis[t], nis, rtol=1e-9)


def test_one_frame_equals_the_plain_filter(problem):
    """Nothing is shared yet, so considered noise is noise."""
    model, belief, (H, B, Q), observed, mask = problem
    ours, ours_says, _ = update(model, belief, (H, B, Q), observed[0], mask[0])

    class Plain(Linear):
        def measure(self, mean, item):
            return item[0] @ mean

        def noise(self, mean, item):
            return item[1] @ item[2] @ item[1].T + self.sigma**2 * jnp.eye(2)

    plain = ekf.Belief(belief.mean, belief.own)
    theirs, theirs_say = jax.jit(ekf.update)(Plain(model.sigma, model.F), plain, (H, B, Q), observed[0], mask[0])
    np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-10)
    np.testing.assert_allclose(ours.covariance(Q), theirs.covariance, atol=1e-10)
    np.testing.assert_allclose(ours_says.log_likelihood, theirs_say.log_likelihood, rtol=1e-10)
    np.testing.assert_allclose(ours_says.distance, theirs_say.distance, atol=1e-10)


def test_absorbed_measurements_are_counted_once(problem):
    """After an absorption the error of an item is the least-squares one, with the right correlation."""
    model, belief, items, observed, mask = problem
    H, B, Q = (np.asarray(x) for x in items)
    before, _, _ = update(model, belief, items, observed[0], mask[0])
    after, _, said = update(model, before, items, observed[1], mask[1], absorb=mask[1])
    plain, _, _ = update(model, before, items, observed[1], mask[1])
    np.testing.assert_allclose(after.mean, plain.mean, atol=1e-12)
    gain = np.asarray(said.gain)
    keep = np.eye(P) - gain @ B
    left = keep @ Q @ np.swapaxes(keep, 1, 2) + model.sigma**2 * gain @ np.swapaxes(gain, 1, 2)
    seen = np.asarray(mask[1])
    noise = np.where(seen[:, None, None], left, Q)
    # The state's own error is what it was, whoever is said to owe it.
    np.testing.assert_allclose(after.covariance(jnp.asarray(noise)), plain.covariance(items[2]), atol=1e-10)
    # Cov(state, item after) from the noises themselves: items m and the frame's v, by sampling no one.
    twin = Textbook(model, before, items)
    twin.P[:D, :D] = before.covariance(items[2])
    for i in range(N):
        cross = np.asarray(before.sensitivity[:, i]) @ Q[i]
        twin.P[:D, D + P * i : D + P * (i + 1)], twin.P[D + P * i : D + P * (i + 1), :D] = cross, cross.T
    G = np.zeros((2 * N, D + N * P))
    for i in np.flatnonzero(seen):
        G[2 * i : 2 * i + 2, :D] = H[i]
        G[2 * i : 2 * i + 2, D + P * i : D + P * (i + 1)] = B[i]
    S = G @ twin.P @ G.T + model.sigma**2 * np.eye(2 * N)
    K = (twin.P @ G.T @ np.linalg.inv(S))[:D].reshape(D, N, 2)
    for i in np.flatnonzero(seen):
        # delta+ = (1 - K G) delta - K v, and m+ = (1 - k B) m - k v.
        of_m = (twin.P[:D] - K.reshape(D, -1) @ G @ twin.P)[:, D + P * i : D + P * (i + 1)]
        cross = of_m @ keep[i].T + model.sigma**2 * K[:, i] @ gain[i].T
        np.testing.assert_allclose(after.sensitivity[:, i] @ left[i], cross, atol=1e-10)


def test_what_is_masked_changes_nothing(problem):
    model, belief, items, observed, mask = problem
    dirty = jnp.where(mask[0][:, None], observed[0], jnp.nan)
    wild = tuple(jnp.where(mask[0].reshape(-1, *[1] * (x.ndim - 1)), x, 1e30) for x in items[:2])

    def loss(sigma, z, H, B):
        moved, says, _ = schmidt.update(
            eqx.tree_at(lambda m: m.sigma, model, sigma), belief, (H, B, items[2]), z, mask[0]
        )
        return says.log_likelihood + jnp.sum(moved.mean) + jnp.sum(moved.sensitivity**2)

    both = jax.jit(jax.value_and_grad(loss))
    value, slope = both(model.sigma, observed[0], *items[:2])
    dirty_value, dirty_slope = both(model.sigma, dirty, *wild)
    np.testing.assert_allclose(dirty_value, value, rtol=1e-12)
    np.testing.assert_allclose(dirty_slope, slope, rtol=1e-10)
    step = 1e-6
    up, down = (both(model.sigma + s, observed[0], *items[:2])[0] for s in (step, -step))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-6)


def test_float32_covariances_stay_positive(problem):
    """The noise of the items is met a thousand times; the textbook form loses definiteness."""
    single = jax.tree.map(lambda x: x.astype(jnp.float32), problem[:3])
    single = (eqx.tree_at(lambda m: m.F, single[0], 0.999 * jnp.eye(D, dtype=jnp.float32)), *single[1:3])
    z = jnp.zeros((1000, N, 2), jnp.float32)
    beliefs, _ = jax.jit(partial(schmidt.filter, passes=1))(*single, z, jnp.ones((1000, N), bool))
    assert beliefs.covariance.dtype == jnp.float32
    assert np.linalg.eigvalsh(np.asarray(beliefs.covariance, np.float64)).min() > 0


def test_an_update_that_overflows_is_not_taken(problem):
    model, belief, items, observed, mask = problem
    seen = mask[0].at[0].set(True)
    after, says, of_items = update(model, belief, items, observed[0].at[0].set(1e200), seen, absorb=seen)
    jax.tree.map(np.testing.assert_array_equal, after, belief)
    assert (int(says.used), float(says.log_likelihood)) == (0, -np.inf)
    assert not any(np.any(x) for x in jax.tree.leaves(of_items))


def test_outliers_lose_their_weight(problem):
    model, belief, (H, B, _), *_ = problem
    truth = belief.mean + 0.5
    z = H @ truth
    z = z.at[2].add(100.0)
    small = (H, B, 1e-2 * jnp.broadcast_to(jnp.eye(P), (N, P, P)))
    everything = jnp.ones(N, bool)
    found, says, _ = jax.jit(partial(schmidt.update, passes=9))(
        model, belief, small, z, everything, robust=ekf.Robust(), absorb=everything
    )
    assert not says.weights[2]
    assert says.used == N - 1
    assert says.distance[2] > 100
    np.testing.assert_allclose(found.mean, truth, atol=0.2)
