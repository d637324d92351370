"""Three views: the trifocal tensor, and the transfer of a point of two views to the third.

Two forms of the same transfer stand here: by the tensor, as the paper writes it, and by matrices. They are
equal up to a factor, and the tests prove it; the filters use the second.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.geometry.epipolar import dehomogenise, homogeneous, inverse_depth


def tensor(P2: Float[Array, "3 4"], P3: Float[Array, "3 4"]) -> Float[Array, "3 3 3"]:
    """Trifocal tensor T[i, j, k] of the cameras [I | 0], P2 and P3: a^j_i b^k_4 - a^j_4 b^k_i.

    Source: Yu et al. 2006, eq. 8; Hartley & Zisserman 2004, eq. 15.1.
    """
    return jnp.einsum("ji,k->ijk", P2[:, :3], P3[:, 3]) - jnp.einsum("j,ki->ijk", P2[:, 3], P3[:, :3])


def transfer_by_tensor(T: Float[Array, "3 3 3"], u1: Float[Array, "2"], line2: Float[Array, "3"]) -> Float[Array, "3"]:
    """Homogeneous point of view 3: u''^k = u^i l'_j T_i^jk. Source: Yu et al. 2006, eq. 7."""
    return jnp.einsum("i,j,ijk->k", homogeneous(u1), line2, T)


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
