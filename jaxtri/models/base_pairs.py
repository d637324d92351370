"""The trifocal transfer with base frames per track: every point has its own two, or more, already known.

With the base poses fixed, the point that they fix is constant, and the transfer to the current frame is the
projection of that homogeneous point. What the noise of the base observations does to the point is carried along as
`spread`. The items are these points, so a frame costs O(N) with 12 error components.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from jaxtri.checks import number
from jaxtri.geometry.pose import difference, local, matrix, retract
from jaxtri.geometry.trifocal import point_from_bases, project
from jaxtri.models.motion import Twist, twist_noise
from jaxtri.models.point_noise import SIGMA


class BasePoint(NamedTuple):
    """A world point fixed by a base pair, or by more.

    Attributes:
        point: (4,) homogeneous, scene units.
        spread: (4, p) its derivative with respect to p independent errors of the standard deviation of an image point:
            of a pair those of its two observations.
    """

    point: Float[Array, "4"]
    spread: Float[Array, "4 p"]


def base_point(first: Float[Array, "2"], second: Float[Array, "2"], pose1: SE3, pose2: SE3) -> BasePoint:
    """The point seen at `first` from `pose1` and at `second` from `pose2` (world to camera)."""

    def point(pair: Array) -> Array:
        R1, R2 = pose1.rotation().as_matrix(), pose2.rotation().as_matrix()
        return point_from_bases(pair[:2], pair[2:], R1, pose1.translation(), R2, pose2.translation())

    pair = jnp.concatenate([first, second])
    return BasePoint(point(pair), jax.jacfwd(point)(pair))


class BasePairs(eqx.Module):
    """Model of `jaxtri.ekf` for a camera on SE(3) whose items are `BasePoint`s; every field is a leaf.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length. The same in all
            three views.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2, in camera axes.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(**SIGMA)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)

    def retract(self, mean: Twist, delta: Float[Array, "12"]) -> Twist:
        """The state moved by an error."""
        return retract(mean, delta)

    def local(self, mean: Twist, other: Twist) -> Float[Array, "12"]:
        """The error that takes `mean` to `other`."""
        return local(mean, other)

    def difference(self, mean: Twist, other: Twist) -> Float[Array, "12"]:
        """`local`, to first order where the two coincide."""
        return difference(mean, other)

    def predict(self, mean: Twist, dt: Float[Array, ""]) -> Twist:
        """Constant velocity in camera axes."""
        return mean.advance(dt)

    def process_noise(self, mean: Twist, dt: Float[Array, ""]) -> Float[Array, "12 12"]:
        """White acceleration."""
        return twist_noise(self.acceleration, self.angular_acceleration, dt)

    def _project(self, mean: Twist, X: Float[Array, "4"]) -> Float[Array, "2"]:
        return project(X, mean.pose.rotation().as_matrix(), mean.pose.translation())

    def measure(self, mean: Twist, item: BasePoint) -> Float[Array, "2"]:
        """The transferred point, normalised."""
        return self._project(mean, item.point)

    # The same measurements as a linear map and a division: `jaxtri.filters.projective`.

    @property
    def support(self) -> np.ndarray:
        """Error components that a measurement depends on: those of the pose, not of the twist."""
        return np.arange(6)

    def matrix(self, mean: Twist) -> Float[Array, "3 4"]:
        """The camera matrix."""
        return jnp.concatenate([matrix(mean.pose.rotation()), mean.pose.translation()[:, None]], axis=1)

    def coordinates(self, item: BasePoint) -> Float[Array, "4"]:
        """The homogeneous point, which the camera matrix projects."""
        return item.point

    def spread(self, item: BasePoint) -> Float[Array, "4 p"]:
        """Derivative of the homogeneous point with respect to its own errors."""
        return item.spread

    def noise(self, mean: Twist, item: BasePoint) -> Float[Array, "2 2"]:
        """sigma^2 (I + J J'), J the derivative of the transfer with respect to the point's own errors."""
        J = jax.jacfwd(lambda X: self._project(mean, X))(item.point) @ item.spread
        return jnp.square(self.sigma) * (jnp.eye(2, dtype=J.dtype) + J @ J.T)
