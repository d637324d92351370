"""Beliefs given later frames too, from those of a filter."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.checks import checked
from jaxtri.filters.linalg import regression
from jaxtri.filters.model import Belief, Dynamics, Mean, change_of_origin, transition
from jaxtri.filters.scan import each_frame


@checked
def smooth(
    model: Dynamics[Mean],
    beliefs: Belief[Mean],
    dt: Float[Array, " t"] | Float[Array, ""] | float | None = None,
) -> Belief[Mean]:
    """Beliefs of all frames given all frames, earlier and later ones, from those of `filter` and its `dt`.

    Fixed-interval smoothing by Rauch, Tung & Striebel 1965 in the errors of the manifold; O(t d^3). Directions
    without uncertainty stay, and so do considered components, whose smoothed covariances are right besides:
    what a frame leaves open given the next has nothing in common with later noise, however that is weighted.
    """
    steps = each_frame(dt, len(beliefs.covariance), beliefs.covariance.dtype)

    @jax.checkpoint
    def body(later: Belief[Mean], frame: tuple[Belief[Mean], Array]) -> tuple[Belief[Mean], Belief[Mean]]:
        now, elapsed = frame
        F, Q = transition(model, now.mean, elapsed), model.process_noise(now.mean, elapsed)
        P, predicted = now.covariance, model.predict(now.mean, elapsed)
        G = regression(F @ P @ F.T + Q, F @ P)
        zero = jnp.zeros(len(P), P.dtype)
        onto = G @ jax.jacfwd(lambda x: model.local(predicted, model.retract(later.mean, x)))(zero)
        delta = G @ model.local(predicted, later.mean)
        mean = model.retract(now.mean, delta)
        left = jnp.eye(len(P), dtype=P.dtype) - G @ F
        covariance = left @ P @ left.T + G @ Q @ G.T + onto @ later.covariance @ onto.T
        reset = change_of_origin(model, now.mean, delta, mean)
        smoothed = Belief(mean, reset @ covariance @ reset.T)
        return smoothed, smoothed

    last = jax.tree.map(lambda x: x[-1], beliefs)
    earlier = jax.tree.map(lambda x: x[:-1], beliefs)
    _, found = jax.lax.scan(body, last, (earlier, steps[1:]), reverse=True)
    return jax.tree.map(lambda x, end: jnp.concatenate([x, end[None]]), found, last)
