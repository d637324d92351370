"""Where an update begins: a prediction far off, and half of the items wrong together."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxtri.errors import InputError
from jaxtri.filters import consensus, ekf
from jaxtri.geometry.pose import exp_pose, identity, local
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.motion import Twist

N, ROBUST = 60, ekf.Robust(1e4, passes=8)  # as the tracker has it
MODEL = BasePairs(1e-3, 0.2, 0.2)
PREDICTED = ekf.Belief(Twist(identity(jnp.float64), jnp.zeros(6)), jnp.diag(jnp.full(12, 0.2**2)))


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@jax.jit
def prepared(X):
    return ekf.prepare(MODEL, BasePoint(X, jnp.zeros((N, 4, 0))), jnp.ones(N, bool))


@jax.jit
def begin(items, observed, mask):
    return consensus.begin(MODEL, PREDICTED, items, observed, mask, ROBUST)


@jax.jit
def updated(items, observed, mask, begin=None):
    return ekf.update(MODEL, PREDICTED, items, observed, mask, robust=ROBUST, begin=begin)


off = jax.jit(local)


def frame(turn, wrong, seed):
    """Points seen from a camera that has turned (radians) and moved; those that are wrong went about another way."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform([-2, -1.5, 3], [2, 1.5, 6], (N, 3)), np.ones(N)])
    true = jax.jit(exp_pose)(jnp.array([0.3, 0.0, -0.1, 0.02, turn, 0.01]))
    T = np.stack([jax.jit(SE3.as_matrix)(true), np.eye(4)])
    seen = np.einsum("tij,nj->tni", T[:, :3], X)
    u = seen[..., :2] / seen[..., 2:] + rng.normal(scale=1e-3, size=(2, N, 2))
    u[1] += np.array([-0.1, 0.15]) + rng.normal(scale=0.03, size=(N, 2))
    return true, prepared(X), np.where(np.arange(N)[:, None] < wrong, u[1], u[0])


@pytest.mark.parametrize("seed", range(3))
def test_the_motion_that_most_agree_with_is_found_from_far_off(seed):
    true, items, observed = frame(0.35, 28, seed)
    mask = np.arange(N) % 7 > 0
    observed[~mask] = 1e3  # what is masked says nothing
    belief, said = updated(items, observed, mask, begin(items, observed, mask))
    assert np.linalg.norm(off(belief.mean.pose, true)) < 0.01
    assert set(np.flatnonzero(said.weights > 0)) <= set(range(28, N))
    # Without it the weights, however gently they come down, settle on something else.
    lost, _ = updated(items, observed, mask)
    assert np.linalg.norm(off(lost.mean.pose, true)) > 0.05


def test_a_prediction_within_reach_is_begun_from():
    _, items, observed = frame(0.02, 12, 0)
    np.testing.assert_array_equal(begin(items, observed, np.ones(N, bool)), 0)


def test_where_the_search_begins_changes_neither_the_posterior_nor_its_derivative():
    _, items, observed = frame(0.05, 0, 1)
    mask = jnp.ones(N, bool)

    somewhere = np.repeat([0, 0.03, 0, 0], 3)

    @jax.jit
    @partial(jax.value_and_grad, argnums=1)
    def angle(items, u, search):
        at = None if search is None else jnp.where(search, begin(items, u, mask), somewhere)
        return local(PREDICTED.mean, updated(items, u, mask, at)[0].mean)[4]

    for ours, theirs in zip(*(angle(items, observed, x) for x in (False, None)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)
    _, items, observed = frame(0.35, 28, 0)
    assert np.isfinite(angle(items, observed, True)[1]).all()


def test_no_item_at_all():
    _, items, observed = frame(0.35, 28, 0)
    np.testing.assert_array_equal(begin(items, observed, np.zeros(N, bool)), np.zeros(12))


def test_an_error_of_another_length_is_refused():
    _, items, observed = frame(0.02, 0, 0)
    with pytest.raises(InputError, match=r"begin has the shape \(6,\); an error of the prediction has \(12,\)"):
        updated(items, observed, jnp.ones(N, bool), jnp.zeros(6))
