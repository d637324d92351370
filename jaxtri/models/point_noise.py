"""Noise of a tracked point, from what the feature tracker says of how well it was followed."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.ekf import number

# About the medians of the tracker's figures on video: where the noise is sigma.
_ERROR_PX = 0.1
_EIGENVALUE = 0.03


class PointNoise(eqx.Module):
    """Standard deviation of a point's noise over sigma: a power of each of the tracker's figures.

    (error / 0.1 px) ** a * (eigenvalue / 0.03) ** b, both ratios kept between 1/30 and 30; 1 where a figure is not
    known. All zero, the default, is the same noise for all.
    """

    error: Float[Array, ""] = eqx.field(default=0.0, converter=number)  # a; forward-backward error
    eigenvalue: Float[Array, ""] = eqx.field(default=0.0, converter=number)  # b; of the patch's gradient matrix

    def scale(self, quality: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Of points whose forward-backward errors (pixels) and smaller eigenvalues are given."""
        ratio = quality / jnp.array([_ERROR_PX, _EIGENVALUE], quality.dtype)
        known = jnp.isfinite(ratio).all(axis=1)
        error, eigenvalue = jnp.log(jnp.clip(jnp.where(known[:, None], ratio, 1.0), 1 / 30, 30)).T
        return jnp.exp(self.error.astype(error.dtype) * error + self.eigenvalue.astype(error.dtype) * eigenvalue)
