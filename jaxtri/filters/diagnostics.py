"""Robust weights, and what an update reports beside its belief."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxtri.checks import number

Taken = TypeVar("Taken", bound=PyTree)


class Robust(eqx.Module):
    """Graduated Geman-McClure weights w = (1 + m2/c)^-2, then a hard gate.

    The scale c falls geometrically from `start` to `scale` over the passes, so that the first pass sees a
    convex problem; m2 is the squared Mahalanobis distance under the measurement noise, not under the
    prediction: gating against the prediction throws good points away whenever the motion changes. `gate`
    is the m2 above which an item is left out in the end; 13.8 is the 99.9 % quantile of 2 components. A
    higher `start` survives a worse prediction and needs more passes: 1e5 nine, 1e7 about sixteen.
    """

    start: Float[Array, ""] = eqx.field(default=1e5, converter=number)
    scale: Float[Array, ""] = eqx.field(default=16.0, converter=number)
    gate: Float[Array, ""] = eqx.field(default=13.8, converter=number)

    def weights(self, distance: Float[Array, " n"], k: Int[Array, ""], passes: int) -> Float[Array, " n"]:
        """Weights in pass k of `passes`, of items whose squared Mahalanobis distance is given."""
        start, scale = self.start.astype(distance.dtype), self.scale.astype(distance.dtype)
        share = k.astype(distance.dtype) / max(passes - 2, 1)
        c = jnp.exp(jnp.log(start) + jnp.minimum(share, 1) * (jnp.log(scale) - jnp.log(start)))
        return (1 + distance / c) ** -2


class Diagnostics(eqx.Module):
    """What an update reports beside the belief.

    `log_likelihood` of the innovations and `nis`, the normalised innovation squared (chi-square with
    `used * m` degrees of freedom for a consistent filter), are taken at the last linearisation: Laplace's
    approximation, exact for one pass of a linear model. After robust weights both are those of the `used` items,
    each counted in full, about the robust estimate; of the `measured` ones the gate has left out the others.
    `distance` is m2 of every item after the update under the measurement noise alone (zero where masked).

    An update that overflows, as that of a filter which has long lost the track may, is not taken: the belief
    stays as predicted, `used` is zero and `log_likelihood` minus infinity.
    """

    log_likelihood: Float[Array, ""]
    nis: Float[Array, ""]
    measured: Int[Array, ""]
    used: Int[Array, ""]
    weights: Float[Array, " n"]
    distance: Float[Array, " n"]

    @classmethod
    def of(
        cls,
        nis: Float[Array, ""],
        log_det: Float[Array, ""],
        components: int,
        measured: Bool[Array, " n"],
        used: Bool[Array, " n"],
        *,
        weights: Float[Array, " n"],
        distance: Float[Array, " n"],
    ) -> "Diagnostics":
        """Of an update whose `used` items have `components` each; `log_det` is that of the innovations' covariance."""
        count = jnp.sum(used)
        constant = components * jnp.log(2 * jnp.pi).astype(nis.dtype) * count.astype(nis.dtype)
        return cls(-(nis + log_det + constant) / 2, nis, jnp.sum(measured), count, weights, distance)


def unless_overflown(
    prior: Taken, posterior: Taken, diagnostics: Diagnostics
) -> tuple[Taken, Diagnostics, Bool[Array, ""]]:
    """The posterior and its diagnostics, or where any number of these is not finite the prior; and whether all are."""
    numbers = [x.ravel() for x in jax.tree.leaves((posterior, diagnostics)) if jnp.issubdtype(x.dtype, jnp.inexact)]
    finite = jnp.isfinite(jnp.concatenate(numbers)).all()
    belief = jax.tree.map(lambda new, old: jnp.where(finite, new, old), posterior, prior)
    nothing = jax.tree.map(lambda x: jnp.where(finite, x, 0), diagnostics)
    unlikely = jnp.where(finite, diagnostics.log_likelihood, -jnp.inf)
    return belief, eqx.tree_at(lambda d: d.log_likelihood, nothing, unlikely), finite
