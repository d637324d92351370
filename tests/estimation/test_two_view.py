from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from intervals import nees_interval
from jaxlie import SO3

from jaxtri.estimation.two_view import refine
from jaxtri.geometry.epipolar import essential, sampson

N, SIGMA = 40, 1e-3
R = SO3.exp(jnp.array([0.1, -0.05, 0.08]))
T = np.array([0.3, 0.1, -0.2])
EVERYTHING = jnp.ones(N, bool)

plain = jax.jit(partial(refine, sigma=SIGMA))
with_prior = jax.jit(lambda T, R, u1, u2, mask, prior: refine(T, R, u1, u2, mask, SIGMA, prior=prior))


def exact_pairs():
    rng = np.random.default_rng(0)
    X = np.concatenate([rng.uniform(-1, 1, (N, 2)), rng.uniform(2, 5, (N, 1))], 1)
    Y = X @ np.asarray(R.as_matrix()).T + T
    return X[:, :2] / X[:, 2:], Y[:, :2] / Y[:, 2:]


U1, U2 = exact_pairs()
# Four degrees and ten off, at the same length.
R0 = SO3.exp(jnp.array([0.05, 0.04, -0.03])) @ R
T0 = T + np.array([0.03, -0.05, 0.03])
T0 = jnp.asarray(T0 * np.linalg.norm(T) / np.linalg.norm(T0))


def noisy(seed, sigma=SIGMA):
    noise = np.random.default_rng(seed).normal(0, sigma, (2, N, 2))
    return jnp.asarray(U1 + noise[0]), jnp.asarray(U2 + noise[1])


def tangent():
    """Two orthonormal directions beside the base line, by a singular value decomposition."""
    return np.linalg.svd(T[None])[2][1:].T


def error(two_view):
    """The five free errors: of T beside the base line, and of R."""
    turn = (R @ two_view.rotation.inverse()).log()
    return np.concatenate([tangent().T @ (T - two_view.translation), turn])


def free(covariance):
    lift = np.zeros((5, 6))
    lift[:2, :3], lift[2:, 3:] = tangent().T, np.eye(3)
    return lift @ covariance @ lift.T


@jax.jit
def distances(x, u1, u2):
    """In units of sigma, of the pose that has the errors x; the length is kept."""
    moved = jnp.asarray(T) + jnp.asarray(tangent()) @ x[:2]
    moved = moved * (np.linalg.norm(T) / jnp.linalg.norm(moved))
    E = essential((SO3.exp(x[2:]) @ R).as_matrix(), moved)
    return jax.vmap(sampson, (None, 0, 0))(E, u1, u2) / SIGMA


def dense_step(x, u1, u2, information):
    """The slow twin: a step of the normal equations with numerical slopes, in coordinates of its own."""
    slopes = [distances(x + h, u1, u2) - distances(x - h, u1, u2) for h in 1e-6 * np.eye(5)]
    J = np.stack(slopes, -1) / 2e-6
    covariance = np.linalg.inv(J.T @ J + information)
    return x - covariance @ (J.T @ distances(x, u1, u2) + information @ x), covariance


@pytest.mark.parametrize("function", [plain, partial(with_prior, prior=1e9 * jnp.eye(6))])
def test_exact_data_give_the_exact_pose(function):
    two_view = function(T0, R0, jnp.asarray(U1), jnp.asarray(U2), EVERYTHING)
    assert two_view.converged
    np.testing.assert_allclose(two_view.translation, T, atol=1e-9)
    np.testing.assert_allclose(two_view.rotation.as_matrix(), R.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(two_view.rms, 0, atol=1e-6)
    # The length is the gauge: kept, and without uncertainty.
    np.testing.assert_allclose(np.linalg.norm(two_view.translation), np.linalg.norm(T0), rtol=1e-12)
    C = two_view.covariance
    np.testing.assert_allclose(C[:, :3] @ T, 0, atol=1e-9 * np.abs(C).max())


def test_covariance_is_that_of_the_errors():
    found = [plain(jnp.asarray(T), R, *noisy(seed), EVERYTHING) for seed in range(200)]
    errors = np.array([error(two_view) for two_view in found])
    nees = [e @ np.linalg.solve(free(t.covariance), e) for e, t in zip(errors, found, strict=True)]
    # Beyond two sigmas the Huber loss counts less than the data are worth, but that is 1 % of the variance.
    low, high = nees_interval(5, len(nees))
    assert low < np.mean(nees) < high
    assert np.mean([t.converged for t in found]) == 1
    # Forty pairs, five parameters; the root mean square is of the inliers' distances, in sigmas.
    assert abs(np.mean([t.rms for t in found]) - np.sqrt(35 / 40)) < 0.06
    assert (np.abs(errors.mean(0)) < 4 * errors.std(0) / np.sqrt(200)).all()


def test_masked_pairs_change_nothing():
    u1, u2 = noisy(1)
    mask = jnp.arange(N) % 5 != 2
    results = []
    for junk in (0.0, np.nan, 1e30):
        a, b = (jnp.where(mask[:, None], u, junk) for u in (u1, u2))
        results.append(plain(jnp.asarray(T), R, a, b, mask))
    for other in results[1:]:
        for x, y in zip(jax.tree.leaves(results[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(x, y)


def test_one_pair_in_five_wrong_by_several_sigmas_does_little_harm():
    # What an estimator with a threshold leaves. Gross outliers are its business: Huber's loss does not forget.
    u1, u2 = noisy(2)
    rng = np.random.default_rng(0)
    wrong = jnp.asarray(np.where(np.arange(N)[:, None] % 5 == 0, rng.choice([-8, 8], (N, 2)) * SIGMA, 0.0))
    clean = plain(jnp.asarray(T), R, u1, u2, EVERYTHING)
    robust = plain(jnp.asarray(T), R, u1, u2 + wrong, EVERYTHING)
    sd = np.sqrt(np.diag(free(clean.covariance)))
    shift = np.linalg.norm((error(robust) - error(clean)) / sd)
    least_squares, _ = dense_step(np.zeros(5), u1, u2 + wrong, np.zeros((5, 5)))
    assert shift < 4
    assert shift < 0.6 * np.linalg.norm((least_squares + error(clean)) / sd)


def test_prior_is_weighed_against_the_data_as_normal_equations_do():
    few = jnp.arange(N) < 6  # one more pair than unknowns: the data are weak
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6))
    prior = 1e-6 * (A @ A.T + np.eye(6))
    u1, u2 = noisy(4, sigma=1e-4)
    two_view = with_prior(jnp.asarray(T), R, u1, u2, few, prior=jnp.asarray(prior))

    information = np.linalg.inv(free(prior))
    x, covariance = dense_step(np.zeros(5), u1[:6], u2[:6], information)
    x, _ = dense_step(x, u1[:6], u2[:6], information)
    np.testing.assert_allclose(-error(two_view), x, rtol=1e-3, atol=1e-3 * np.abs(x).max())
    np.testing.assert_allclose(free(two_view.covariance), covariance, rtol=0.02, atol=0.01 * covariance.max())
    # It has both moved and stayed closer to the prior than the data alone would have it.
    assert np.linalg.norm(x) > 1e-5
    assert np.linalg.eigvalsh(free(prior) - free(two_view.covariance))[0] > 0


def test_gradient_with_respect_to_the_points_equals_central_differences():
    u1, u2 = noisy(5)
    weights = jnp.array([1.0, -2.0, 0.5])

    def value(u2):
        two_view = plain(jnp.asarray(T), R, u1, u2, EVERYTHING)
        return weights @ (two_view.translation + 3 * two_view.rotation.log())

    gradient = jax.jit(jax.grad(value))(u2)
    assert np.isfinite(gradient).all()
    for n, i in ((0, 0), (7, 1), (23, 0)):
        h = jnp.zeros_like(u2).at[n, i].set(1e-6)
        numerical = (value(u2 + h) - value(u2 - h)) / 2e-6
        np.testing.assert_allclose(gradient[n, i], numerical, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
