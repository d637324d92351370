"""Runs in batches are the runs one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

import jaxtri
from jaxtri.estimation.two_view import refine
from jaxtri.filters import ekf
from jaxtri.models.trifocal import start
from jaxtri.synthetic import paper_experiment


@pytest.mark.parametrize("size", [None, 1, 2, 5, 9])
def test_batches_of_any_size_are_the_runs_one_by_one(size):
    shared = jnp.arange(4.0)

    def run(x):
        return {"sum": jnp.sin(x["a"] * shared).sum(), "scaled": x["b"] * x["a"]}

    inputs = {"a": jnp.linspace(0, 1, 5), "b": jnp.linspace(1, 2, 10).reshape(5, 2)}
    one = jax.jit(run)
    alone = [one({"a": a, "b": b}) for a, b in zip(*map(np.asarray, inputs.values()), strict=True)]
    together = jax.jit(lambda x: jaxtri.batch(run, x, size))(inputs)
    for name in ("sum", "scaled"):
        np.testing.assert_allclose(together[name], np.stack([x[name] for x in alone]), rtol=1e-14)
    summed = jax.jit(jax.grad(lambda a: jnp.sum(jaxtri.batch(run, {"a": a, "b": inputs["b"]}, size)["sum"])))
    slope = summed(inputs["a"])
    np.testing.assert_allclose(slope, np.cos(np.outer(inputs["a"], shared)) @ np.asarray(shared), rtol=1e-13)


def test_noise_settings_of_a_filter_in_batches():
    """Many on one sequence, its points shared."""

    @jax.jit
    def begun():
        e = paper_experiment(jax.random.key(0), n_points=20, n_frames=6)
        R, every = SO3.from_matrix(e.rotations[1]), jnp.ones(20, bool)
        view = refine(e.translations[1], R, e.observed[0], e.observed[1], every, e.sigma)
        pairs = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1)
        return e, view, pairs, start(view, velocity_sd=0.02, angular_velocity_sd=0.02)

    e, view, pairs, belief = begun()
    seen, still = jnp.ones((4, 20), bool), jnp.zeros(())

    def loss(sigma):
        model = jaxtri.Trifocal(sigma, jnp.asarray(0.015), jnp.asarray(0.02), still, view.translation)
        return -jnp.sum(ekf.filter(model, belief, pairs, e.observed[2:], seen)[1].log_likelihood)

    noises = e.sigma * jnp.linspace(0.5, 2, 5)
    alone = [*map(jax.jit(loss), np.asarray(noises))]
    together = jax.jit(lambda x: jaxtri.batch(loss, x, 2))(noises)
    np.testing.assert_allclose(together, alone, rtol=1e-10)


def test_a_batch_of_nothing_is_refused():
    with pytest.raises(jaxtri.InputError, match="at least 1"):
        jaxtri.batch(jnp.sin, jnp.ones(3), 0)
