"""Rotations and poses as points on a manifold; the groups themselves are jaxlie's.

A state of any filter is a pytree whose leaves are jaxlie groups or arrays. Its error is one flat vector:
a left perturbation `exp(delta) R` for a group (an error in camera axes, since poses map world to camera)
and a sum for an array, in the order of the leaves.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3, MatrixLieGroup
from jaxtyping import Array, Float

Point = TypeVar("Point")


def _is_group(leaf: Any) -> bool:
    return isinstance(leaf, MatrixLieGroup)


def _dim(leaf: Any) -> int:
    return leaf.tangent_dim if _is_group(leaf) else leaf.size


def tangent_dim(point: Any) -> int:
    """Dimension of the error of a point."""
    return sum(_dim(leaf) for leaf in jax.tree.leaves(point, is_leaf=_is_group))


_SMALL = 0.25  # radians^2: up to here a series of nine terms is exact


def _series(x: Array, coefficients: Iterable[float]) -> Array:
    """A polynomial by Horner's rule, constant term first."""
    *others, total = coefficients
    for c in others[::-1]:
        total = total * x + c
    return jnp.asarray(total)


def _near_or_far(x: Array, near: Callable[[Array], Any], far: Callable[[Array], Any]) -> Any:
    """One of two functions of a square, by its size.

    A branch, not a selection: each division, root or sine is a kernel of its own to XLA, and takes longer to start
    than to run. `far` gets 1 in place of what is near, for where both are evaluated after all (`vmap`).
    """
    small = x < _SMALL
    return jax.lax.cond(small, near, lambda x: far(jnp.where(small, 1.0, x)), x)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _stumpff(n: int, z: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """c_n and c_n+1 of Stumpff, n even: c_n(z) = 1/n! - z/(n + 2)! + z^2/(n + 4)! - ...

    So c_0 = cos a, c_1 = sin(a) / a, c_2 = (1 - cos a) / a^2, c_3 = (a - sin a) / a^3 for z = a^2. Their derivatives
    are each other: what a derivative adds is another two numbers. Source: Battin 1999, section 4.5.
    """

    def near(z: Array) -> tuple[Array, ...]:
        return tuple(_series(z, ((-1) ** k / math.factorial(2 * k + m) for k in range(9))) for m in (n, n + 1))

    def far(z: Array) -> tuple[Array, ...]:
        angle = jnp.sqrt(z)
        c = [jnp.cos(angle), jnp.sin(angle) / angle]
        for m in range(n):
            c.append((1 / math.factorial(m) - c[m]) / z)
        return tuple(c[-2:])

    return _near_or_far(z, near, far)


@_stumpff.defjvp
def _stumpff_jvp(n: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple, tuple]:
    (z,), (dz,) = primals, tangents
    c, d = _stumpff(n, z)
    e, f = _stumpff(n + 2, z)
    return (c, d), ((n * e - d) / 2 * dz, ((n + 1) * f - e) / 2 * dz)


def _squared(v: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(v * v)


def exp_rotation(theta: Float[Array, "3"]) -> SO3:
    """The rotation of a vector: the exponential of SO(3). jaxlie's, in a tenth of the kernels."""
    w, s = _stumpff(0, _squared(theta) / 4)
    return SO3(jnp.concatenate([w[None], s / 2 * theta]))


def log_rotation(rotation: SO3) -> Float[Array, "3"]:
    """The vector of a rotation, given by a unit quaternion: the inverse of `exp_rotation`; singular at pi."""
    w, v = rotation.wxyz[0], rotation.wxyz[1:]
    flip = jnp.where(w < 0, -2.0, 2.0).astype(v.dtype)

    def near(x: Array) -> Array:  # asin(n) / n
        return _series(x, (math.comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(22)))

    def far(x: Array) -> Array:
        n = jnp.sqrt(x)
        return jnp.arctan2(n, jnp.abs(w)) / n

    return flip * _near_or_far(_squared(v), near, far) * v


# The products of quaternions, q_k = sum T_kij a_i b_j, and of vectors: sums over a constant are one kernel, in a
# derivative too, where components taken apart and put together again are a dozen.
_QUATERNION = np.zeros((4, 4, 4))
_CROSS = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_k, _i, _j], _CROSS[_k, _j, _i] = 1, -1
_QUATERNION[0] = np.diag([1, -1, -1, -1])
_QUATERNION[1:, 1:, 1:] = _CROSS
_QUATERNION[1:, 0, 1:] = _QUATERNION[1:, 1:, 0] = np.eye(3)


def _bilinear(table: np.ndarray, a: Array, b: Array) -> Array:
    return jnp.sum(table.astype(a.dtype) * a[:, None] * b, axis=(1, 2))


def cross_matrix(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """[v]x, which takes x to v x x."""
    return jnp.sum(_CROSS.transpose(0, 2, 1).astype(v.dtype) * v, axis=2)


def product(a: SO3, b: SO3) -> SO3:
    """The rotation b, then a; of unit length again, to which the square of what both were off is wanting."""
    q = _bilinear(_QUATERNION, a.wxyz, b.wxyz)
    # A step of Newton's: without normalising a chain of products leaves the group, 2.4 times further every frame.
    return SO3(q * jax.lax.stop_gradient(1.5 - 0.5 * _squared(q)))


def matrix(rotation: SO3) -> Float[Array, "3 3"]:
    """The matrix of a unit quaternion."""
    w, v = rotation.wxyz[0], rotation.wxyz[1:]
    return 2 * (v[:, None] * v + w * cross_matrix(v)) + (2 * w * w - 1) * np.eye(3, dtype=v.dtype)


def exp_pose(xi: Float[Array, "6"]) -> SE3:
    """The pose of a twist (linear, angular): the exponential of SE(3).

    Not jaxlie's (1.5): below 1e-5 radians, 3e-3 in float32, it takes the rotation for the left Jacobian, so
    that its derivative at zero is twice the right one; and it returns float64 wherever that is enabled.
    """
    rho, theta = xi[:3], xi[3:]
    once, twice = _stumpff(2, _squared(theta))
    turned = jnp.cross(theta, rho)
    return compose(exp_rotation(theta), rho + once * turned + twice * jnp.cross(theta, turned))


# Bernoulli numbers of index 2 k over (2 k)!, without their signs, which alternate
_BERNOULLI = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600)


def log_pose(pose: SE3) -> Float[Array, "6"]:
    """The twist (linear, angular) of a pose: the inverse of `exp_pose`; singular at an angle of pi."""
    theta, T = log_rotation(pose.rotation()), pose.translation()

    def far(x: Array) -> Array:
        half = jnp.sqrt(x) / 2
        return (1 - half * jnp.cos(half) / jnp.sin(half)) / x

    twice = _near_or_far(_squared(theta), lambda x: _series(x, _BERNOULLI), far)
    turned = jnp.cross(theta, T)
    return jnp.concatenate([T - turned / 2 + twice * jnp.cross(theta, turned), theta])


def adjoint(pose: SE3) -> Float[Array, "6 6"]:
    """The matrix that carries a twist through a pose: pose exp(xi) = exp(adjoint xi) pose."""
    R, T = matrix(pose.rotation()), pose.translation()
    return jnp.block([[R, cross_matrix(T) @ R], [jnp.zeros_like(R), R]])


def inverse_left_jacobian(xi: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Derivative of `log_pose(exp_pose(e) pose)` with respect to e at zero, xi the twist of the pose.

    Bernoulli's numbers times powers of the algebra's adjoint: exact to 1e-13 for turns up to a radian, 1e-8 up to two.
    Source: Barfoot 2017, section 7.1.5.
    """
    v, w = cross_matrix(xi[:3]), cross_matrix(xi[3:])
    ad = jnp.block([[w, v], [jnp.zeros_like(w), w]])
    squared, eye = ad @ ad, jnp.eye(6, dtype=xi.dtype)
    even = jnp.zeros_like(eye)
    for k, b in enumerate(reversed(_BERNOULLI)):
        even = squared @ ((-b if k % 2 else b) * eye + even)
    return eye - ad / 2 + even


def multiply(a: SE3, b: SE3) -> SE3:
    """The pose b, then a. jaxlie's own product gives float64 for float32 wherever that is enabled."""
    R = a.rotation()
    return compose(product(R, b.rotation()), matrix(R) @ b.translation() + a.translation())


def relative(a: SE3, b: SE3) -> SE3:
    """The pose that takes the camera of pose a to that of pose b: b a^-1."""
    R = product(b.rotation(), a.rotation().inverse())
    return compose(R, b.translation() - matrix(R) @ a.translation())


def _moved(element: SO3 | SE3, delta: Array) -> SO3 | SE3:
    if isinstance(element, SE3):
        return multiply(exp_pose(delta), element)
    return product(exp_rotation(delta), element)


def _log(a: SO3 | SE3, b: SO3 | SE3) -> Array:
    if isinstance(a, SE3):
        assert isinstance(b, SE3)
        return log_pose(relative(a, b))
    assert isinstance(b, SO3)
    return log_rotation(product(b, a.inverse()))


def _chord(a: SO3 | SE3, b: SO3 | SE3) -> Array:
    if isinstance(a, SE3):
        assert isinstance(b, SE3)
        theta = _chord(a.rotation(), b.rotation())
        T = b.translation()
        return jnp.concatenate([T - a.translation() + cross_matrix(T) @ theta, theta])
    assert isinstance(b, SO3)
    return 2 * _bilinear(_QUATERNION, b.wxyz, a.inverse().wxyz)[1:]


def retract(point: Point, delta: Float[Array, " d"]) -> Point:
    """The point moved by the error `delta`: `exp(delta) R` for groups, a sum for arrays."""
    leaves, tree = jax.tree.flatten(point, is_leaf=_is_group)
    moved, start = [], 0
    for leaf in leaves:
        part = delta[start : start + _dim(leaf)]
        start += _dim(leaf)
        moved.append(_moved(leaf, part) if _is_group(leaf) else leaf + part.reshape(leaf.shape))
    return jax.tree.unflatten(tree, moved)


def local(point: Point, other: Point) -> Float[Array, " d"]:
    """The error that takes `point` to `other`: the inverse of `retract`; singular at an angle of pi."""
    return _by_leaf(_log, point, other)


def difference(point: Point, other: Point) -> Float[Array, " d"]:
    """`local`, to first order where the two coincide: its derivative there for a part of the work."""
    return _by_leaf(_chord, point, other)


def _by_leaf(error: Callable[[Any, Any], Array], point: Point, other: Point) -> Array:
    leaves = jax.tree.leaves(point, is_leaf=_is_group)
    others = jax.tree.leaves(other, is_leaf=_is_group)
    pairs = zip(leaves, others, strict=True)
    return jnp.concatenate([error(a, b) if _is_group(a) else (b - a).ravel() for a, b in pairs])


def matrix_from_euler(yaw_pitch_roll: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of the paper's angles: R = Rz(roll) Ry(yaw) Rx(pitch), radians.

    With the camera's axes (x right, y down, z forward) pitch turns about x, yaw about y, roll about z.
    Singular at a yaw of a quarter turn. Source: Yu et al. 2006, section IV (the order is not stated there).
    """
    # Written out: with its derivative a fifth of the kernels of three rotations multiplied.
    (cy, cx, cz), (sy, sx, sz) = jnp.cos(yaw_pitch_roll), jnp.sin(yaw_pitch_roll)
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return jnp.stack([x for row in rows for x in row]).reshape(3, 3)


def euler_from_matrix(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The angles (yaw, pitch, roll) of a rotation matrix, radians: the inverse of `matrix_from_euler`."""
    yaw = -jnp.arcsin(jnp.clip(R[2, 0], -1, 1))
    return jnp.stack([yaw, jnp.arctan2(R[2, 1], R[2, 2]), jnp.arctan2(R[1, 0], R[0, 0])])


def rotation_matrix(rotation: SO3 | Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of a rotation, whichever way a state holds it: an SO(3) element or the paper's angles."""
    return matrix(rotation) if isinstance(rotation, SO3) else matrix_from_euler(rotation)


def identity(dtype: Any) -> SE3:
    """The pose of the world itself, in a float type of the caller's: jaxlie's own is of the default one."""
    return jax.tree.map(lambda x: x.astype(dtype), SE3.identity())


def compose(rotation: SO3, translation: Float[Array, "3"]) -> SE3:
    """The pose of a rotation and a translation."""
    return SE3.from_rotation_and_translation(rotation, translation)


def shear(T: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Takes errors (T, R), a sum in T and `exp(delta) R` in R, to the left perturbation of the pose.

    exp(xi) of a pose also turns its T: rho = delta_T + T x delta_R. Its inverse is `shear(-T)`.
    """
    eye, zero = jnp.eye(3, dtype=T.dtype), jnp.zeros((3, 3), T.dtype)
    return jnp.block([[eye, cross_matrix(T)], [zero, eye]])
