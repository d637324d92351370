"""Two views: the essential matrix, its residual, and the point that two views fix."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_divide(numerator: Array, denominator: Array, smallest: float = 1e-12) -> Array:
    """Quotient whose denominator is kept away from zero, so that values and gradients stay finite."""
    small = jnp.abs(denominator) < smallest
    # The input of the unsafe branch is replaced, not its output: 0 * inf in the gradient would be NaN.
    return numerator / jnp.where(small, jnp.where(denominator < 0, -smallest, smallest), denominator)


def safe_norm(x: Float[Array, "... d"], smallest: float = 1e-12) -> Float[Array, " ..."]:
    """Euclidean norm along the last axis with a zero gradient at zero."""
    squared = jnp.sum(x * x, axis=-1)
    zero = squared < smallest**2
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def homogeneous(u: Float[Array, "... 2"]) -> Float[Array, "... 3"]:
    """The point with a one appended."""
    return jnp.concatenate([u, jnp.ones_like(u[..., :1])], axis=-1)


def dehomogenise(x: Float[Array, "... 3"]) -> Float[Array, "... 2"]:
    """The point divided by its last component; finite at infinity."""
    return safe_divide(x[..., :2], x[..., 2:])


def essential(R: Float[Array, "3 3"], T: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Essential matrix E = [T]x R of the relative pose X2 = R X1 + T, so that u2' E u1 = 0.

    Source: Hartley & Zisserman 2004, eq. 9.12.
    """
    return jnp.cross(T, R.T).T


def sampson(E: Float[Array, "3 3"], u1: Float[Array, "2"], u2: Float[Array, "2"]) -> Float[Array, ""]:
    """Signed Sampson distance of a pair from the epipolar constraint, in units of `u`.

    To first order the residual of the maximum-likelihood triangulation: for equal noise sigma in all four
    coordinates its standard deviation is sigma. Source: Hartley & Zisserman 2004, eq. 11.9.
    """
    x1, x2 = homogeneous(u1), homogeneous(u2)
    l2, l1 = E @ x1, E.T @ x2
    return safe_divide(x2 @ l2, safe_norm(jnp.stack([l1[0], l1[1], l2[0], l2[1]])))


def inverse_depth(
    u1: Float[Array, "2"],
    u2: Float[Array, "2"],
    R: Float[Array, "3 3"],
    T: Float[Array, "3"],
    e2: Float[Array, "3"],
) -> Float[Array, ""]:
    """Inverse depth in view 1 of the point on the ray of `u1` that lies on the line through `u2`.

    The line is `perpendicular_line(u2, e2)`. Finite (and zero) for a point at infinity; meaningless, yet
    finite, where `u2` is the epipole. Source: Yu et al. 2006, eqs 7-9, written as a triangulation.
    """
    line = perpendicular_line(u2, e2)
    return safe_divide(-(line @ (R @ homogeneous(u1))), line @ T)


def perpendicular_line(u2: Float[Array, "2"], e2: Float[Array, "3"]) -> Float[Array, "3"]:
    """The line through `u2` perpendicular to the one that joins it to the epipole `e2` (homogeneous).

    Never the epipolar line itself, the one choice that transfers nothing. Its normal has unit length (zero
    where `u2` is the epipole). Source: Yu et al. 2006, eq. 9.
    """
    along = e2[:2] - u2 * e2[2]
    normal = safe_divide(along, safe_norm(along))
    return jnp.stack([normal[0], normal[1], -(normal @ u2)])


def parallax(u1: Float[Array, "2"], u2: Float[Array, "2"], R: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Angle between the rays of `u1` and `u2`, radians, once the rotation X2 = R X1 is removed."""
    a, b = R @ homogeneous(u1), homogeneous(u2)
    return jnp.arctan2(safe_norm(jnp.cross(a, b)), a @ b)
