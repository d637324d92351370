"""Symmetric positive matrices in blocks, of which each meets only the next: factorised, solved and inverted in O(m)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Tridiagonal(NamedTuple):
    """Normal equations of the poses, symmetric and block tridiagonal, s = 6 b.

    Attributes:
        diagonal: (c + 1, s, s).
        above: (c, s, s) a block with the next.
        pull: (c + 1, s) the right side.
    """

    diagonal: Float[Array, "m s s"]
    above: Float[Array, "c s s"]
    pull: Float[Array, "m s"]


class Factors(NamedTuple):
    """A block tridiagonal matrix as L L', scaled to a unit diagonal.

    Attributes:
        scales: (c + 1, s) roots of the diagonal.
        roots: (c + 1, s, s) diagonal blocks of L.
        across: (c, s, s) transposed blocks below them.
    """

    scales: Float[Array, "m s"]
    roots: Float[Array, "m s s"]
    across: Float[Array, "c s s"]

    @classmethod
    def of(cls, equations: Tridiagonal, damping: Float[Array, ""]) -> "Factors":
        """Of the matrix with its diagonal raised by the share `damping`, and by rounding."""
        diagonal = jnp.diagonal(equations.diagonal, axis1=1, axis2=2)
        scales = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
        s = scales.shape[1]
        ridge = (damping + scales.size * float(jnp.finfo(scales.dtype).eps)) * jnp.eye(s, dtype=scales.dtype)
        blocks = equations.diagonal / (scales[:, :, None] * scales[:, None]) + ridge
        above = equations.above / (scales[:-1, :, None] * scales[1:, None])

        def next_(root: Array, part: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            block, above = part
            across = jax.scipy.linalg.solve_triangular(root, above, lower=True)
            new = jnp.linalg.cholesky(block - across.T @ across)
            return new, (new, across)

        first = jnp.linalg.cholesky(blocks[0])
        _, (roots, across) = jax.lax.scan(next_, first, (blocks[1:], above))
        return cls(scales, jnp.concatenate([first[None], roots]), across)

    def solve(self, right: Float[Array, "m s"]) -> Float[Array, "m s"]:
        """The solution."""
        return self.up(self.down(right))

    def down(self, right: Float[Array, "m s"]) -> Float[Array, "m s"]:
        """L^-1 of a right side."""

        def next_(before: Array, part: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            root, across, b = part
            y = jax.scipy.linalg.solve_triangular(root, b - across.T @ before, lower=True)
            return y, y

        parts = self.roots, jnp.concatenate([jnp.zeros_like(self.across[:1]), self.across]), right / self.scales
        return jax.lax.scan(next_, jnp.zeros_like(right[0]), parts)[1]

    def up(self, y: Float[Array, "m s"]) -> Float[Array, "m s"]:
        """L'^-1 of what `down` gives."""

        def next_(after: Array, part: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            root, across, y = part
            x = jax.scipy.linalg.solve_triangular(root, y - across @ after, lower=True, trans=1)
            return x, x

        parts = self.roots, jnp.concatenate([self.across, jnp.zeros_like(self.across[:1])]), y
        return jax.lax.scan(next_, jnp.zeros_like(y[0]), parts, reverse=True)[1] / self.scales

    def covariances(self) -> Float[Array, "m s s"]:
        """The diagonal blocks of the inverse. Source: Takahashi, Fagan & Chin 1973; here, a smoother's recursion."""
        eye = jnp.eye(self.scales.shape[1], dtype=self.scales.dtype)

        def before(after: Array, part: tuple[Array, Array]) -> tuple[Array, Array]:
            root, across = part
            gain = jax.scipy.linalg.solve_triangular(root, across, lower=True, trans=1)
            own = jax.scipy.linalg.cho_solve((root, True), eye)
            covariance = own + gain @ after @ gain.T
            return covariance, covariance

        last = jax.scipy.linalg.cho_solve((self.roots[-1], True), eye)
        _, others = jax.lax.scan(before, last, (self.roots[:-1], self.across), reverse=True)
        blocks = jnp.concatenate([others, last[None]])
        return blocks / (self.scales[:, :, None] * self.scales[:, None])
