"""Noise of a tracked point, from what the feature tracker says of how well it was followed."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.checks import number

# How a model declares its `sigma`: `eqx.field(**SIGMA)`. Not by `converter=number`, which to pyright makes a field of
# another type than the `sigma` of the filters' protocols.
SIGMA: dict[str, Any] = {"converter": number}

# About the medians of the feature tracker's figures on video.
_ERROR_PX = 0.1
_EIGENVALUE = 0.03
_RANGE = 30  # by which a figure may differ from its median: beyond, it says no more of the point than at the limit


class PointNoise(eqx.Module):
    """Variance of a point's noise: a constant, and what each figure of the feature tracker adds to it.

    Over sigma^2, which is the variance of a point with the usual figures, it is (1 + a (error / 0.1 px)^2 +
    b (0.03 / eigenvalue)) / (1 + a + b), with a and b the two fields and both ratios kept between 1/30 and 30. It is 1
    where a figure is not known. The noise of the image moves a point by a variance that goes with the inverse of the
    eigenvalue. The constant keeps a point that came back by luck from ruling all others, and from being given up when
    the luck ends.

    Attributes:
        error: a, weight of the forward-backward error. 0, as by default, takes no notice of it.
        eigenvalue: b, weight of the smaller eigenvalue of the patch's gradient matrix. As `error`. Both are 0 because
            weights learned on five sequences changed the error on the sixth by no more than chance
            (`benchmarks/tuning.py`).
    """

    error: Float[Array, ""] = eqx.field(default=0.0, converter=number)
    eigenvalue: Float[Array, ""] = eqx.field(default=0.0, converter=number)

    def scale(self, quality: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Standard deviation of each point over sigma; `quality` are its error in pixels and its eigenvalue."""
        ratio = quality / jnp.array([_ERROR_PX, _EIGENVALUE], quality.dtype)
        known = jnp.isfinite(ratio).all(axis=1)
        error, eigenvalue = jnp.clip(jnp.where(known[:, None], ratio, 1.0), 1 / _RANGE, _RANGE).T
        a, b = self.error.astype(error.dtype), self.eigenvalue.astype(error.dtype)
        return jnp.sqrt(jnp.where(known, (1 + a * error**2 + b / eigenvalue) / (1 + a + b), 1.0))
