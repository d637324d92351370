import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from intervals import nees_interval
from jaxlie import SE3
from jaxtyping import Array, Float
from scipy.optimize import minimize

from jaxtri.errors import InputError
from jaxtri.estimation import tuning
from jaxtri.estimation.tuning import Parameter
from jaxtri.filters import ekf


class Walk(eqx.Module):
    """A random walk on a line; an item measures it from an offset of its own."""

    sigma: Float[Array, ""]
    drift: Float[Array, ""]

    def retract(self, mean, delta):
        return mean + delta

    def local(self, mean, other):
        return other - mean

    def predict(self, mean, dt):
        return mean

    def process_noise(self, mean, dt):
        return jnp.square(self.drift)[None, None] * dt

    def measure(self, mean, item):
        return mean + item

    def noise(self, mean, item):
        return jnp.square(self.sigma)[None, None]


def walks(seed, frames=300):
    rng = np.random.default_rng(seed)
    x = np.cumsum(0.2 * rng.normal(size=frames))
    offsets = rng.normal(size=(3, 1))
    observed = x[:, None, None] + offsets + 0.5 * rng.normal(size=(frames, 3, 1))
    return jnp.asarray(offsets), jnp.asarray(observed), jnp.asarray(rng.uniform(size=(frames, 3)) > 0.2)


@jax.jit
def run(model, data):
    return ekf.filter(model, ekf.Belief(jnp.zeros(1), jnp.eye(1)), *data, passes=1)[1]


def loss(model, data):
    return tuning.negative_log_likelihood(run(model, data), components=1)


PARAMETERS = {"sigma": Parameter(lambda m: m.sigma), "drift": Parameter(lambda m: m.drift)}
MISTUNED = Walk(jnp.asarray(5.0), jnp.asarray(0.02))


@pytest.mark.parametrize("forward", [True, False])
def test_fit_finds_the_minimum_and_what_was_put_in(forward):
    data = walks(0)
    found = tuning.fit(MISTUNED, data, PARAMETERS, loss, forward=forward)
    slope = jax.jit(jax.value_and_grad(lambda x, data: loss(Walk(*jnp.exp(x)), data)))
    twin = minimize(slope, np.log([5.0, 0.02]), (data,), jac=True, method="L-BFGS-B", options={"gtol": 1e-7})
    assert found.converged
    np.testing.assert_allclose(found.loss_after, twin.fun, atol=1e-7)
    np.testing.assert_allclose([found.model.sigma, found.model.drift], np.exp(twin.x), rtol=1e-2)
    np.testing.assert_allclose([found.model.sigma, found.model.drift], [0.5, 0.2], rtol=0.1)
    np.testing.assert_allclose(found.loss_before, loss(MISTUNED, data), rtol=1e-12)
    old, new = found.changes["sigma"]
    assert (old, new) == (5.0, found.model.sigma)
    assert tuning.nis_per_component(run(MISTUNED, walks(1)), 1) < 0.3
    # The innovations of the right filter are white.
    after = run(found.model, walks(1))
    low, high = nees_interval(1, int(after.used.sum()))
    assert low < tuning.nis_per_component(after, 1) < high
    assert "sigma: 5.0 -> 0." in str(found)


def test_priors_and_floors_hold():
    data = walks(2)
    tight = {**PARAMETERS, "sigma": Parameter(lambda m: m.sigma, prior_sd=1e-3)}
    assert abs(tuning.fit(MISTUNED, data, tight, loss).model.sigma / 5 - 1) < 1e-2
    floored = {**PARAMETERS, "sigma": Parameter(lambda m: m.sigma, floor=1.0)}
    assert tuning.fit(MISTUNED, data, floored, loss).model.sigma > 1


def test_further_starts_do_no_worse_and_other_solvers_will_do():
    data = walks(3)
    one = tuning.fit(MISTUNED, data, PARAMETERS, loss)
    more = tuning.fit(MISTUNED, data, PARAMETERS, loss, optx.NonlinearCG(1e-6, 1e-6), starts=3)
    assert more.loss_after < one.loss_after + 1e-5


def test_a_second_fit_with_functions_made_anew_compiles_nothing(compiled):
    """As where a notebook's cell is run again; another number in the loss is another loss."""
    data = walks(5, frames=77)  # a length that no other test has compiled for

    def fit(factor):
        def anew(model, data):
            return factor * loss(model, data)

        found = tuning.fit(MISTUNED, data, {"sigma": Parameter(lambda m: m.sigma)}, anew)
        return found.loss_after, len(compiled)

    (one, first), (two, second), (three, third) = fit(1.0), fit(1.0), fit(2.0)
    assert 0 < first == second < third
    assert one == two
    np.testing.assert_allclose(three, 2 * one, rtol=1e-4)


def test_losses_of_errors():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (6, 3)) + np.array([0, 0, 4])
    seen = rng.uniform(size=(3, 6)) > 0.3
    seen[1] = False
    poses, M = jax.jit(lambda e: (pose := SE3.exp(e), pose.as_matrix()))(0.2 * rng.normal(size=(3, 6)))
    X = np.einsum("tij,nj->tni", M[:, :3, :3], points) + M[:, None, :3, 3]
    observed = X[..., :2] / X[..., 2:] + 0.01 * rng.normal(size=(3, 6, 2))
    expected = np.mean((X[..., :2] / X[..., 2:] - observed)[seen] ** 2)
    junk = jnp.asarray(np.where(seen[..., None], observed, np.nan)), jnp.asarray(seen)
    losses = jax.jit(jax.value_and_grad(lambda x: tuning.reprojection_loss(x, poses, *junk)))
    value, slope = losses(jnp.asarray(points))
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert np.isfinite(slope).all()
    assert (np.any(slope, axis=1) == seen.any(axis=0)).all()

    A = rng.normal(size=(3, 3))
    errors = jnp.asarray(rng.normal(size=(20000, 3)) @ A.T)
    covariance = jnp.broadcast_to(A @ A.T, (20000, 3, 3))
    nees_loss = jax.jit(tuning.nees_loss)
    assert nees_loss(errors, covariance) < 1e-3
    np.testing.assert_allclose(nees_loss(errors, 4 * covariance), np.log(4) ** 2, rtol=0.05)


def test_what_cannot_be_fitted_is_named():
    data = walks(4)
    with pytest.raises(InputError, match="drift is 0"):
        tuning.fit(Walk(jnp.asarray(1.0), jnp.asarray(0.0)), data, PARAMETERS, loss)
    with pytest.raises(InputError, match="loss at the start is inf"):
        tuning.fit(Walk(jnp.asarray(jnp.nan), jnp.asarray(1.0)), data, {"drift": PARAMETERS["drift"]}, loss)
