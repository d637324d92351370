"""Two views of a camera that stays where it is, turns, and changes its focal length; it must not pass for a motion."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SO3
from jaxtyping import Array, Bool, Float

from jaxtri.estimation.two_view import huberised, least_squares
from jaxtri.filters.masks import stand_in

DEPTH = math.log(4)  # what GRIC charges a model for each point that it gives a depth
HUBER, STEPS = 2.0, 32
NEAREST = 1e-3  # cosine of a turned ray's angle to the axis, below which it is held there: 89.9 degrees


class Zoom(NamedTuple):
    """A turn and a zoom between two views: u2 = scale R u1.

    Attributes:
        rotation: R.
        scale: Focal length in the second view over that in the first.
        distance: (n,) squared distances of the points in both views, over sigma squared, as Sampson's is.
    """

    rotation: SO3
    scale: Float[Array, ""]
    distance: Float[Array, " n"]


@jax.jit
def fit(u1: Float[Array, "n 2"], u2: Float[Array, "n 2"], mask: Bool[Array, " n"], sigma: Float[Array, ""]) -> Zoom:
    """The turn and zoom that two views of the points in the mask agree on best; `u1`, `u2` are normalised."""
    u1, u2 = stand_in(mask, (u1, u2))

    def residuals(x: Float[Array, "4"]) -> Float[Array, "n 2"]:
        y = jnp.concatenate([u1, jnp.ones_like(u1[:, :1])], axis=1) @ SO3.exp(x[:3]).as_matrix().T
        depth = jnp.where(y[:, 2] > NEAREST, y[:, 2], NEAREST)
        return (jnp.exp(x[3]) * y[:, :2] / depth[:, None] - u2) / sigma

    def robust(x: Float[Array, "4"], _: None) -> Array:
        return jnp.where(mask[:, None], huberised(residuals(x), HUBER), 0.0).ravel()

    x, _ = least_squares(robust, jnp.zeros(4, u1.dtype), STEPS)
    scale = jnp.exp(x[3])
    # The first view's noise comes over enlarged.
    return Zoom(SO3.exp(x[:3]), scale, jnp.sum(residuals(x) ** 2, axis=1) / (1 + scale**2))


@jax.jit
def explains(
    zoom: Zoom, mask: Bool[Array, " n"], rival: Float[Array, ""] | float, worst: Float[Array, ""] | float
) -> Bool[Array, ""]:
    """Whether it explains the points in the mask as well as a motion whose cost is `rival`, their depths counted.

    Both costs are sums of squared distances over sigma squared, of `worst` at most. By Torr's geometric robust
    information criterion: a motion has a parameter more, and a depth for every point, which fits noise too.
    Source: Torr 1999, "Model selection for two view geometry".
    """
    n = jnp.sum(mask)
    cost = jnp.sum(jnp.where(mask, jnp.minimum(zoom.distance, worst), 0.0))
    return cost < rival + n * DEPTH + jnp.log(4.0 * n)
