"""Motion models: a pose, its velocity, and the noise of what the velocity leaves out."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from jaxtri.estimation.two_view import TwoView
from jaxtri.filters.model import Belief
from jaxtri.geometry.pose import (
    compose,
    euler_from_matrix,
    exp_pose,
    exp_rotation,
    identity,
    matrix_from_euler,
    multiply,
    product,
    rotation_matrix,
    shear,
)

# The error components of `Kinematics` that are those of the pose: translation, then rotation.
POSE_ROWS = np.array([0, 1, 2, 6, 7, 8])


class Kinematics(eqx.Module):
    """Pose and velocity of a camera, translation and rotation apart: 12 error components.

    The errors are in the order of the fields, which is that of the paper's state vector (T, v, R, omega). Source: Yu et
    al. 2006, section IV.

    Attributes:
        translation: (3,) T of the pose X_camera = R X_world + T, scene units.
        velocity: (3,) its rate, scene units per frame.
        rotation: R of the pose, world to camera: an SO(3) element, or the paper's angles (yaw, pitch, roll), radians.
        angular_velocity: (3,) rate of the rotation in camera axes, or of the angles; radians per frame.
    """

    translation: Float[Array, "3"]
    velocity: Float[Array, "3"]
    rotation: SO3 | Float[Array, "3"]
    angular_velocity: Float[Array, "3"]

    def advance(self, dt: Float[Array, ""]) -> "Kinematics":
        """The state at constant velocity `dt` later."""
        turn = self.angular_velocity * dt
        if isinstance(self.rotation, SO3):
            rotation = product(exp_rotation(turn), self.rotation)
        else:
            rotation = self.rotation + turn
        return Kinematics(self.translation + self.velocity * dt, self.velocity, rotation, self.angular_velocity)

    @property
    def R(self) -> Float[Array, "3 3"]:
        """Rotation matrix, world to camera."""
        return rotation_matrix(self.rotation)

    @property
    def pose(self) -> SE3:
        """The pose, world to camera."""
        rotation = self.rotation if isinstance(self.rotation, SO3) else SO3.from_matrix(self.R)
        return compose(rotation, self.translation)

    def pose_covariance(self, covariance: Float[Array, "d d"]) -> Float[Array, "6 6"]:
        """Covariance of the pose, as that of its left perturbation (linear, angular).

        `covariance` is that of a whole state, whose first 12 error components are those of this motion.
        """
        J = shear(self.translation)
        if not isinstance(self.rotation, SO3):
            # From a rate of the angles to a rate of the rotation, in camera axes: [w]x = dR R'.
            dR = jax.jacfwd(matrix_from_euler)(self.rotation)
            W = jnp.einsum("ijk,lj->ilk", dR, self.R)
            J = J @ jax.scipy.linalg.block_diag(jnp.eye(3, dtype=J.dtype), jnp.stack([W[2, 1], W[0, 2], W[1, 0]]))
        return J @ covariance[POSE_ROWS][:, POSE_ROWS] @ J.T


class Twist(eqx.Module):
    """Pose and body velocity of a camera on SE(3): 12 error components.

    Constant velocity in the camera's own axes, so that neither a turn nor the distance from the world's
    origin disturbs the prediction.

    Attributes:
        pose: World to camera, translation in scene units. Its error is a left perturbation (linear, angular).
        twist: (6,) velocity (linear, angular) in camera axes, scene units and radians per frame.
    """

    pose: SE3
    twist: Float[Array, "6"]

    def advance(self, dt: Float[Array, ""]) -> "Twist":
        """The state at constant twist `dt` later."""
        return Twist(multiply(exp_pose(self.twist * dt), self.pose), self.twist)


class MotionStart(NamedTuple):
    """Pose and velocity from a two-view estimate.

    The errors of `motion` are `lever @ e + n`: e are the errors of the estimate, n are independent of these.

    Attributes:
        motion: Pose and velocity at the second view.
        covariance: (6, 6) of e, in the order of `motion` (translation, rotation).
        lever: (12, 6) what an error of the estimate does to pose and velocity.
        variance: (12,) of n: of the velocity, zero for the pose.
    """

    motion: Kinematics
    covariance: Float[Array, "6 6"]
    lever: Float[Array, "12 6"]
    variance: Float[Array, "12"]


def from_two_view(
    two_view: TwoView,
    *,
    frames: Float[Array, ""] | float,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
    euler: bool = False,
) -> MotionStart:
    """The motion at the second of two views, `frames` after the first.

    The velocity is the motion between the two views over `frames`. `velocity_sd` and `angular_velocity_sd` (scene units
    and radians per frame) are the standard deviations of the error that it has beside that of the pose. With `euler`
    rotations are the paper's yaw, pitch and roll.
    """
    T, R, C = two_view.translation, two_view.rotation, two_view.covariance
    dtype = T.dtype
    rotation, rate = R, R.log() / frames
    if euler:
        rotation = euler_from_matrix(R.as_matrix())
        rate = rotation / frames
        # From the error in camera axes to an error of the angles.
        J = jax.jacfwd(lambda d: euler_from_matrix((SO3.exp(d) @ R).as_matrix()))(jnp.zeros(3, dtype))
        J = jax.scipy.linalg.block_diag(jnp.eye(3, dtype=dtype), J)
        C = J @ C @ J.T
    lever = jnp.zeros((12, 6), dtype).at[POSE_ROWS, jnp.arange(6)].set(1)
    lever = lever.at[jnp.array([3, 4, 5, 9, 10, 11]), jnp.arange(6)].set(1 / frames)
    return MotionStart(
        Kinematics(T, T / frames, rotation, rate), C, lever, _velocity(dtype, velocity_sd, angular_velocity_sd)
    )


def at_rest(
    dtype: jnp.dtype, *, velocity_sd: Float[Array, ""] | float, angular_velocity_sd: Float[Array, ""] | float
) -> Belief[Kinematics]:
    """The camera in the first frame, which is the world: its pose is exact, its velocity is zero, give or take.

    `velocity_sd` and `angular_velocity_sd` are the standard deviations of the velocity, scene units and radians per
    frame.
    """
    zero = jnp.zeros(3, dtype)
    rotation = identity(dtype).rotation()
    variance = _velocity(dtype, velocity_sd, angular_velocity_sd)
    return Belief(Kinematics(zero, zero, rotation, zero), jnp.diag(variance))


def _velocity(dtype: jnp.dtype, linear_sd: Array | float, angular_sd: Array | float) -> Float[Array, "12"]:
    variance = jnp.zeros(12, dtype)
    return variance.at[3:6].set(jnp.square(linear_sd)).at[9:12].set(jnp.square(angular_sd))


def acceleration_noise(
    linear: Float[Array, ""], angular: Float[Array, ""], dt: Float[Array, ""]
) -> Float[Array, "12 12"]:
    """Process noise of a white acceleration, constant within a step, in the error order of `Kinematics`.

    `linear` and `angular` are its standard deviations, scene units and radians per frame squared. `Twist` keeps another
    order: see `twist_noise`. Source: Bar-Shalom, Li & Kirubarajan 2001, section 6.3.2.
    """
    step = jnp.outer(jnp.stack([dt**2 / 2, dt]), jnp.stack([dt**2 / 2, dt]))
    zero = jnp.zeros((6, 6), step.dtype)
    block = jnp.kron(step, jnp.eye(3, dtype=step.dtype))
    return jnp.block([[linear**2 * block, zero], [zero, angular**2 * block]])


def twist_noise(linear: Float[Array, ""], angular: Float[Array, ""], dt: Float[Array, ""]) -> Float[Array, "12 12"]:
    """Process noise of a white acceleration in the error order of `Twist`: pose (linear, angular), then twist."""
    step = jnp.outer(jnp.stack([dt**2 / 2, dt]), jnp.stack([dt**2 / 2, dt]))
    variances = jnp.concatenate([jnp.full(3, 1.0, step.dtype) * linear**2, jnp.full(3, 1.0, step.dtype) * angular**2])
    return jnp.kron(step, jnp.diag(variances))
