"""Where to begin an update whose prediction is far off: states that a few items agree on, judged by all of them.

Graduated weights find the posterior as long as the prediction is within their reach. Where it is not (a frame is
missing, a camera is thrown about), and a third of the items are wrong together, they may settle anywhere. There each of
some samples of three items, with the prior, says where the state may be, and that which most items agree with is begun
from. The posterior is that of the prior and all items, as ever: only where its search begins is new.
Source: Fischler & Bolles 1981; Torr & Zisserman 2000, for the cost.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtri.filters.diagnostics import Robust
from jaxtri.filters.linalg import Prior
from jaxtri.filters.model import Belief, Mean
from jaxtri.filters.projective import Moments, Projective, linearise

SAMPLES, SIZE = 64, 3  # with half of the items wrong, one sample in eight holds none of them: all miss in 2e-4 of cases
STEPS = 6  # of Gauss and Newton: a turn of 20 degrees takes four


def begin(
    model: Projective[Mean],
    belief: Belief[Mean],
    items: Moments,
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    robust: Robust,
    *,
    noise_scale: Float[Array, " n"] | None = None,
) -> Float[Array, " d"]:
    """The error of the prediction from which to begin: zero where half of the items are in reach of the weights.

    For `jaxtri.filters.ekf.update`; without a derivative, for the posterior does not depend on it. What stands in
    masked entries must be finite.
    """
    belief, items, observed, robust, noise_scale = jax.lax.stop_gradient((belief, items, observed, robust, noise_scale))
    prior = Prior.of(belief.covariance, model.support)
    zero = jnp.zeros(len(belief.covariance), observed.dtype)

    def distance(delta: Array) -> Array:
        return linearise(model, belief.mean, delta, items, observed, mask, noise_scale).distance

    def sampled() -> Array:
        q = len(items.coordinates)
        spread = items.spread.reshape(q, -1, len(mask))

        def of(which: Array) -> Array:
            few = Moments(items.coordinates[:, which], items.products[which], spread[..., which].reshape(q, -1))
            scale = None if noise_scale is None else noise_scale[which]

            def step(_: Array, delta: Array) -> Array:
                evidence = linearise(model, belief.mean, delta, few, observed[which], mask[which], scale)
                A, b = evidence.normal_equations(jnp.ones(SIZE, delta.dtype))
                return prior.error(prior.inverse(A), b + A @ delta[prior.support])

            return jax.lax.fori_loop(0, STEPS, step, zero)

        deltas = jnp.concatenate([zero[None], jax.vmap(of)(_samples(mask))])
        cost = jax.vmap(lambda d: jnp.sum(jnp.minimum(distance(d), robust.gate)))(deltas)
        return deltas[jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]

    reached = jnp.sum(mask & (distance(zero) < robust.start))
    return jax.lax.cond(2 * reached >= jnp.sum(mask), lambda: zero, sampled)


def _samples(mask: Bool[Array, " n"]) -> Array:
    """(SAMPLES, SIZE) items in the mask; the same ones for the same mask."""
    order, count = jnp.argsort(~mask), jnp.sum(mask)
    drawn = jnp.asarray(np.random.default_rng(0).random((SAMPLES, SIZE)), jnp.float32)
    return order[jnp.minimum((drawn * count).astype(order.dtype), jnp.maximum(count - 1, 0))]
