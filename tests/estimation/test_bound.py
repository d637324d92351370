from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jaxlie import SO3

from jaxtri.estimation.bound import filtering_bound, smoothing_bound
from jaxtri.synthetic.experiment import paper_experiment


@pytest.fixture(scope="module")
def small():
    return jax.jit(partial(paper_experiment, n_points=15, n_frames=7))(jax.random.key(2))


filtering, smoothing = jax.jit(filtering_bound), jax.jit(smoothing_bound)


def truth(e):
    return e.points, e.rotations, e.translations, e.sigma


def predicted(e, x):
    """Image points (t, n, 2) for 5 errors of the second pose, 6 of each later one and 3 of each point."""
    t, n = e.clean.shape[:2]
    length = jnp.linalg.norm(e.translations[1])
    direction = e.translations[1] / length
    basis = jnp.linalg.svd(direction[None])[2][1:]
    along = direction + x[:2] @ basis
    T2 = length * along / jnp.linalg.norm(along)
    later = x[5 : 5 + 6 * (t - 2)].reshape(t - 2, 6)
    T = jnp.concatenate([jnp.zeros((1, 3)), T2[None], e.translations[2:] + later[:, :3]])
    turns = jnp.concatenate([jnp.zeros((1, 3)), x[None, 2:5], later[:, 3:]])
    R = jax.vmap(lambda w, R: SO3.exp(w).as_matrix() @ R)(turns, e.rotations)
    X = e.points + x[5 + 6 * (t - 2) :].reshape(n, 3)
    y = jnp.einsum("tij,nj->tni", R, X) + T[:, None]
    return y[..., :2] / y[..., 2:]


def size(e):
    t, n = e.clean.shape[:2]
    return 5 + 6 * (t - 2) + 3 * n


def dense(e, frames, J):
    """The bound from the whole information matrix of the first `frames` frames, last pose; J is of all of them."""
    t, n = e.clean.shape[:2]
    end = 5 + 6 * (frames - 2)
    J = np.delete(J[: 2 * n * frames], np.s_[end : 5 + 6 * (t - 2)], axis=1)
    return np.linalg.inv(J.T @ J)[end - 6 : end, end - 6 : end] * float(e.sigma) ** 2


def test_filtering_bound_equals_the_inverse_of_the_whole_information(small):
    bound = filtering(*truth(small))
    J = np.asarray(jax.jit(jax.jacfwd(lambda x: predicted(small, x).ravel()))(jnp.zeros(size(small))))
    for k, frames in enumerate(range(3, 8)):
        expected = dense(small, frames, J)
        np.testing.assert_allclose(bound[k], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_smoothing_bound_ends_where_the_filtering_bound_does(small):
    filtered, smoothed = filtering(*truth(small)), smoothing(*truth(small))
    np.testing.assert_allclose(smoothed[-1], filtered[-1], rtol=1e-6, atol=1e-6 * np.abs(filtered[-1]).max())
    # Later frames only help; no error along the base line, which is the gauge.
    assert np.linalg.eigvalsh(filtered[:-1] - smoothed[1:-1]).min() > -1e-9 * np.abs(filtered).max()
    T = np.asarray(small.translations[1])
    assert np.abs(smoothed[0, :3, :3] @ T).max() < 1e-9 * np.abs(smoothed[0]).max()


def test_bound_of_some_frames_points_and_noises(small):
    every = filtering(*truth(small))
    some = filtering(*truth(small), frames=jnp.array([3, 6]))
    np.testing.assert_allclose(some, every[jnp.array([1, 4])], rtol=1e-9)
    points, R, T, sigma = truth(small)
    np.testing.assert_allclose(filtering(points, R, T, 2 * sigma), 4 * every, rtol=1e-9)
    # A masked point is as good as none.
    without = filtering(points[:-1], R, T, sigma)
    mask = jnp.ones((7, 15), bool).at[:, -1].set(False)
    np.testing.assert_allclose(filtering(*truth(small), mask), without, rtol=1e-6)


def test_bundle_adjustment_of_noisy_data_reaches_the_smoothing_bound(small):
    e = small
    bound = np.asarray(smoothing(*truth(e)))

    def adjust(key):
        observed = e.clean + e.sigma * jax.random.normal(key, e.clean.shape)
        solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
        residuals = lambda x, _: ((predicted(e, x) - observed) / e.sigma).ravel()  # noqa: E731
        return optx.least_squares(residuals, solver, jnp.zeros(size(e)), max_steps=50, throw=False).value

    draws = 300
    x = jax.jit(lambda keys: jax.lax.map(adjust, keys))(jax.random.split(jax.random.key(0), draws))
    poses = np.asarray(x[:, 5 : 5 + 6 * 5]).reshape(draws, 5, 6)
    sampled = np.mean(poses**2, axis=0)
    expected = np.diagonal(bound[1:], axis1=1, axis2=2)
    # A mean of 300 squares has a relative standard deviation of .08.
    assert np.abs(np.mean(sampled / expected) - 1) < 0.1
    assert np.abs(sampled / expected - 1).max() < 0.35
