"""The recursive tracker over feature tracks: a camera's pose, frame by frame, with a base pair per track.

`init` and `step` are pure functions on arrays of fixed capacity: a changing set of features is a changing
mask. A keyframe is a frame whose pose is kept. Each track draws its two base frames from the keyframes, so
there is no hand-over between segments: overlapping tracks carry the scale.

Beside the pose runs the structure bank (`jaxtri.models.depth`): a point per track, born where the track
begins, refined in every frame given the pose, and kept as it was when the track ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import checked
from jaxtri.filters import ekf, projective
from jaxtri.filters.masks import replace_masked, select, stand_in
from jaxtri.filters.model import transition
from jaxtri.filters.scan import checkpointed
from jaxtri.geometry.epipolar import essential, inverse_depth, parallax, sampson
from jaxtri.geometry.pose import identity, multiply, relative
from jaxtri.models.base_pairs import BasePairs, BasePoint, base_lever, base_point
from jaxtri.models.depth import Bank
from jaxtri.models.motion import Twist
from jaxtri.odometry.keyframes import Keyframes, add, carry, start, total
from jaxtri.odometry.measuring import FARTHEST, START_VELOCITY, measure, median, noise_scale, structure_model
from jaxtri.odometry.settings import Report, Settings

# Standard deviation of the first pose, in scene depths and radians. It is the gauge, so this is as good as exact, far
# below what any image tells; at zero its components would have no scale.
GAUGE = 1e-6


class Tracks(NamedTuple):
    """What is known of the track in each slot.

    Attributes:
        first: (n, 2) normalised image point of each track in its first base frame.
        slots: (n, 2) places in the ring of keyframes of the two base frames; -1 where there is none yet, or where the
            keyframe is no longer kept.
        base: The base point of each track: (n, 4) and (n, 4, 4).
        lever: (n, 4, 12) derivative of the base point with respect to the errors of the two base poses.
        usable: (n,) tracks whose `base` may measure.
        fixed: (n,) tracks whose `base` is no longer replaced.
    """

    first: Float[Array, "n 2"]
    slots: Int[Array, "n 2"]
    base: BasePoint
    lever: Float[Array, "n 4 12"]
    usable: Bool[Array, " n"]
    fixed: Bool[Array, " n"]


class State(NamedTuple):
    """What is carried from frame to frame.

    Attributes:
        belief: Pose and twist of the camera, with the covariance (12, 12) of their errors.
        tracks: What is known of the track in each slot.
        keyframes: The base frames that are kept.
        sensitivity: (12, s) derivative of the error of `belief` with respect to the s = 6 k errors of the keyframes.
        seen: (n, 2) normalised image points of the last keyframe.
        held: (n,) tracks that have not broken since the last keyframe.
        depth: Median depth of the scene, scene units.
        coasted: Frames since the last update that was taken.
        structure: A point per track, refined in every frame given the pose.
        born: (n,) tracks whose point stands in `structure`.
    """

    belief: ekf.Belief[Twist]
    tracks: Tracks
    keyframes: Keyframes
    sensitivity: Float[Array, "12 s"]
    seen: Float[Array, "n 2"]
    held: Bool[Array, " n"]
    depth: Float[Array, ""]
    coasted: Int[Array, ""]
    structure: Bank
    born: Bool[Array, " n"]


def _model(settings: Settings, depth: Float[Array, ""]) -> BasePairs:
    return BasePairs(settings.sigma, settings.acceleration * depth, settings.angular_acceleration)


@checked
def init(
    settings: Settings,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    pose: SE3,
    covariance: Float[Array, "6 6"] | None = None,
    *,
    world: SE3 | None = None,
    keyframes: int = 32,
) -> State:
    """The state at the first of two base frames whose relative pose X2 = pose X1 is known.

    `first` and `second` are normalised image points in slots, `mask` marks the slots seen in both. `covariance` is that
    of the left perturbation of `pose`, zero by default. `world` is the pose of the first frame (the identity by
    default). `keyframes` is how many of them are kept. Give the frames between the two, and the second, to `step` with
    `hold=True`.
    """
    dtype = first.dtype
    one = identity(dtype) if world is None else jax.tree.map(lambda x: x.astype(dtype), world)
    two = multiply(pose, one)
    first = jnp.where(mask[:, None], first, jnp.zeros((), dtype))
    second = jnp.where(mask[:, None], second, jnp.zeros((), dtype))
    base, lever, good, _ = jax.vmap(lambda a, b: _pair(settings, a, b, one, two))(first, second)
    good &= mask
    depth = median(1 / jnp.where(good, base.point[:, 3], 1.0), good)
    covariance = jnp.zeros((6, 6), dtype) if covariance is None else covariance
    kept = start(one, two, covariance, keyframes)
    fixed, unknown = jnp.asarray(GAUGE, dtype), jnp.asarray(START_VELOCITY, dtype)
    sd = jnp.repeat(jnp.stack([GAUGE * depth, fixed, START_VELOCITY * depth, unknown]), 3)
    belief = ekf.Belief(Twist(one, jnp.zeros(6, dtype)), jnp.diag(sd**2))
    slots = jnp.stack([jnp.where(mask, 0, -1), jnp.where(good, 1, -1)], axis=-1).astype(jnp.int32)
    tracks = Tracks(first, slots, base, lever, good, good)
    sensitivity = jnp.zeros((12, 6 * keyframes), dtype)
    structure = structure_model(settings).plane(first, one, depth)
    return State(belief, tracks, kept, sensitivity, second, mask, depth, jnp.asarray(0, jnp.int32), structure, mask)


def _pair(
    settings: Settings, first: Float[Array, "2"], second: Float[Array, "2"], one: SE3, two: SE3
) -> tuple[BasePoint, Float[Array, "4 12"], Bool[Array, ""], Float[Array, ""]]:
    """The base point of a pair, its lever, whether the two views agree on it, and its parallax in radians."""
    between = relative(one, two)
    R, T = between.rotation().as_matrix(), between.translation()
    angle = parallax(first, second, R)
    distance = sampson(essential(R, T), first, second)
    ahead = inverse_depth(first, second, R, T, T) > 0
    good = ahead & (jnp.abs(distance) < settings.epipolar_gate)
    return base_point(first, second, one, two), base_lever(first, second, one, two), good, angle


def _rebase(settings: Settings, state: State, observed: Array, visible: Array) -> State:
    """The state with a keyframe at its pose: new tracks get their first base frame, waiting ones their second."""
    tracks, belief = state.tracks, state.belief
    slot, pose = state.keyframes.slot, belief.mean.pose
    keyframes, sensitivity = add(state.keyframes, pose, belief.covariance[:6, :6], state.sensitivity)
    # A waiting track whose first base frame is overwritten starts again; a fixed one has its point, and needs no more.
    slots = jnp.where(tracks.slots == slot, -1, tracks.slots)
    waiting = visible & (slots[:, 0] >= 0) & ~tracks.fixed
    ones = jax.tree.map(lambda all_: all_[jnp.maximum(slots[:, 0], 0)], keyframes.poses)
    base, lever, good, angle = jax.vmap(lambda a, b, one: _pair(settings, a, b, one, pose))(
        tracks.first, observed, ones
    )
    better = waiting & good & (angle > settings.usable_parallax)

    begins = visible & (slots[:, 0] < 0) & ~tracks.fixed
    moved = Tracks(
        jnp.where(begins[:, None], observed, tracks.first),
        jnp.stack([jnp.where(begins, slot, slots[:, 0]), jnp.where(better, slot, slots[:, 1])], axis=-1),
        select(better, base, tracks.base),
        select(better, lever, tracks.lever),
        tracks.usable & ~begins | better,
        tracks.fixed | (better & (angle > settings.fixed_parallax)),
    )
    return state._replace(tracks=moved, keyframes=keyframes, sensitivity=sensitivity, seen=observed, held=visible)


@checked
def step(
    settings: Settings,
    state: State,
    observed: Float[Array, "n 2"],
    visible: Bool[Array, " n"],
    fresh: Bool[Array, " n"],
    dt: Float[Array, ""] | float = 1.0,
    *,
    hold: Bool[Array, ""] | bool = False,
    quality: Float[Array, "n 2"] | None = None,
) -> tuple[State, Report]:
    """One frame: predict, update with the tracks that have a base pair, keep a keyframe when it is time.

    `observed` are normalised points in slots, `visible` the slots that hold one, `fresh` those whose track
    begins here (whatever the slot held before is forgotten). With `hold` no keyframe is made. `quality` is what
    `settings.point_noise` asks for. Where too few points agree the state is the prediction and the status says so.
    """
    observed = jnp.where(visible[:, None], observed, jnp.zeros((), observed.dtype))
    old = state.tracks
    keep = visible & ~fresh
    tracks = _only(old, keep)

    model, dt = _model(settings, state.depth), jnp.asarray(dt, observed.dtype)
    mask, scale = tracks.usable, noise_scale(settings, quality)
    items = projective.prepare(model, stand_in(mask, tracks.base))
    found = measure(settings, model, state.belief, items, observed, mask, dt, state.coasted, scale)
    belief, ok, drop = found.belief, found.taken, found.drop
    weights = jnp.where(ok, found.diagnostics.weights, 0.0)
    sensitivity = carry(
        state.sensitivity,
        transition(model, state.belief.mean, dt),
        belief.covariance,
        *_owed(model, belief.mean, items, tracks, weights, scale, state.sensitivity.shape[1] // 6),
    )
    visible = visible & ~drop
    tracks = _only(tracks, ~drop)
    held = state.held & keep & ~drop

    flow = median(jnp.sqrt(jnp.sum((observed - state.seen) ** 2, axis=-1)), held)
    points = structure_model(settings)
    measured = state.born & keep & ~drop & ok
    structure = points.step(state.structure, belief.mean.pose, observed, measured, belief.covariance[:6, :6], dt)
    begins = visible & ~(state.born & keep) & ok
    structure = points.born(structure, begins, observed, belief.mean.pose, state.depth)
    born = (state.born & keep & ~drop) | begins

    live = jnp.sum(visible).astype(observed.dtype)
    usable = jnp.sum(tracks.usable).astype(observed.dtype)
    due = (flow > settings.keyframe_flow) | (jnp.sum(held) < settings.keyframe_common)
    due |= usable < settings.keyframe_usable * live
    keyframe = due & ok & ~jnp.asarray(hold)

    inverse = tracks.base.point[:, 3]
    depths = tracks.base.point[:, :3] @ belief.mean.pose.rotation().as_matrix()[2]
    depths = depths / jnp.where(jnp.abs(inverse) > FARTHEST, inverse, FARTHEST) + belief.mean.pose.translation()[2]
    depth = jnp.where(ok & (usable > 0), median(depths, tracks.usable & (depths > 0)), state.depth)
    plain = State(belief, tracks, state.keyframes, sensitivity, state.seen, held, depth, found.coasted, structure, born)
    new = jax.lax.cond(keyframe, lambda: _rebase(settings, plain, observed, visible), lambda: plain)
    covariance = total(belief.covariance[:6, :6], state.keyframes, sensitivity)
    return new, Report(belief.mean.pose, covariance, found.status, keyframe, drop, found.diagnostics)


def _owed(
    model: BasePairs,
    mean: Twist,
    items: projective.Moments,
    tracks: Tracks,
    weights: Float[Array, " n"],
    scale: Float[Array, " n"] | None,
    k: int,
) -> tuple[Float[Array, "6 6"], Float[Array, "6 s"]]:
    """What the measurements of an update say of the pose, and of the pose together with k keyframes."""
    mask = weights > 0
    scale = replace_masked(mask, scale, 1.0)
    zero, unmeasured = jnp.zeros(12, weights.dtype), jnp.zeros_like(tracks.first)
    said = projective.linearise(model, mean, zero, items, unmeasured, mask, scale)
    levers = jnp.where(mask[:, None, None], tracks.lever, 0.0)
    A, _ = said.normal_equations(weights)
    first, second = (said.coupling(weights, levers[..., 6 * j : 6 * j + 6], tracks.slots[:, j], k) for j in (0, 1))
    return A, first + second


def _only(tracks: Tracks, keep: Bool[Array, " n"]) -> Tracks:
    """The tracks with all others forgotten."""
    slots = jnp.where(keep[:, None], tracks.slots, -1)
    return tracks._replace(slots=slots, usable=tracks.usable & keep, fixed=tracks.fixed & keep)


@checked
def filter(
    settings: Settings,
    state: State,
    observed: Float[Array, "t n 2"],
    visible: Bool[Array, "t n"],
    fresh: Bool[Array, "t n"],
    dt: Float[Array, " t"] | None = None,
    *,
    hold: Bool[Array, " t"] | None = None,
    quality: Float[Array, "t n 2"] | None = None,
    block: int = 1,
) -> tuple[State, Report]:
    """The state after all frames, and the reports of all stacked along a leading axis t: `step` under a scan.

    A reverse gradient keeps one state a frame, or one in every `block` frames: `jaxtri.filters.scan`.
    """
    if dt is None:
        dt = jnp.ones(observed.shape[0], observed.dtype)
    if hold is None:
        hold = jnp.zeros(observed.shape[0], bool)

    def body(carry: State, frame: tuple) -> tuple[State, Report]:
        *arguments, held, known = frame
        return step(settings, carry, *arguments, hold=held, quality=known)

    return checkpointed(body, state, (observed, visible, fresh, dt, hold, quality), block)
