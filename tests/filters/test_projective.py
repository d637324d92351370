"""The moment form against its slow twin: the filter that takes each item's own Jacobian."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3

from jaxtri.estimation.two_view import refine
from jaxtri.filters import ekf, projective
from jaxtri.models.base_pairs import BasePairs, base_point
from jaxtri.models.motion import Twist
from jaxtri.models.rolling_shutter import LatePoint, RollingShutter
from jaxtri.models.trifocal import Trifocal, start
from jaxtri.synthetic.experiment import paper_experiment

FRAMES, POINTS = 93, 40
ROBUST = ekf.Robust()


class Plain(eqx.Module):
    """A model that does not say that its measurements are a linear map and a division."""

    model: Trifocal | BasePairs

    def __getattr__(self, name):
        if name in ("matrix", "coordinates", "spread", "support"):
            raise AttributeError(name)
        return getattr(object.__getattribute__(self, "model"), name)


@pytest.fixture(scope="module")
def experiment():
    @jax.jit
    def begun():
        e = paper_experiment(jax.random.key(3), n_points=POINTS, n_frames=FRAMES)
        R, every = SO3.from_matrix(e.rotations[1]), jnp.ones(POINTS, bool)
        return e, refine(e.translations[1], R, e.observed[0], e.observed[1], every, e.sigma)

    return begun()


def trifocal(e, view, log_sigma, base_noise):
    sigma = e.sigma * jnp.exp(log_sigma)
    model = Trifocal(
        sigma, jnp.asarray(0.01), jnp.asarray(0.02), jnp.asarray(0.0), view.translation, base_noise=base_noise
    )
    pairs = jnp.concatenate([e.observed[0], e.observed[1]], axis=-1)
    return model, start(view, velocity_sd=0.01, angular_velocity_sd=0.02), pairs


def base_pairs(e, view, log_sigma):
    model = BasePairs(e.sigma * jnp.exp(log_sigma), jnp.asarray(0.01), jnp.asarray(0.02))
    pose = SE3.from_rotation_and_translation(view.rotation, view.translation)
    points = jax.vmap(lambda a, b: base_point(a, b, SE3.identity(), pose))(e.observed[0], e.observed[1])
    return model, ekf.Belief(Twist(pose, jnp.zeros(6)), jnp.diag(jnp.repeat(jnp.array([1e-4, 1e-2]), 6) ** 2)), points


def rolling(e, view, log_sigma):
    """Each point a share of a frame late, whatever is seen there: what the moments say of it is all that is asked."""
    model, belief, points = base_pairs(e, view, log_sigma)
    model = RollingShutter(model.sigma, model.acceleration, model.angular_acceleration)
    return model, belief, LatePoint(*points, jnp.linspace(-0.4, 0.4, POINTS))


def told(e):
    """A mask with a point that is never seen and others that come and go; an outlier a frame."""
    mask = jax.random.bernoulli(jax.random.key(0), 0.8, e.observed[2:].shape[:2]).at[:, 7].set(False)
    return e.observed[2:].at[jnp.arange(FRAMES - 2), jnp.arange(FRAMES - 2) % POINTS].add(0.05), mask


CASES = {
    "one pass": (partial(trifocal, base_noise=False), 1, None),
    "default": (partial(trifocal, base_noise=True), 4, None),
    "robust": (partial(trifocal, base_noise=True), 9, ROBUST),
    "base pairs": (base_pairs, 8, ROBUST),
    "rolling shutter": (rolling, 8, ROBUST),
}


def run(log_sigma, e, view, case, plain):
    """The log-likelihood, beliefs and diagnostics; the item that is never seen holds NaN."""
    make, passes, robust = CASES[case]
    model, belief, items = make(e, view, log_sigma)
    observed, mask = told(e)
    if not robust:
        observed = e.observed[2:]
    items = jax.tree.map(lambda x: x.at[7].set(jnp.nan), items)
    model = Plain(model) if plain else model
    beliefs, says = ekf.filter(model, belief, items, observed, mask, passes=passes, robust=robust)
    return jnp.sum(says.log_likelihood), (beliefs, says)


forward = jax.jit(run, static_argnames=("case", "plain"))
gradient = jax.jit(jax.grad(run, has_aux=True), static_argnames=("case", "plain"))


@pytest.mark.parametrize("case", CASES)
def test_the_moments_say_what_the_items_say(experiment, case):
    """After 91 frames: states to 1e-9, covariances symmetric and positive."""
    both = (forward(jnp.zeros(()), *experiment, case, plain) for plain in (False, True))
    ours, theirs = jax.tree.map(np.asarray, tuple(both))
    (value, (beliefs, says)), (value_, (beliefs_, says_)) = ours, theirs
    for a, b in zip(jax.tree.leaves(beliefs.mean), jax.tree.leaves(beliefs_.mean), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    sd = np.sqrt(np.maximum(np.diagonal(beliefs_.covariance, axis1=1, axis2=2), 1e-30))
    scale = sd[:, :, None] * sd[:, None]
    np.testing.assert_allclose(beliefs.covariance / scale, beliefs_.covariance / scale, atol=1e-6)
    np.testing.assert_allclose(beliefs.covariance / scale, np.swapaxes(beliefs.covariance / scale, 1, 2), atol=1e-11)
    assert np.linalg.eigvalsh(beliefs.covariance / scale).min() > -1e-9
    np.testing.assert_allclose(value, value_, rtol=1e-9)
    np.testing.assert_array_equal(says.used, says_.used)
    np.testing.assert_allclose(says.distance, says_.distance, rtol=1e-5, atol=1e-6)


def test_their_derivative_is_that_of_the_items(experiment):
    ours, theirs = (gradient(jnp.zeros(()), *experiment, "robust", plain)[0] for plain in (False, True))
    np.testing.assert_allclose(ours, theirs, rtol=1e-7)


def test_items_are_prepared_once(experiment):
    """What is prepared is taken as it is, and items of a model without a map are left alone."""
    model, belief, pairs = jax.jit(partial(trifocal, base_noise=True))(*experiment, jnp.zeros(()))
    mask = jnp.ones(POINTS, bool)
    prepared = jax.jit(ekf.prepare)(model, pairs, mask)
    assert isinstance(prepared, projective.Moments)
    assert ekf.prepare(model, prepared, mask) is prepared
    assert ekf.prepare(Plain(model), pairs, mask) is pairs
    step = jax.jit(ekf.step)
    observed = experiment[0].observed[2]
    for a, b in zip(*(jax.tree.leaves(step(model, belief, x, observed, mask)) for x in (pairs, prepared)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_what_items_say_of_the_state_and_what_their_points_owe(experiment):
    """Against each item's own Jacobians."""
    model, belief, items = jax.jit(base_pairs)(*experiment, jnp.zeros(()))
    rng, mean = np.random.default_rng(5), belief.mean
    levers, weights = rng.normal(size=(POINTS, 4, 6)), rng.uniform(size=POINTS)
    weights[3] = 0.0

    @jax.jit
    def coupling(items, levers, weights):
        prepared, none = projective.prepare(model, items), jnp.zeros((POINTS, 2))
        said = projective.linearise(model, mean, jnp.zeros(12), prepared, none, weights > 0, None)
        return jnp.moveaxis(said.coupling(weights, jnp.moveaxis(levers, 0, -1)), -1, 0)

    @jax.jit
    @jax.vmap
    def one(item, lever):
        H = jax.jacfwd(lambda e: model.measure(model.retract(mean, e), item))(jnp.zeros(12))
        J = jax.jacfwd(lambda X: model.measure(mean, item._replace(point=X)))(item.point) @ lever
        return H.T @ jnp.linalg.solve(model.noise(mean, item), J)

    expected = (weights[:, None, None] * one(items, levers))[:, :6]
    np.testing.assert_allclose(coupling(items, levers, weights), expected, atol=1e-9 * np.abs(expected).max())
