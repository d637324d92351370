"""The paper's filter: the pose of a camera, measured by the trifocal transfer from two base frames.

The structure of the scene is not in the state: a frame costs O(N). Three modes: `default` (SO(3), base noise
in R, several passes, the second base pose considered), `paper` (yaw-pitch-roll, constant R, one pass, the
second base pose refined), and `consistent`, the default's model under `jaxtri.schmidt`: the noise of the base
points considered, so that every frame may refine the second base pose and nothing is counted twice.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SO3
from jaxtyping import Array, Bool, Float

from jaxtri.checks import number
from jaxtri.estimation.two_view import TwoView, sensitivity
from jaxtri.filters import schmidt
from jaxtri.filters.linalg import linearised
from jaxtri.filters.model import Belief
from jaxtri.filters.schmidt import Measured
from jaxtri.geometry.epipolar import homogeneous, inverse_depth, perpendicular_line, safe_norm
from jaxtri.geometry.pose import difference, local, retract, rotation_matrix
from jaxtri.geometry.trifocal import transfer
from jaxtri.models.motion import POSE_ROWS, Kinematics, MotionStart, acceleration_noise, from_two_view
from jaxtri.models.point_noise import SIGMA

SHORTEST = 1e-12  # length of a base line, scene units: what is divided by a shorter one stays finite


class Mode(NamedTuple):
    """What the modes of the filter differ in; pass each part where its name stands.

    Attributes:
        euler: Rotations are the paper's yaw, pitch and roll instead of SO(3): an argument of `start`.
        base_noise: The noise of the base points is in R, instead of a constant R: a field of `Trifocal`.
        refine_base: The second base pose is refined in every frame instead of considered: a field of `Trifocal`.
        passes: Linearisations of an update: an argument of `ekf.filter`.
    """

    euler: bool
    base_noise: bool
    refine_base: bool
    passes: int


DEFAULT = Mode(euler=False, base_noise=True, refine_base=False, passes=4)
PAPER = Mode(euler=True, base_noise=False, refine_base=True, passes=1)


class TrifocalState(eqx.Module):
    """Pose and velocity of the current frame and pose of the second base frame: 18 error components.

    The world is the camera of the first base frame. Source: Yu et al. 2006, section IV.

    Attributes:
        motion: Pose and velocity of the current frame.
        base_translation: (3,) T of the second base frame, world to camera, scene units. Its length is the gauge.
        base_rotation: R of the second base frame, world to camera: an SO(3) element or the paper's angles (3,), as in
            `motion`.
    """

    motion: Kinematics
    base_translation: Float[Array, "3"]
    base_rotation: SO3 | Float[Array, "3"]


class Trifocal(eqx.Module):
    """Model of `jaxtri.ekf` whose items are point pairs (u, u') of the two base frames, in one array of 4.

    All fields but the last two are leaves and may be tuned. Lengths are in scene units, times in frames.

    Every frame uses the same noise of the base points again. A second base pose that is refined as in the paper takes
    it for new information each time, and its covariance ends ten times too small. Where it is considered, it is counted
    with the covariance of the start and left alone.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length. The same in all
            three views.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2. Higher trusts the
            prediction less.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2. As `acceleration`.
        base_drift: Standard deviation of the second base pose's drift per frame, in radians and base lines. 0 unless
            the pose is refined and its covariance is to stay open to new frames.
        epipole: (3,) epipole of the second base frame, homogeneous, as known at the start: its translation T, usually.
        base_noise: The noise of the base points is counted in R (static). Off, R is constant, as in the paper: in a
            prototype with several passes rotations were then more than four times less accurate.
        refine_base: The second base pose is refined in every frame instead of considered (static). On, as in the paper,
            rotations are 2.5 % more accurate on its experiment, and the covariance is ten times too small.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(**SIGMA)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)
    base_drift: Float[Array, ""] = eqx.field(converter=number)
    epipole: Float[Array, "3"]
    base_noise: bool = eqx.field(static=True, default=True)
    refine_base: bool = eqx.field(static=True, default=False)

    @property
    def considered(self) -> Bool[np.ndarray, "18"] | None:
        """Error components that are counted but not corrected: those of the second base pose, unless it is refined."""
        return None if self.refine_base else np.arange(18) >= 12

    def retract(self, mean: TrifocalState, delta: Float[Array, "18"]) -> TrifocalState:
        """The state moved by an error; the length of the base line is the gauge and stays."""
        moved = retract(mean, delta)
        T2 = moved.base_translation
        before, after = jnp.sum(mean.base_translation**2), jnp.sum(T2 * T2)
        usable = (before > 0) & (after > 0)
        stretch = jnp.where(usable, before, 1.0) / jnp.where(usable, after, 1.0)
        return TrifocalState(moved.motion, T2 * jnp.sqrt(stretch), moved.base_rotation)

    def local(self, mean: TrifocalState, other: TrifocalState) -> Float[Array, "18"]:
        """The error that takes `mean` to `other`."""
        return local(mean, other)

    def difference(self, mean: TrifocalState, other: TrifocalState) -> Float[Array, "18"]:
        """`local`, to first order where the two coincide."""
        return difference(mean, other)

    def predict(self, mean: TrifocalState, dt: Float[Array, ""]) -> TrifocalState:
        """Constant velocity; the base frame stays. Source: Yu et al. 2006, eqs 5 and 10."""
        return TrifocalState(mean.motion.advance(dt), mean.base_translation, mean.base_rotation)

    def process_noise(self, mean: TrifocalState, dt: Float[Array, ""]) -> Float[Array, "18 18"]:
        """White acceleration, and a drift of the second base pose that leaves the scale alone."""
        n = mean.base_translation / safe_norm(mean.base_translation)
        eye = jnp.eye(3, dtype=n.dtype)
        drift = jnp.square(self.base_drift) * dt
        length = safe_norm(mean.base_translation) ** 2
        motion = acceleration_noise(self.acceleration, self.angular_acceleration, dt)
        return jax.scipy.linalg.block_diag(motion, drift * length * (eye - jnp.outer(n, n)), drift * eye)

    def _transfer(self, mean: TrifocalState, pair: Float[Array, "4"]) -> Float[Array, "2"]:
        R2, T2 = rotation_matrix(mean.base_rotation), mean.base_translation
        return transfer(pair[:2], pair[2:], R2, T2, mean.motion.R, mean.motion.translation, self.epipole)

    def measure(self, mean: TrifocalState, item: Float[Array, "4"]) -> Float[Array, "2"]:
        """The transferred point, normalised. Source: Yu et al. 2006, eqs 6-9."""
        return self._transfer(mean, item)

    def noise(self, mean: TrifocalState, item: Float[Array, "4"]) -> Float[Array, "2 2"]:
        """sigma^2 (I + J J'), J the derivative of the transfer with respect to the two base points.

        Without `base_noise` it is sigma^2 I, as in the paper.
        """
        noise = jnp.eye(2, dtype=item.dtype)
        if self.base_noise:
            J = jax.jacfwd(lambda pair: self._transfer(mean, pair))(item)
            noise = noise + J @ J.T
        return jnp.square(self.sigma) * noise

    # The same measurements as a linear map and a division: `jaxtri.filters.projective`.

    @property
    def support(self) -> np.ndarray:
        """Error components that a measurement depends on: those of the two poses, not of the velocity."""
        return np.concatenate([POSE_ROWS, np.arange(12, 18)])

    def matrix(self, mean: TrifocalState) -> Float[Array, "3 9"]:
        """The trifocal tensor, over the length of the base line. Source: Yu et al. 2006, eqs 7 and 8."""
        T2, T = mean.base_translation, mean.motion.translation
        R2, R = rotation_matrix(mean.base_rotation), mean.motion.R
        tensor = T2[:, None] * R[:, None] - R2 * T[:, None, None]
        return tensor.reshape(3, 9) / jnp.maximum(safe_norm(self.epipole), SHORTEST)

    def coordinates(self, item: Float[Array, "4"]) -> Float[Array, "9"]:
        """Products of the line through the second base point with the first base point, both homogeneous."""
        return jnp.outer(perpendicular_line(item[2:], self.epipole), homogeneous(item[:2])).ravel()

    def spread(self, item: Float[Array, "4"]) -> Float[Array, "9 p"]:
        """Derivative of `coordinates` with respect to the two base points; no columns without `base_noise`."""
        return jax.jacfwd(self.coordinates)(item) if self.base_noise else jnp.zeros((9, 0), item.dtype)

    def measured(self, mean: TrifocalState, items: Float[Array, "n 4"], moved: Float[Array, "n 4"]) -> Measured:
        """All transferred points, for `jaxtri.schmidt`: the noise of the base points is an error of the items."""
        pairs = items + moved

        def predicted(error: Array) -> Array:
            mean_ = self.retract(mean, error)
            return jax.vmap(lambda pair: self._transfer(mean_, pair))(pairs)

        y, H = linearised(predicted, jnp.zeros(18, items.dtype))
        J = jax.vmap(jax.jacfwd(lambda pair: self._transfer(mean, pair)))(pairs)
        return Measured(y, H, J)

    def item_noise(self, mean: TrifocalState, items: Float[Array, "n 4"]) -> Float[Array, "n 4 4"]:
        """Covariance of the noise of each pair of base points."""
        return jnp.broadcast_to(jnp.square(self.sigma) * jnp.eye(4, dtype=items.dtype), (len(items), 4, 4))


def start(
    two_view: TwoView,
    *,
    frames: Float[Array, ""] | float = 1.0,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
    euler: bool = False,
) -> Belief[TrifocalState]:
    """The belief at the second base frame, `frames` after the first, from a two-view estimate.

    The current pose and the base pose are one pose at that moment: its covariance enters both blocks fully correlated.
    The velocity is the motion between the two frames over `frames`. `velocity_sd` and `angular_velocity_sd` (scene
    units and radians per frame) are the standard deviations of the error that it has beside that of the pose. With
    `euler` rotations are the paper's yaw, pitch and roll.
    """
    motion = from_two_view(
        two_view, frames=frames, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd, euler=euler
    )
    state, E, own = _with_base(motion)
    return Belief(state, E @ motion.covariance @ E.T + own)


def consistent_start(
    two_view: TwoView,
    pairs: Float[Array, "n 4"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""],
    *,
    frames: Float[Array, ""] | float = 1.0,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
) -> schmidt.ConsiderBelief[TrifocalState]:
    """As `start`, for `jaxtri.schmidt` with the pairs as items: the error of the pose comes from their noise.

    `mask` marks the pairs that the two-view estimate was made from, all of its data. `sigma` is the noise of a
    normalised image point.
    """
    motion = from_two_view(two_view, frames=frames, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd)
    state, E, own = _with_base(motion)
    S = sensitivity(two_view, pairs[:, :2], pairs[:, 2:], mask, sigma)
    return schmidt.ConsiderBelief(state, own, jnp.einsum("de,nep->dnp", E, S))


def _with_base(start: MotionStart) -> tuple[TrifocalState, Float[Array, "18 6"], Float[Array, "18 18"]]:
    """The state at the second base frame, and where its error comes from.

    Returns the state, the matrix that takes an error of the two-view estimate to one of the state, and the covariance
    of the part of the state's error that does not come from the estimate.
    """
    motion = start.motion
    E = jnp.concatenate([start.lever, jnp.eye(6, dtype=start.lever.dtype)])
    return TrifocalState(motion, motion.translation, motion.rotation), E, jnp.diag(jnp.pad(start.variance, (0, 6)))


def informative(
    state: TrifocalState,
    pairs: Float[Array, "n 4"],
    sigma: Float[Array, ""],
    smallest_snr: Float[Array, ""] | float = 0.0,
) -> Bool[Array, " n"]:
    """Pairs in front of the camera whose inverse depth is above `smallest_snr` times its standard deviation.

    A point near the epipole of the second frame has no depth, wherever it is. `pairs` are normalised image points with
    the noise `sigma`.
    """
    R2, T2 = rotation_matrix(state.base_rotation), state.base_translation

    def signal(pair: Float[Array, "4"]) -> tuple[Array, Array]:
        def depth(p: Array) -> Array:
            return inverse_depth(p[:2], p[2:], R2, T2, T2)

        return depth(pair), safe_norm(jax.grad(depth)(pair)) * sigma

    value, sd = jax.vmap(signal)(pairs)
    return (value > 0) & (value > smallest_snr * sd)
