"""One base pair for all tracks, segment after segment: the paper's way, and the inherited pair.

The filter of a segment is the 18-state one of `jaxtri.models.trifocal`, with the second base pose in the
state. A segment stands in the world by the pose of its first base frame and the logarithm of its scale, both
with their covariance. `init` and `step` are pure, on arrays of fixed capacity, like those of
`jaxtri.track_pairs`; the driver decides when to restart.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import checked
from jaxtri.estimation.two_view import TwoView, refine, scaled
from jaxtri.filters import ekf
from jaxtri.geometry.epipolar import inverse_depth, parallax, safe_norm
from jaxtri.geometry.pose import adjoint, identity, multiply, relative, shear
from jaxtri.models.depth import Bank
from jaxtri.models.trifocal import Trifocal, TrifocalState, informative, start
from jaxtri.odometry.measuring import FARTHEST, START_VELOCITY, judged, measure, median, noise_scale, structure_model
from jaxtri.odometry.settings import Report, Settings, Status

# Inverse depth of a pair over its standard deviation, from which it measures. Near the epipole a pair has no depth, and
# a linear model of its transfer is wrong.
LEAST_SIGNAL = 2.0
# Depth in scene units that stands for one which is not positive: its logarithm stays finite.
NEAREST = 1e-9
# Depth from which a point takes part in the scale that two segments have in common: above `NEAREST`, and above the zero
# that `pair_depths` gives for a point without depth.
LEAST_DEPTH = 1e-6


class Placement(NamedTuple):
    """Where a segment stands in the world.

    Attributes:
        pose: Of its first base frame, world to camera.
        covariance: (7, 7) of the error of `pose` (linear, angular, in camera axes) and of the logarithm of the scale.
    """

    pose: SE3
    covariance: Float[Array, "7 7"]


class State(NamedTuple):
    """What is carried from frame to frame.

    Attributes:
        belief: Pose, velocity and second base pose within the segment, whose world is its first base frame.
        pairs: (n, 4) normalised image points of each track in the first base frame and in the second.
        inside: (n,) tracks of the base pair that have not broken so far.
        placement: Where the segment stands in the world.
        epipole: (3,) epipole of the second base frame, homogeneous, as known at the start of the segment.
        depth: Median depth of the scene at the start of the segment, scene units.
        coasted: Frames since the last update that was taken.
        structure: A point per track, in the world.
    """

    belief: ekf.Belief[TrifocalState]
    pairs: Float[Array, "n 4"]
    inside: Bool[Array, " n"]
    placement: Placement
    epipole: Float[Array, "3"]
    depth: Float[Array, ""]
    coasted: Int[Array, ""]
    structure: Bank


def origin(dtype: jnp.dtype) -> Placement:
    """The placement of the first segment: it is the world, and its scale is the gauge; both are exact."""
    return Placement(identity(dtype), jnp.zeros((7, 7), dtype))


def _model(settings: Settings, epipole: Float[Array, "3"], depth: Float[Array, ""]) -> Trifocal:
    drift = jnp.zeros((), settings.sigma.dtype)
    linear, angular = settings.acceleration * depth, settings.angular_acceleration
    # On real video the estimate of the second base pose is worse than it says, and refining it helps.
    return Trifocal(settings.sigma, linear, angular, drift, epipole, refine_base=True)


@checked
def init(
    settings: Settings,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    two_view: TwoView,
    placement: Placement,
    frames: Float[Array, ""] | float = 1.0,
) -> State:
    """The state at the second base frame, `frames` after the first.

    `first` and `second` are normalised image points in slots, `mask` marks the tracks that `two_view` was made from.
    """
    pairs = jnp.concatenate([first, second], axis=-1)
    pairs = jnp.where(mask[:, None], pairs, jnp.zeros((), pairs.dtype))
    R, T = two_view.rotation.as_matrix(), two_view.translation
    inverse = jax.vmap(lambda p: inverse_depth(p[:2], p[2:], R, T, T))(pairs)
    depth = median(1 / jnp.where(inverse > 0, inverse, 1.0), mask & (inverse > 0))
    belief = start(two_view, frames=frames, velocity_sd=START_VELOCITY * depth, angular_velocity_sd=START_VELOCITY)
    inside = mask & informative(belief.mean, pairs, settings.sigma, LEAST_SIGNAL)
    model = structure_model(settings)
    structure = model.plane(pairs[:, :2], placement.pose, depth)
    state = State(belief, pairs, inside, placement, T, depth, jnp.asarray(0, jnp.int32), structure)
    structure = model.step(structure, world_pose(state)[0], pairs[:, 2:], inside, own_covariance(state))
    return state._replace(structure=structure)


def world_pose(state: State) -> tuple[SE3, Float[Array, "6 6"]]:
    """Pose of the current frame, world to camera, and the covariance of its error (linear, angular)."""
    motion = state.belief.mean.motion
    relative, T = motion.pose, motion.translation
    scale = jnp.concatenate([T, jnp.zeros_like(T)])[:, None]
    G = jnp.concatenate([adjoint(relative), scale], axis=1)
    return multiply(relative, state.placement.pose), own_covariance(state) + G @ state.placement.covariance @ G.T


def own_covariance(state: State) -> Float[Array, "6 6"]:
    """Covariance of the current pose within its segment, as a left perturbation (linear, angular)."""
    return state.belief.mean.motion.pose_covariance(state.belief.covariance)


def place(pose: Float[Array, "6 6"], log_scale: Float[Array, ""]) -> Float[Array, "7 7"]:
    """Covariance of a placement from that of its pose and the variance of its log scale."""
    return jnp.zeros((7, 7), pose.dtype).at[:6, :6].set(pose).at[6, 6].set(log_scale)


@checked
def step(
    settings: Settings,
    state: State,
    observed: Float[Array, "n 2"],
    visible: Bool[Array, " n"],
    fresh: Bool[Array, " n"],
    dt: Float[Array, ""] | float = 1.0,
    *,
    quality: Float[Array, "n 2"] | None = None,
) -> tuple[State, Report]:
    """One frame: predict, and update with the tracks of the base pair that are still there.

    Arguments as of `jaxtri.track_pairs.step`.
    """
    inside = state.inside & visible & ~fresh
    model = _model(settings, state.epipole, state.depth)
    scale, dt = noise_scale(settings, quality), jnp.asarray(dt, observed.dtype)
    found = measure(settings, model, state.belief, state.pairs, observed, inside, dt, state.coasted, scale)
    ok, drop = found.taken, found.drop
    inside = inside & ~drop
    new = state._replace(belief=found.belief, inside=inside, coasted=found.coasted)
    pose, covariance = world_pose(new)
    structure = structure_model(settings).step(state.structure, pose, observed, inside & ok, own_covariance(new), dt)
    new = new._replace(structure=structure)
    status = judged(found.status, covariance, found.diagnostics)
    one = jnp.ones((), observed.dtype)
    never, none = jnp.asarray(False), jnp.zeros_like(drop)
    return new, Report(pose, covariance, status, never, _parallax(new), drop, found.diagnostics, one, none)


def _parallax(state: State) -> Float[Array, ""]:
    """Median angle between the two rays of the pairs, radians."""
    mean = state.belief.mean
    assert isinstance(mean.base_rotation, SO3)
    R = mean.base_rotation.as_matrix()
    return median(jax.vmap(lambda p: parallax(p[:2], p[2:], R))(state.pairs), state.inside, jnp.nan)


def depths(state: State, view: SE3) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Depth of every pair in a view, and the standard deviation of the depth's logarithm over sigma.

    `view` is the pose of the view relative to the first base frame.
    """
    mean = state.belief.mean
    assert isinstance(mean.base_rotation, SO3)
    R2, T2 = mean.base_rotation.as_matrix(), mean.base_translation
    R, T = view.rotation().as_matrix(), view.translation()

    def one(pair: Float[Array, "4"]) -> tuple[Array, Array]:
        def log_depth(p: Array) -> Array:
            inverse = inverse_depth(p[:2], p[2:], R2, T2, T2)
            inverse = jnp.where(inverse > FARTHEST, inverse, FARTHEST)
            z = R[2] @ jnp.concatenate([p[:2], jnp.ones(1, p.dtype)]) / inverse + T[2]
            return jnp.log(jnp.where(z > NEAREST, z, NEAREST))

        value, slope = jax.value_and_grad(log_depth)(pair)
        return jnp.exp(value), safe_norm(slope)

    return jax.vmap(one)(state.pairs)


def pair_depths(
    two_view: TwoView, first: Float[Array, "n 2"], second: Float[Array, "n 2"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Depths in the first view, zero where there is none, and the standard deviation of their logarithms over sigma."""
    R, T = two_view.rotation.as_matrix(), two_view.translation

    def one(a: Array, b: Array) -> tuple[Array, Array]:
        value, (da, db) = jax.value_and_grad(inverse_depth, argnums=(0, 1))(a, b, R, T, T)
        safe = jnp.where(value > FARTHEST, value, FARTHEST)
        return jnp.where(value > FARTHEST, 1 / safe, 0.0), safe_norm(jnp.concatenate([da, db])) / safe

    return jax.vmap(one)(first, second)


def common_scale(
    before: Float[Array, " n"],
    before_sd: Float[Array, " n"],
    after: Float[Array, " n"],
    after_sd: Float[Array, " n"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Scale that takes the new segment's depths to the old one's, and the variance of its logarithm.

    It is the weighted median of the ratios. `before_sd` and `after_sd` are standard deviations of the logarithms of the
    depths over `sigma`, the noise of a normalised image point.
    """
    good = mask & (before > LEAST_DEPTH) & (after > LEAST_DEPTH)
    ratio = jnp.where(good, jnp.log(jnp.where(good, before, 1.0)) - jnp.log(jnp.where(good, after, 1.0)), 0.0)
    weight = jnp.where(good, 1 / (jnp.square(sigma) * (before_sd**2 + after_sd**2) + 1e-12), 0.0)
    order = jnp.argsort(jnp.where(good, ratio, jnp.inf))
    total = jnp.cumsum(weight[order])
    middle = jnp.argmax(total >= total[-1] / 2)
    scale = jnp.exp(ratio[order[middle]])
    # pi/2: what a median loses against a mean on Gaussian noise. The spread found may exceed the one expected.
    expected = 1 / jnp.maximum(total[-1], 1e-12)
    spread = jnp.sum(weight * (ratio - jnp.log(scale)) ** 2) / jnp.maximum(jnp.sum(good), 1)
    return scale, jnp.pi / 2 * expected * jnp.maximum(spread, 1.0)


class Pair(NamedTuple):
    """The base pair that a segment hands over to.

    Attributes:
        first: (n, 2) normalised image points in its first frame, in slots.
        second: (n, 2) normalised image points in its second frame.
        common: (n,) tracks seen in both.
        pose: Of its first frame, world to camera, as the segment that ends knows it.
        covariance: (6, 6) of the error of `pose`, (linear, angular) in camera axes.
    """

    first: Float[Array, "n 2"]
    second: Float[Array, "n 2"]
    common: Bool[Array, " n"]
    pose: SE3
    covariance: Float[Array, "6 6"]

    def placed(self, state: State, variance: Float[Array, ""]) -> Placement:
        """Where the new segment stands, given the `variance` that the hand-over adds to the logarithm of the scale."""
        return Placement(self.pose, place(self.covariance, state.placement.covariance[6, 6] + variance))


def consecutive(
    settings: Settings, state: State, pair: Pair, found: TwoView
) -> tuple[TwoView, Placement, Int[Array, ""]]:
    """The paper's hand-over, to a pair whose relative pose is `found`; points that both segments know give the scale.

    Returns the relative pose at that scale, the placement, and the number of points that decide on the scale: where
    there are fewer than three, do not use it.
    """
    mask = state.inside & pair.common
    before = depths(state, relative(state.placement.pose, pair.pose))
    after = pair_depths(found, pair.first, pair.second)
    scale, variance = common_scale(*before, *after, mask, settings.sigma)
    return scaled(found, scale), pair.placed(state, variance), jnp.sum(mask)


def inherited(settings: Settings, state: State, pair: Pair) -> tuple[TwoView, Placement]:
    """The hand-over to a pair of a frame already tracked and the present one; their relative pose so far is the prior.

    Returns the relative pose, refined by the points that both frames see, and the placement.
    """
    motion, own = relative(pair.pose, world_pose(state)[0]), own_covariance(state)
    T = motion.translation()
    prior = shear(-T) @ (own + 1e-12 * jnp.eye(6, dtype=own.dtype)) @ shear(-T).T
    refined = refine(T, motion.rotation(), pair.first, pair.second, pair.common, settings.sigma, prior=prior)
    direction = T / safe_norm(T)
    return refined, pair.placed(state, direction @ own[:3, :3] @ direction / (T @ T))


def second_report(state: State) -> Report:
    """The report of the second base frame of a new segment: no update has measured it, so it has no likelihood."""
    inside = state.inside
    nothing = jnp.zeros(inside.shape, state.pairs.dtype)
    unknown, count = jnp.full((), jnp.nan, nothing.dtype), jnp.sum(inside)
    diagnostics = ekf.Diagnostics(unknown, unknown, count, count, inside.astype(nothing.dtype), nothing)
    status = jnp.asarray(int(Status.TRACKING))
    keyframe, angle, drop = jnp.asarray(True), _parallax(state), jnp.zeros_like(inside)
    return Report(*world_pose(state), status, keyframe, angle, drop, diagnostics, jnp.ones_like(angle), drop)
