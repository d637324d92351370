"""Inverse covariances of what is seen along tracks, whose noise in a view keeps a part of that in the view before."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Precision(NamedTuple):
    """Inverse covariances of the tracks' residuals, tridiagonal: a view's own, and what it has with that before."""

    own: Float[Array, "k n"]
    shared: Float[Array, "k n"] | None

    @classmethod
    def of(cls, weights: Float[Array, "k n"], kept: Float[Array, "k n"] | None) -> "Precision":
        """Of the weights of what is new, and how much a residual keeps of the one before; None: nothing."""
        if kept is None:
            return cls(weights, None)
        new = weights / (1 - kept**2)
        own = new + jnp.concatenate([(new * kept**2)[1:], jnp.zeros_like(new[:1])])
        return cls(own, -new * kept)

    def __matmul__(self, x: Float[Array, "k *c n"]) -> Float[Array, "k *c n"]:
        def wide(y: Array) -> Array:
            return y.reshape(y.shape[0], *(1,) * (x.ndim - 2), y.shape[1])

        if self.shared is None:
            return wide(self.own) * x
        shared = wide(self.shared)
        after = jnp.concatenate([shared[1:] * x[1:], jnp.zeros_like(x[:1])])
        return wide(self.own) * x + shared * before(x) + after

    def of_poses(self, pose: Float[Array, "k 6 2 n"]) -> Float[Array, "s s"]:
        """What the residuals say of the poses, the points given."""
        k, n = self.own.shape
        each = pose.reshape(k, 6, 2 * n)

        def products(weights: Array, others: Array) -> Array:
            heavy = (pose[-len(weights) :] * weights[:, None, None]).reshape(len(weights), 6, 2 * n)
            return jnp.einsum("kem,kfm->kef", heavy, others)

        U = block_diagonal(products(self.own, each))
        if self.shared is None:
            return U
        below = jnp.pad(block_diagonal(products(self.shared[1:], each[:-1])), ((6, 0), (0, 6)))
        return U + below + below.T


def before(x: Array) -> Array:
    """Of each view what is in the view before it; zero in the first."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])


def block_diagonal(each: Float[Array, "k e e"]) -> Float[Array, "s s"]:
    """The matrix that has these blocks on its diagonal."""
    k, e, _ = each.shape
    return (each[:, :, None] * jnp.eye(k, dtype=each.dtype)[:, None, :, None]).reshape(k * e, k * e)
