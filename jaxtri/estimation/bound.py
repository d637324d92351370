"""How well a camera's poses can be known at all: the Cramer-Rao bound of structure and motion.

All poses and all points are unknown, nothing is assumed of the motion. The Fisher information comes from the
Jacobian of the projections, the points are eliminated by the Schur complement. The gauge: the first camera is
the world, and the length of the base line to the second is exact.

Source: Kay 1993, section 3.9 (normal errors); Triggs et al. 2000, sections 6 and 9 (Schur complement, gauge).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import checked
from jaxtri.estimation.two_view import tangent_basis
from jaxtri.geometry.epipolar import dehomogenise, safe_norm

_RIDGE = 1e-13  # over variances scaled to 1: a point that is not fixed in some direction stays invertible


class _Normal(NamedTuple):
    """Blocks of the Fisher information, in units of 1 / sigma^2; t frames without the first."""

    poses: Float[Array, "t 6 6"]
    mixed: Float[Array, "t n 6 3"]
    points: Float[Array, "t n 3 3"]
    first: Float[Array, "n 3 3"]  # of the points, from the first frame
    basis: Float[Array, "6 6"]  # of the second frame's errors, its first column along the base line


@checked
def filtering_bound(
    points: Float[Array, "n 3"],
    rotations: Float[Array, "t 3 3"],
    translations: Float[Array, "t 3"],
    sigma: Float[Array, ""] | float,
    mask: Bool[Array, "t n"] | None = None,
    *,
    frames: Int[Array, " k"] | None = None,
) -> Float[Array, "k 6 6"]:
    """Smallest covariance of the pose of a frame that any unbiased filter can reach from frames up to it.

    `points` are in the world, poses world to camera, the first of them the identity. `sigma` is the noise of a
    normalised image point: noise_px / focal length. `mask` is False where a point is not seen. Errors are (T, R): a sum
    in T, `exp(delta) R` in R. `frames` are the k frames asked for, by default all but the first two (the first is the
    gauge). A frame costs O(n t^2 + t^3).
    """
    normal = _normal(points, rotations, translations, mask)
    count = len(rotations) - 1
    cumulative = normal.first + jnp.cumsum(normal.points, axis=0)

    def at(frame: Int[Array, ""]) -> Float[Array, "6 6"]:
        last = frame - 1
        S = _reduced(normal, cumulative[last], jnp.arange(count) <= last)
        E = jax.lax.dynamic_update_slice(jnp.zeros((6 * count, 6), S.dtype), jnp.eye(6, dtype=S.dtype), (6 * last, 0))
        block = E.T @ _solve(S, E)
        return jnp.where(last == 0, _second(normal, block), block)

    return jnp.square(sigma) * jax.lax.map(at, jnp.arange(2, count + 1) if frames is None else frames)


@checked
def smoothing_bound(
    points: Float[Array, "n 3"],
    rotations: Float[Array, "t 3 3"],
    translations: Float[Array, "t 3"],
    sigma: Float[Array, ""] | float,
    mask: Bool[Array, "t n"] | None = None,
) -> Float[Array, "t-1 6 6"]:
    """Smallest covariance of every pose from all frames; of all but the first, which is the gauge.

    Arguments as of `filtering_bound`.
    """
    normal = _normal(points, rotations, translations, mask)
    count = len(rotations) - 1
    S = _reduced(normal, normal.first + jnp.sum(normal.points, axis=0), jnp.ones(count, bool))
    inverse = _solve(S, jnp.eye(6 * count, dtype=S.dtype)).reshape(count, 6, count, 6)
    blocks = inverse[jnp.arange(count), :, jnp.arange(count)]
    return jnp.square(sigma) * blocks.at[0].set(_second(normal, blocks[0]))


def _normal(
    points: Float[Array, "n 3"],
    rotations: Float[Array, "t 3 3"],
    translations: Float[Array, "t 3"],
    mask: Bool[Array, "t n"] | None,
) -> _Normal:
    def seen(error: Array, X: Array, R: Array, T: Array) -> Array:
        turned = R @ X
        return dehomogenise(turned + jnp.cross(error[3:], turned) + T + error[:3])

    jacobian = jax.vmap(jax.vmap(jax.jacfwd(seen, argnums=(0, 1)), (None, 0, None, None)), (None, None, 0, 0))
    A, B = jacobian(jnp.zeros(6, points.dtype), points, rotations, translations)
    if mask is not None:
        A, B = (jnp.where(mask[..., None, None], x, 0.0) for x in (A, B))
    n = translations[1] / safe_norm(translations[1])
    basis = jnp.eye(6, dtype=points.dtype).at[:3, :3].set(jnp.concatenate([n[:, None], tangent_basis(n)], axis=1))
    A = A.at[1].set((A[1] @ basis).at[..., 0].set(0.0))
    V = jnp.einsum("tnij,tnik->tnjk", B, B)
    U = jnp.einsum("tnij,tnik->tjk", A[1:], A[1:]).at[0, 0, 0].set(1.0)
    return _Normal(U, jnp.einsum("tnij,tnik->tnjk", A[1:], B[1:]), V[1:], V[0], basis)


def _reduced(normal: _Normal, V: Float[Array, "n 3 3"], used: Bool[Array, " t"]) -> Float[Array, "s s"]:
    """Information on the poses, s = 6t, with the points eliminated; unused frames are exact."""
    t = len(used)
    # A point that no frame has seen yet has no variance: it is scaled by 1, and says nothing.
    s = jnp.sqrt(jnp.where(jnp.diagonal(V, axis1=1, axis2=2) > 0, jnp.diagonal(V, axis1=1, axis2=2), 1.0))
    L = jnp.linalg.cholesky(V / (s[:, :, None] * s[:, None, :]) + _RIDGE * jnp.eye(3, dtype=V.dtype))
    W = jnp.where(used[:, None, None, None], normal.mixed, 0.0) / s[:, None, :]
    Y = jax.vmap(lambda L, w: jax.scipy.linalg.solve_triangular(L, w.T, lower=True))(
        L, jnp.moveaxis(W, 1, 0).reshape(len(V), 6 * t, 3)
    )
    Y = Y.reshape(3 * len(V), 6 * t)
    U = jnp.where(used[:, None, None], normal.poses, jnp.eye(6, dtype=V.dtype))
    S = -Y.T @ Y
    at = 6 * jnp.arange(t)[:, None, None]
    rows, columns = at + jnp.arange(6)[:, None], at + jnp.arange(6)
    return S.at[rows, columns].add(U)


def _second(normal: _Normal, block: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """The second frame's covariance in the errors (T, R), with none along the base line, whose length is exact."""
    block = block.at[0].set(0.0).at[:, 0].set(0.0)
    return normal.basis @ block @ normal.basis.T


def _solve(S: Float[Array, "s s"], right: Float[Array, "s k"]) -> Float[Array, "s k"]:
    s = 1 / jnp.sqrt(jnp.diagonal(S))
    factor = jax.scipy.linalg.cho_factor(S * jnp.outer(s, s), lower=True)
    return s[:, None] * jax.scipy.linalg.cho_solve(factor, s[:, None] * right)
