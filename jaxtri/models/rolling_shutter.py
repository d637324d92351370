"""Base frames per track, and a picture whose rows are exposed one after the other, while the camera moves on.

Each point is seen from where the camera is at its own time. To first order in that time the camera matrix grows by the
twist times it, so that the image is that of a linear map of twice the coordinates: the moments of
`jaxtri.filters.projective` serve as they are. What a frame shows then tells of the twist, too.
Source: Hedborg, Forssen, Felsberg & Ringaby 2012, for one velocity a frame.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtri.geometry.pose import cross_matrix
from jaxtri.geometry.trifocal import dehomogenise
from jaxtri.models.base_pairs import BasePairs
from jaxtri.models.motion import Twist


class LatePoint(NamedTuple):
    """A world point, and when it is exposed.

    Attributes:
        point: (4,) homogeneous, scene units.
        spread: (4, p) its derivative with respect to p independent errors of the standard deviation of an image point.
        late: Frames from the time of the frame to that of the row in which the point is seen.
    """

    point: Float[Array, "4"]
    spread: Float[Array, "4 p"]
    late: Float[Array, ""]


class RollingShutter(BasePairs):
    """Model of `jaxtri.ekf` as `BasePairs`, whose items are `LatePoint`s.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2, in camera axes.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2.
    """

    def measure(self, mean: Twist, item: LatePoint) -> Float[Array, "2"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The transferred point at its own time, normalised."""
        return dehomogenise(self.matrix(mean) @ self.coordinates(item))

    @property
    def support(self) -> np.ndarray:
        """Error components that a measurement depends on: those of the pose, and of the twist."""
        return np.arange(12)

    def matrix(self, mean: Twist) -> Float[Array, "3 8"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The camera matrix, and its rate."""
        M = super().matrix(mean)
        rate = cross_matrix(mean.twist[3:]) @ M
        return jnp.concatenate([M, rate.at[:, 3].add(mean.twist[:3])], axis=1)

    def coordinates(self, item: LatePoint) -> Float[Array, "8"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The homogeneous point, and so many times it as it is late."""
        return jnp.concatenate([item.point, item.late * item.point])

    def spread(self, item: LatePoint) -> Float[Array, "8 p"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Derivative of these with respect to the point's own errors."""
        return jnp.concatenate([item.spread, item.late * item.spread])

    def noise(self, mean: Twist, item: LatePoint) -> Float[Array, "2 2"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """sigma^2 (I + J J'), J the derivative of the transfer with respect to the point's own errors."""
        X, dX = (self.matrix(mean) @ x for x in (self.coordinates(item), self.spread(item)))
        J = (dX[:2] - (X[:2] / X[2])[:, None] * dX[2]) / X[2]
        return jnp.square(self.sigma) * (jnp.eye(2, dtype=J.dtype) + J @ J.T)


def at_frame_time(
    mean: Twist, camera_points: Float[Array, "n 4"], observed: Float[Array, "n 2"], late: Float[Array, " n"]
) -> Float[Array, "n 2"]:
    """Where image points would have been at the time of the frame; `camera_points` are about what they are of.

    These are homogeneous, in the axes of the camera at that time.
    """
    X, w = camera_points[:, :3], camera_points[:, 3:]
    moved = X + late[:, None] * (jnp.cross(mean.twist[3:], X) + w * mean.twist[:3])
    return observed - (moved[:, :2] / moved[:, 2:] - X[:, :2] / X[:, 2:])
