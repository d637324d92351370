"""The two-step filter: the pose given the structure, then the structure given the pose.

Each half takes the other half's estimate as it stands, so a frame costs O(N) and the correlation of pose and
structure is lost. Source: Yu, Wong & Chang, "Recursive three-dimensional model reconstruction based on
Kalman filtering", SMC-B 2005; Yu et al. 2006 compare with it.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtri.checks import checked, number
from jaxtri.estimation.two_view import TwoView
from jaxtri.filters import ekf
from jaxtri.filters.scan import checkpointed
from jaxtri.geometry.pose import local, retract
from jaxtri.geometry.trifocal import project
from jaxtri.models.depth import Bank, Depth, WorldPoint
from jaxtri.models.motion import Kinematics, acceleration_noise, at_rest, from_two_view


class KnownStructure(eqx.Module):
    """Model of `jaxtri.ekf` for the pose before a scene that is known: its items are `WorldPoint`s.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2.
        structure_noise: The covariance of the points is counted in R (static). Off, they are taken as exact, as
            published.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(converter=number)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)
    structure_noise: bool = eqx.field(static=True, default=True)

    def retract(self, mean: Kinematics, delta: Float[Array, "12"]) -> Kinematics:
        """The state moved by an error."""
        return retract(mean, delta)

    def local(self, mean: Kinematics, other: Kinematics) -> Float[Array, "12"]:
        """The error that takes `mean` to `other`."""
        return local(mean, other)

    def predict(self, mean: Kinematics, dt: Float[Array, ""]) -> Kinematics:
        """Constant velocity."""
        return mean.advance(dt)

    def process_noise(self, mean: Kinematics, dt: Float[Array, ""]) -> Float[Array, "12 12"]:
        """White acceleration."""
        return acceleration_noise(self.acceleration, self.angular_acceleration, dt)

    def measure(self, mean: Kinematics, item: WorldPoint) -> Float[Array, "2"]:
        """The projected point, normalised."""
        return project(item.point, mean.R, mean.translation)

    def noise(self, mean: Kinematics, item: WorldPoint) -> Float[Array, "2 2"]:
        """sigma^2 I, plus what the point's own covariance adds where `structure_noise` is on."""
        noise = jnp.square(self.sigma) * jnp.eye(2, dtype=item.point.dtype)
        if self.structure_noise:
            J = jax.jacfwd(lambda X: project(X, mean.R, mean.translation))(item.point)
            noise = noise + J @ item.covariance @ J.T
        return noise


class TwoStep(eqx.Module):
    """The two filters, taken in turn.

    Attributes:
        pose: The model of the pose, given the points.
        depth: The model of the points, given the pose.
    """

    pose: KnownStructure
    depth: Depth


class TwoStepBelief(eqx.Module):
    """What is believed of the camera, and of the points.

    Attributes:
        camera: Pose and velocity, with the covariance (12, 12) of their errors.
        bank: The points, in slots.
    """

    camera: ekf.Belief[Kinematics]
    bank: Bank


@checked
def step(
    model: TwoStep,
    belief: TwoStepBelief,
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    dt: Float[Array, ""] | float = 1.0,
    *,
    passes: int | None = None,
    robust: ekf.Robust | None = None,
) -> tuple[TwoStepBelief, ekf.Diagnostics]:
    """One frame: the pose from the points as they are believed, then the points from the new pose."""
    items = model.depth.world(belief.bank)
    camera, diagnostics = ekf.step(model.pose, belief.camera, items, observed, mask, dt, passes=passes, robust=robust)
    pose, covariance = camera.mean.pose, camera.mean.pose_covariance(camera.covariance)
    if not model.pose.structure_noise:
        covariance = None
    bank = model.depth.step(belief.bank, pose, observed, mask, covariance, dt)
    return TwoStepBelief(camera, bank), diagnostics


@checked
def filter(
    model: TwoStep,
    belief: TwoStepBelief,
    observed: Float[Array, "t n 2"],
    mask: Bool[Array, "t n"],
    *,
    passes: int | None = None,
    robust: ekf.Robust | None = None,
    block: int = 1,
) -> tuple[TwoStepBelief, ekf.Diagnostics]:
    """Beliefs and diagnostics of all frames, stacked along a leading axis t."""

    def body(carry: TwoStepBelief, frame: tuple) -> tuple[TwoStepBelief, tuple]:
        carry, diagnostics = step(model, carry, *frame, passes=passes, robust=robust)
        return carry, (carry, diagnostics)

    return checkpointed(body, belief, (observed, mask), block)[1]


def planar_start(
    model: TwoStep,
    first: Float[Array, "n 2"],
    z_init: Float[Array, ""] | float,
    *,
    relative_sd: Float[Array, ""] | float = 0.5,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
) -> TwoStepBelief:
    """The start as published, at the first frame: a plane at depth `z_init`, the camera at rest."""
    camera = at_rest(first.dtype, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd)
    return TwoStepBelief(camera, model.depth.plane(first, camera.mean.pose, z_init, relative_sd))


def two_view_start(
    model: TwoStep,
    two_view: TwoView,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    frames: Float[Array, ""] | float = 1.0,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
) -> TwoStepBelief:
    """The belief at the second of two frames, from their relative pose and the points triangulated with it."""
    motion, C, E, own = from_two_view(
        two_view, frames=frames, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd
    )
    camera = ekf.Belief(motion, E @ C @ E.T + jnp.diag(own))
    return TwoStepBelief(camera, model.depth.triangulated(two_view, first, second))
