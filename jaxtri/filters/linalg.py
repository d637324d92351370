"""Small matrices: noises whitened, covariances that may be singular, and the posterior of a prior."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtri.filters.projective import embed


def linearised(
    function: Callable[[Array], Float[Array, "*batch m"]], x: Float[Array, " d"]
) -> tuple[Float[Array, "*batch m"], Float[Array, "*batch m d"]]:
    """Value and Jacobian of a function that is evaluated once: forward mode, shared by all columns."""
    value, push = jax.linearize(function, x)
    return value, jax.vmap(push, out_axes=-1)(jnp.eye(x.size, dtype=x.dtype))


def whiten(D: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Float[Array, ""]]:
    """W with W D W' = I, and log det D, in closed form: batched LAPACK calls on tiny blocks are slow."""
    if D.shape[0] == 1:
        return 1 / jnp.sqrt(D), jnp.log(D[0, 0])
    if D.shape[0] != 2:
        L = jnp.linalg.cholesky(D)
        W = jax.scipy.linalg.solve_triangular(L, jnp.eye(D.shape[0], dtype=D.dtype), lower=True)
        return W, 2 * jnp.sum(jnp.log(jnp.diagonal(L)))
    a, b = D[0, 0], D[0, 1]
    schur = D[1, 1] - b * b / a
    first, second = 1 / jnp.sqrt(a), 1 / jnp.sqrt(schur)
    W = jnp.stack([jnp.stack([first, jnp.zeros_like(a)]), jnp.stack([-b / a * second, second])])
    return W, jnp.log(a) + jnp.log(schur)


def scales(P: Float[Array, "d d"]) -> Float[Array, " d"]:
    """Standard deviations of a covariance, to scale its coordinates by; 1 where there is no uncertainty."""
    variance = jnp.diagonal(P)
    return jnp.sqrt(jnp.where(variance > 0, variance, 1.0))


def regression(P: Float[Array, "d d"], cross: Float[Array, "d e"]) -> Float[Array, "e d"]:
    """cross' P^-1, what errors of covariance P say of others; a P that may be singular, where `cross` is zero, too."""
    s = scales(P)
    scaled, cross = P / jnp.outer(s, s), cross / s[:, None]
    # A direction without uncertainty gets no weight: rounding over the ridge, which must be far above it. What the
    # ridge takes from all others a second step gives back, up to its square.
    ridge = jnp.sqrt(jnp.finfo(P.dtype).eps)
    factors = jax.scipy.linalg.lu_factor(scaled + ridge * jnp.eye(len(P), dtype=P.dtype))
    found = jax.scipy.linalg.lu_solve(factors, cross)
    found = found + jax.scipy.linalg.lu_solve(factors, cross - scaled @ found)
    return (found / s[:, None]).T


class Inverse(NamedTuple):
    """(I + A P)^-1 of the support, and log det (I + A P)."""

    matrix: Float[Array, "s s"]
    log_det: Float[Array, ""]


class Prior(NamedTuple):
    """A prior covariance P, to be corrected by an A that is zero but for the rows and columns of the support.

    In coordinates scaled by the prior's standard deviations: without, float32 does not survive. A alone is never
    inverted (a scale it does not see leaves it rank deficient), nor is P (a pinned direction has no uncertainty),
    but I + A P of the support: once, all else is products.
    """

    P: Float[Array, "d d"]
    rows: Float[Array, "s d"]  # of P
    scales: Float[Array, " d"]
    support: np.ndarray  # (s,)

    @classmethod
    def of(cls, P: Float[Array, "d d"], support: np.ndarray) -> "Prior":
        """A covariance, whose `support` (s,) is what will be corrected."""
        s = scales(P)
        P = P / jnp.outer(s, s)
        return cls(P, P[support], s, support)

    def _scaled(self, A: Float[Array, "s s"]) -> Float[Array, "s s"]:
        s = self.scales[self.support]
        return A * jnp.outer(s, s)

    def inverse(self, A: Float[Array, "s s"]) -> Inverse:
        """(I + A P)^-1 of the support, and the logarithm of |I + A P|."""
        eye = jnp.eye(len(A), dtype=A.dtype)
        factors = jax.scipy.linalg.lu_factor(eye + self._scaled(A) @ self.rows[:, self.support])
        log_det = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(factors[0]))))
        return Inverse(jax.scipy.linalg.lu_solve(factors, eye), log_det)

    def error(self, inverse: Inverse, b: Float[Array, " s"]) -> Float[Array, " d"]:
        """(P^-1 + A)^-1 b."""
        return inverse.matrix @ (b * self.scales[self.support]) @ self.rows * self.scales

    def posterior(self, A: Float[Array, "s s"], inverse: Inverse) -> Float[Array, "d d"]:
        """(P^-1 + A)^-1.

        With G = P (I + A P)^-1 it is P - G A P. Written as a sum of squares,
        (I - G A) P (I - G A)' + G A G', which is Joseph's form, it stays positive when G is off by rounding: in
        float32 the difference does not.
        """
        A, d = self._scaled(A), len(self.P)
        G = self.rows.T @ inverse.matrix
        GA = G @ A
        left = jnp.eye(d, dtype=A.dtype) - embed(GA, self.support, d)
        covariance = left @ self.P @ left.T + GA @ G.T
        return (covariance + covariance.T) / 2 * jnp.outer(self.scales, self.scales)


def posterior_error(P: Float[Array, "d d"], A: Float[Array, "d d"], b: Float[Array, " d"]) -> Float[Array, " d"]:
    """(P^-1 + A)^-1 b, for a P that may be singular."""
    prior = Prior.of(P, np.arange(len(P)))
    return prior.error(prior.inverse(A), b)
