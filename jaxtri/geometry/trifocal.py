"""Three views: the transfer of a point of two views to the third.

By matrices, which is equal up to a factor to the transfer by the trifocal tensor, as the paper writes it: the tests
have both.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.geometry.epipolar import dehomogenise, homogeneous, inverse_depth


def transfer(
    u1: Float[Array, "2"],
    u2: Float[Array, "2"],
    R2: Float[Array, "3 3"],
    T2: Float[Array, "3"],
    R3: Float[Array, "3 3"],
    T3: Float[Array, "3"],
    e2: Float[Array, "3"],
) -> Float[Array, "2"]:
    """Where the point seen at `u1` in view 1 and at `u2` in view 2 stands in view 3.

    Views 2 and 3 have the poses X2 = R2 X1 + T2 and X3 = R3 X1 + T3; `e2` is the epipole of view 2
    (homogeneous, T2 up to scale) that orients the line through `u2`; the paper freezes it at the start of a
    segment. Source: Yu et al. 2006, eqs 7-9, in matrix form: R3 u + lambda T3.
    """
    return dehomogenise(R3 @ homogeneous(u1) + inverse_depth(u1, u2, R2, T2, e2) * T3)


def point_from_bases(
    u1: Float[Array, "2"],
    u2: Float[Array, "2"],
    R1: Float[Array, "3 3"],
    T1: Float[Array, "3"],
    R2: Float[Array, "3 3"],
    T2: Float[Array, "3"],
) -> Float[Array, "4"]:
    """Homogeneous world point of a base pair with the poses (R1, T1) and (R2, T2), world to camera.

    The transfer to any view (R, T) is then `dehomogenise(R X[:3] + X[3] T)`. The last component is the
    inverse depth in view 1, so that a point at infinity is harmless. Its epipole is that of the pair itself.
    """
    R = R2 @ R1.T
    T = T2 - R @ T1
    inverse = inverse_depth(u1, u2, R, T, T)
    return jnp.concatenate([R1.T @ (homogeneous(u1) - inverse * T1), inverse[None]])


def project(X: Float[Array, "4"], R: Float[Array, "3 3"], T: Float[Array, "3"]) -> Float[Array, "2"]:
    """Normalised image point of a homogeneous world point in the view (R, T)."""
    return dehomogenise(R @ X[:3] + X[3] * T)
