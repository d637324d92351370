"""Missing entries: what stands in them changes nothing, NaN included, neither in values nor in gradients."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree


def seen(mask: Bool[Array, "*n"] | None, shape: tuple[int, ...]) -> Bool[Array, "*n"]:
    """The mask, or where there is none one of the given shape that leaves nothing out."""
    return jnp.ones(shape, bool) if mask is None else mask


def select(mask: Bool[Array, " n"], new: PyTree, old: PyTree) -> PyTree:
    """Entry by entry of a leading axis n: `new` where the mask is True, `old` where it is False."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)


def replace_masked(mask: Bool[Array, " n"], items: PyTree, value: float) -> PyTree:
    """Masked entries become `value` before any mathematics, so that a NaN in them changes nothing."""
    return select(mask, items, jax.tree.map(lambda x: jnp.asarray(value, x.dtype), items))


def stand_in(mask: Bool[Array, " n"], items: PyTree) -> PyTree:
    """Masked items become copies of an unmasked one, or zero where there is none.

    Not zero everywhere: a model may be singular there, and 0 * inf in its gradient would be NaN.
    """
    some = jnp.argmax(mask)
    one = jax.tree.map(lambda x: jnp.where(mask[some], x[some], jnp.zeros((), x.dtype)), items)
    return select(mask, items, one)


def safe_root(weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Square root with a zero derivative at the zero of a masked item."""
    positive = weights > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, weights, 1.0)), 0.0)
