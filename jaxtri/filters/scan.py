"""Over frames, with a reverse gradient that keeps little, and over whole runs: sequences, noise settings, trials."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxtri.errors import InputError


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


def each_frame(dt: Float[Array, " t"] | Float[Array, ""] | float | None, count: int, dtype: Any) -> Float[Array, " t"]:
    """The time steps of all frames: one for all, one for each, or 1."""
    return jnp.broadcast_to(jnp.asarray(1.0 if dt is None else dt, dtype), (count,))


def batch(run: Callable[[Any], Any], inputs: PyTree, size: int | None = None) -> PyTree:
    """`run(x)` of every x along the leading axis of `inputs`, stacked: sequences, noise settings, trials.

    `size` of them run at once (`jax.vmap`), one batch after the other, for memory that is that of one batch. By
    default one on a CPU, where more at once are from two fifths slower to a fifth faster (`benchmarks/speed.py`), and
    all on an accelerator. What the runs share, as the points of a sequence that is run with many noises, `run` closes
    over: it is kept once. Goes through `jit` and `grad`. Raises `InputError` for a size below 1.
    """
    count = jax.tree.leaves(inputs)[0].shape[0]
    automatic = 1 if jax.default_backend() == "cpu" else count
    at_once = automatic if size is None else size
    if at_once < 1:
        raise InputError(f"batches of {at_once} runs: give at least 1, or None for the machine's own")
    if at_once >= count:
        return jax.vmap(run)(inputs)
    return jax.lax.map(run, inputs, batch_size=None if at_once == 1 else at_once)
