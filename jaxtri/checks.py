"""What comes in at the public doors, brought into form and checked."""

import jax
import jax.numpy as jnp
from jax import Array


def number(x: Array | float) -> Array:
    """A leaf of a definite dtype: a weakly typed one would compile once more than a plain one."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.result_type(float))
