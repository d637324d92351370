"""The full-covariance filter: pose, velocity and one parameter per point in one state.

The reference of the field for accuracy, at O(N^3) a frame and O(N^2) of memory. Source: Azarbayejani &
Pentland, "Recursive estimation of motion, structure, and focal length", PAMI 1995, in the parameters of this
library; Yu et al. 2006 compare with it.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtri.checks import number
from jaxtri.estimation.two_view import TwoView
from jaxtri.filters.model import Belief
from jaxtri.geometry.epipolar import dehomogenise, homogeneous
from jaxtri.geometry.pose import local, retract
from jaxtri.models.depth import triangulate
from jaxtri.models.motion import Kinematics, acceleration_noise, at_rest, from_two_view


class StructureAndMotionState(eqx.Module):
    """Motion of the camera, a parameter per point, and the focal length if it is to be estimated.

    It has 12 + n error components, one more with `log_focal`.

    Attributes:
        motion: Pose and velocity of the camera.
        parameters: (n,) inverse depth, or depth, of each point in the first camera, which is the world; 1 / scene units
            or scene units.
        log_focal: Logarithm of the true over the assumed focal length; None where the focal length is known.
    """

    motion: Kinematics
    parameters: Float[Array, " n"]
    log_focal: Float[Array, ""] | None = None


class Sight(NamedTuple):
    """An item: where a point was first seen, and its place in the state.

    Attributes:
        ray: (2,) normalised image point in the first frame.
        slot: Index of its parameter in the state.
    """

    ray: Float[Array, "2"]
    slot: Int[Array, ""]


class StructureAndMotion(eqx.Module):
    """Model of `jaxtri.ekf` whose items are `Sight`s; every field but the last two is a leaf.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2.
        ray_noise: The noise of the first image point is counted in R (static). Off, that image point is taken as exact,
            as published.
        inverse: The parameters are inverse depths (static). Off, they are depths, with which the filter diverges in
            nearly every trial of the paper's experiment when it starts from a plane.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(converter=number)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)
    ray_noise: bool = eqx.field(static=True, default=True)
    inverse: bool = eqx.field(static=True, default=True)

    def retract(self, mean: StructureAndMotionState, delta: Float[Array, " d"]) -> StructureAndMotionState:
        """The state moved by an error."""
        return retract(mean, delta)

    def local(self, mean: StructureAndMotionState, other: StructureAndMotionState) -> Float[Array, " d"]:
        """The error that takes `mean` to `other`."""
        return local(mean, other)

    def predict(self, mean: StructureAndMotionState, dt: Float[Array, ""]) -> StructureAndMotionState:
        """Constant velocity before a static scene."""
        return StructureAndMotionState(mean.motion.advance(dt), mean.parameters, mean.log_focal)

    def process_noise(self, mean: StructureAndMotionState, dt: Float[Array, ""]) -> Float[Array, "d d"]:
        """White acceleration; the scene and the focal length do not change."""
        rest = mean.parameters.size + (mean.log_focal is not None)
        motion = acceleration_noise(self.acceleration, self.angular_acceleration, dt)
        return jnp.zeros((12 + rest, 12 + rest), motion.dtype).at[:12, :12].set(motion)

    def _project(self, mean: StructureAndMotionState, ray: Float[Array, "2"], slot: Int[Array, ""]) -> Array:
        parameter, motion = mean.parameters[slot], mean.motion
        focal = jnp.ones((), ray.dtype) if mean.log_focal is None else jnp.exp(mean.log_focal)
        x = motion.R @ homogeneous(ray / focal)
        x = x + parameter * motion.translation if self.inverse else parameter * x + motion.translation
        return dehomogenise(x) * focal

    def measure(self, mean: StructureAndMotionState, item: Sight) -> Float[Array, "2"]:
        """The projected point, normalised by the assumed focal length."""
        return self._project(mean, item.ray, item.slot)

    def noise(self, mean: StructureAndMotionState, item: Sight) -> Float[Array, "2 2"]:
        """sigma^2 (I + J J'), J the derivative with respect to the ray; sigma^2 I without `ray_noise`."""
        noise = jnp.eye(2, dtype=item.ray.dtype)
        if self.ray_noise:
            J = jax.jacfwd(lambda ray: self._project(mean, ray, item.slot))(item.ray)
            noise = noise + J @ J.T
        return jnp.square(self.sigma) * noise


def sights(first: Float[Array, "n 2"]) -> Sight:
    """The items of a filter whose first frame, the world, saw the normalised image points `first`."""
    return Sight(first, jnp.arange(len(first)))


def planar_start(
    first: Float[Array, "n 2"],
    z_init: Float[Array, ""] | float,
    *,
    relative_sd: Float[Array, ""] | float = 0.5,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
    reference: Int[Array, ""] | int = 0,
    focal_sd: Float[Array, ""] | float | None = None,
    inverse: bool = True,
) -> Belief[StructureAndMotionState]:
    """The start as published, at the first frame: a plane at depth `z_init`, errors uncorrelated, the camera at rest.

    The depth of the point `reference` is taken as exact, which fixes the scale. Source: Azarbayejani &
    Pentland 1995, section III; Yu et al. 2006, eq. 12.
    """
    n, dtype = len(first), first.dtype
    z_init = jnp.asarray(z_init, dtype)
    parameters = jnp.full(n, 1.0, dtype) * (1 / z_init if inverse else z_init)
    camera = at_rest(dtype, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd)
    scatter = (relative_sd * parameters).at[reference].set(0.0)
    P = jax.scipy.linalg.block_diag(camera.covariance, jnp.diag(scatter**2))
    return _with_focal(StructureAndMotionState(camera.mean, parameters), P, focal_sd)


def two_view_start(
    two_view: TwoView,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    sigma: Float[Array, ""],
    *,
    frames: Float[Array, ""] | float = 1.0,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
    focal_sd: Float[Array, ""] | float | None = None,
    inverse: bool = True,
) -> Belief[StructureAndMotionState]:
    """The belief at the second of two frames, from their relative pose, with the joint covariance of the whole state.

    `first` and `second` are normalised image points with the noise `sigma`. Each point is triangulated; its error is a
    linear function of those of the pose and of its own two observations, so the points are correlated with the pose,
    the velocity and each other. The length of the base line is exact, which fixes the scale. The focal length enters
    uncorrelated.
    """
    motion, C, lever, own = from_two_view(
        two_view, frames=frames, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd
    )
    parameters, by_pose, by_noise = triangulate(two_view, first, second, inverse=inverse)
    E = jnp.concatenate([lever, by_pose])
    own = jnp.concatenate([own, jnp.square(sigma) * jnp.sum(by_noise**2, axis=1)])
    return _with_focal(StructureAndMotionState(motion, parameters), E @ C @ E.T + jnp.diag(own), focal_sd)


def _with_focal(
    state: StructureAndMotionState, P: Float[Array, "d d"], sd: Float[Array, ""] | float | None
) -> Belief[StructureAndMotionState]:
    if sd is None:
        return Belief(state, P)
    state = StructureAndMotionState(state.motion, state.parameters, jnp.zeros((), P.dtype))
    return Belief(state, jax.scipy.linalg.block_diag(P, jnp.full((1, 1), sd, P.dtype) ** 2))
