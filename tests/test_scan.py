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

    noises = e.sigma * jnp.linspace(0.5, 2, 5)
    value = jax.jit(jax.value_and_grad(loss))
    alone = [np.stack(x) for x in zip(*map(value, noises), strict=True)]
    for size in (None, 1, 2, 5, 9):
        together = jax.jit(lambda x, size=size: jaxtri.batch(jax.value_and_grad(loss), x, size))(noises)
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_allclose(all_, one, rtol=1e-9)


def test_a_batch_of_nothing_is_refused():
    with pytest.raises(jaxtri.InputError, match="at least 1"):
        jaxtri.batch(jnp.sin, jnp.ones(3), 0)
