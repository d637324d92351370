"""Motion models: a pose, its velocity, and the noise of what the velocity leaves out."""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from jaxtri.geometry.pose import exp_pose, matrix_from_euler, multiply


class Kinematics(eqx.Module):
    """Pose and velocity of a camera, translation and rotation apart: 12 error components.

    In the order of the paper's state vector, T, v, R, omega (world to camera); `rotation` is an SO(3)
    element, or the paper's (yaw, pitch, roll) with their rates. Source: Yu et al. 2006, section IV.
    """

    translation: Float[Array, "3"]
    velocity: Float[Array, "3"]
    rotation: SO3 | Float[Array, "3"]
    angular_velocity: Float[Array, "3"]

    def advance(self, dt: Float[Array, ""]) -> "Kinematics":
        """The state at constant velocity `dt` later."""
        turn = self.angular_velocity * dt
        if isinstance(self.rotation, SO3):
            rotation = (SO3.exp(turn) @ self.rotation).normalize()
        else:
            rotation = self.rotation + turn
        return Kinematics(self.translation + self.velocity * dt, self.velocity, rotation, self.angular_velocity)

    @property
    def R(self) -> Float[Array, "3 3"]:
        """Rotation matrix, world to camera."""
        return self.rotation.as_matrix() if isinstance(self.rotation, SO3) else matrix_from_euler(self.rotation)


class Twist(eqx.Module):
    """Pose and body velocity of a camera on SE(3): 12 error components.

    Constant velocity in the camera's own axes, so that neither a turn nor the distance from the world's
    origin disturbs the prediction.
    """

    pose: SE3
    twist: Float[Array, "6"]

    def advance(self, dt: Float[Array, ""]) -> "Twist":
        """The state at constant twist `dt` later."""
        return Twist(multiply(exp_pose(self.twist * dt), self.pose).normalize(), self.twist)


def acceleration_noise(
    linear: Float[Array, ""], angular: Float[Array, ""], dt: Float[Array, ""]
) -> Float[Array, "12 12"]:
    """Process noise of a white acceleration, constant within a step, in the error order of `Kinematics`.

    `linear` and `angular` are its standard deviations (per frame squared). `Twist` keeps another order: see
    `twist_noise`. Source: Bar-Shalom, Li & Kirubarajan 2001, section 6.3.2.
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
