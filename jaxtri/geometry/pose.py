"""Rotations and poses as points on a manifold; the groups themselves are jaxlie's.

A state of any filter is a pytree whose leaves are jaxlie groups or arrays. Its error is one flat vector:
a left perturbation `exp(delta) R` for a group (an error in camera axes, since poses map world to camera)
and a sum for an array, in the order of the leaves.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
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


def exp_pose(xi: Float[Array, "6"]) -> SE3:
    """The pose of a twist (linear, angular): the exponential of SE(3).

    Not jaxlie's (1.5): below 1e-5 radians, 3e-3 in float32, it takes the rotation for the left Jacobian, so
    that its derivative at zero is twice the right one; and it returns float64 wherever that is enabled.
    """
    rho, theta = xi[:3], xi[3:]
    x = theta @ theta
    small = x < 0.01
    safe = jnp.where(small, 1.0, x)
    angle = jnp.sqrt(safe)
    once = jnp.where(small, (1 - x / 12 * (1 - x / 30 * (1 - x / 56))) / 2, 2 * jnp.sin(angle / 2) ** 2 / safe)
    twice = (1 - x / 20 * (1 - x / 42 * (1 - x / 72))) / 6
    twice = jnp.where(small, twice, (angle - jnp.sin(angle)) / (safe * angle))
    turned = jnp.cross(theta, rho)
    return compose(SO3.exp(theta), rho + once * turned + twice * jnp.cross(theta, turned))


def log_pose(pose: SE3) -> Float[Array, "6"]:
    """The twist (linear, angular) of a pose: the inverse of `exp_pose`; singular at an angle of pi."""
    theta, T = pose.rotation().log(), pose.translation()
    x = theta @ theta
    small = x < 0.01
    safe = jnp.where(small, 1.0, x)
    half = jnp.sqrt(safe) / 2
    twice = (1 + x / 60 * (1 + x / 42 * (1 + x / 40))) / 12
    twice = jnp.where(small, twice, (1 - half * jnp.cos(half) / jnp.sin(half)) / safe)
    turned = jnp.cross(theta, T)
    return jnp.concatenate([T - turned / 2 + twice * jnp.cross(theta, turned), theta])


def adjoint(pose: SE3) -> Float[Array, "6 6"]:
    """The matrix that carries a twist through a pose: pose exp(xi) = exp(adjoint xi) pose."""
    R, T = pose.rotation().as_matrix(), pose.translation()
    return jnp.block([[R, jnp.cross(T, R.T).T], [jnp.zeros_like(R), R]])


def multiply(a: SE3, b: SE3) -> SE3:
    """The pose b, then a. jaxlie's own product gives float64 for float32 wherever that is enabled."""
    R = a.rotation()
    return compose(R @ b.rotation(), R.as_matrix() @ b.translation() + a.translation())


def relative(a: SE3, b: SE3) -> SE3:
    """The pose that takes the camera of pose a to that of pose b: b a^-1."""
    R = b.rotation() @ a.rotation().inverse()
    return compose(R, b.translation() - R.as_matrix() @ a.translation())


def _moved(element: Any, delta: Array) -> Any:
    # Normalising every time keeps a chain of compositions on the group: without it rounding grows 2.4 times
    # a frame under a constant-velocity prediction.
    if isinstance(element, SE3):
        return multiply(exp_pose(delta), element).normalize()
    return (type(element).exp(delta) @ element).normalize()


def _difference(a: Any, b: Any) -> Array:
    return log_pose(relative(a, b)) if isinstance(a, SE3) else (b @ a.inverse()).log()


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
    leaves = jax.tree.leaves(point, is_leaf=_is_group)
    others = jax.tree.leaves(other, is_leaf=_is_group)
    return jnp.concatenate(
        [_difference(a, b) if _is_group(a) else (b - a).ravel() for a, b in zip(leaves, others, strict=True)]
    )


def matrix_from_euler(yaw_pitch_roll: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of the paper's angles: R = Rz(roll) Ry(yaw) Rx(pitch), radians.

    With the camera's axes (x right, y down, z forward) pitch turns about x, yaw about y, roll about z.
    Singular at a yaw of a quarter turn. Source: Yu et al. 2006, section IV (the order is not stated there).
    """
    yaw, pitch, roll = yaw_pitch_roll
    return (SO3.from_z_radians(roll) @ SO3.from_y_radians(yaw) @ SO3.from_x_radians(pitch)).as_matrix()


def euler_from_matrix(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The angles (yaw, pitch, roll) of a rotation matrix, radians: the inverse of `matrix_from_euler`."""
    yaw = -jnp.arcsin(jnp.clip(R[2, 0], -1, 1))
    return jnp.stack([yaw, jnp.arctan2(R[2, 1], R[2, 2]), jnp.arctan2(R[1, 0], R[0, 0])])


def rotation_matrix(rotation: SO3 | Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of a rotation, whichever way a state holds it: an SO(3) element or the paper's angles."""
    return rotation.as_matrix() if isinstance(rotation, SO3) else matrix_from_euler(rotation)


def compose(rotation: SO3, translation: Float[Array, "3"]) -> SE3:
    """The pose of a rotation and a translation."""
    return SE3.from_rotation_and_translation(rotation, translation)


def shear(T: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Takes errors (T, R), a sum in T and `exp(delta) R` in R, to the left perturbation of the pose.

    exp(xi) of a pose also turns its T: rho = delta_T + T x delta_R. Its inverse is `shear(-T)`.
    """
    eye, zero = jnp.eye(3, dtype=T.dtype), jnp.zeros((3, 3), T.dtype)
    return jnp.block([[eye, jnp.cross(T, eye).T], [zero, eye]])
