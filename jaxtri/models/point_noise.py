"""Noise of a tracked point, from what the feature tracker says of how well it was followed."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.checks import number

# About the medians of the tracker's figures on video.
_ERROR_PX = 0.1
_EIGENVALUE = 0.03


class PointNoise(eqx.Module):
    """Variance of a point's noise: a constant, and what each of the tracker's figures adds to it.

    Over sigma^2, which is that of a point with the usual figures, (1 + a (error / 0.1 px)^2 + b (0.03 / eigenvalue)) /
    (1 + a + b), both ratios kept between 1/30 and 30: the noise of the image moves a point by a variance that goes with
    the inverse of the eigenvalue. 1 where a figure is not known, and for all by default. The constant keeps a point
    that came back by luck from ruling all others, and from being given up when the luck ends.
    """

    error: Float[Array, ""] = eqx.field(default=0.0, converter=number)  # a; forward-backward error
    eigenvalue: Float[Array, ""] = eqx.field(default=0.0, converter=number)  # b; smaller one of the gradient matrix

    def scale(self, quality: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Standard deviation over sigma, of points whose errors (pixels) and eigenvalues are given."""
        ratio = quality / jnp.array([_ERROR_PX, _EIGENVALUE], quality.dtype)
        known = jnp.isfinite(ratio).all(axis=1)
        error, eigenvalue = jnp.clip(jnp.where(known[:, None], ratio, 1.0), 1 / 30, 30).T
        a, b = self.error.astype(error.dtype), self.eigenvalue.astype(error.dtype)
        return jnp.sqrt(jnp.where(known, (1 + a * error**2 + b / eigenvalue) / (1 + a + b), 1.0))
