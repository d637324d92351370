"""A scan over frames whose reverse gradient keeps little: checkpointed frame by frame, and block by block."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def checkpointed(
    body: Callable[[Any, Any], tuple[Any, Any]], carry: Any, xs: PyTree, block: int = 1
) -> tuple[Any, PyTree]:
    """`jax.lax.scan(body, carry, xs)`, of whose t steps a reverse gradient keeps t / block + block carries.

    What happened within a step is computed again, so that a gradient costs two runs and its own; with `block`
    above 1, best the root of t, the carries within a block are, too: three runs. Source: Griewank & Walther 2008,
    chapter 12.
    """
    body = jax.checkpoint(body)
    length = jax.tree.leaves(xs)[0].shape[0]
    whole = length // block * block if block > 1 else 0
    found = []
    if whole:
        blocks = jax.tree.map(lambda x: x[:whole].reshape(-1, block, *x.shape[1:]), xs)
        carry, ys = jax.lax.scan(jax.checkpoint(lambda c, x: jax.lax.scan(body, c, x)), carry, blocks)
        found.append(jax.tree.map(lambda y: y.reshape(whole, *y.shape[2:]), ys))
    if whole < length or not whole:
        carry, ys = jax.lax.scan(body, carry, jax.tree.map(lambda x: x[whole:], xs))
        found.append(ys)
    return carry, found[0] if len(found) == 1 else jax.tree.map(lambda *y: jnp.concatenate(y), *found)
