"""Runs in batches are the runs one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

import jaxtri
from jaxtri import ekf
from jaxtri.models.trifocal import start
from jaxtri.synthetic import paper_experiment
from jaxtri.two_view import refine


def test_batches_of_any_size_are_the_runs_one_by_one():
    """Many noise settings on one sequence, its points shared; with the gradient."""
    e = paper_experiment(jax.random.key(0), n_points=20, n_frames=6)
    every = jnp.ones(20, bool)
    R = SO3.from_matrix(e.rotations[1])
    view = refine(e.translations[1], R, e.observed[0], e.observed[1], every, e.sigma)
    pairs, seen = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1), jnp.ones((4, 20), bool)
    belief, still = start(view, velocity_sd=0.02, angular_velocity_sd=0.02), jnp.zeros(())

    def loss(sigma):
        model = jaxtri.Trifocal(sigma, jnp.asarray(0.015), jnp.asarray(0.02), still, view.translation)
        return -jnp.sum(ekf.filter(model, belief, pairs, e.observed[2:], seen)[1].log_likelihood)

    noises, gradient = e.sigma * jnp.linspace(0.5, 2, 5), jax.grad(loss)
    for f, sizes in ((loss, (None, 1, 9)), (gradient, (2,))):
        alone = np.stack([*map(jax.jit(f), noises)])
        for size in sizes:
            together = jax.jit(lambda x, f=f, size=size: jaxtri.batch(f, x, size))(noises)
            # Rounding: 3e-10 of the largest in a derivative.
            np.testing.assert_allclose(together, alone, rtol=0, atol=1e-8 * np.abs(alone).max())


def test_a_batch_of_nothing_is_refused():
    with pytest.raises(jaxtri.InputError, match="at least 1"):
        jaxtri.batch(jnp.sin, jnp.ones(3), 0)
