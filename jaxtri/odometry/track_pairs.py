"""The recursive tracker over feature tracks: a camera's pose, frame by frame, from points that keyframes know.

`init` and `step` are pure functions on arrays of fixed capacity: a changing set of features is a changing
mask. A keyframe is a frame whose pose is kept, and improved with those before it and with all points that they see
(`jaxtri.odometry.window`). Each track is measured from the keyframes that see it, so there is no hand-over between
segments: overlapping tracks carry the scale.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import checked
from jaxtri.errors import InputError
from jaxtri.filters import ekf, projective
from jaxtri.filters.masks import replace_masked, stand_in
from jaxtri.filters.model import transition
from jaxtri.filters.scan import checkpointed
from jaxtri.geometry.epipolar import essential, inverse_depth, sampson
from jaxtri.geometry.pose import identity, multiply
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.motion import Twist
from jaxtri.models.rolling_shutter import LatePoint, RollingShutter, at_frame_time
from jaxtri.odometry.keyframes import carry, total
from jaxtri.odometry.measuring import (
    FARTHEST,
    GAUGE,
    MINORITY,
    START_VELOCITY,
    agreement,
    found_noise,
    judged,
    measure,
    median,
    noise_scale,
)
from jaxtri.odometry.settings import Report, Settings
from jaxtri.odometry.window import Refined, Window, add, start

FEWEST = 4  # keyframes that a window holds at least: with fewer no track would outlive one that leaves


class Tracks(NamedTuple):
    """What is known of the track in each slot.

    Attributes:
        base: The point of each track: (n, 4) and (n, 4, 3).
        lever: (s, 3, n) what the errors of the points owe to those of the keyframes.
        angle: (n,) between the first and the newest ray that each point is known from, radians.
        usable: (n,) tracks whose `base` may measure.
    """

    base: BasePoint
    lever: Float[Array, "s 3 n"]
    angle: Float[Array, " n"]
    usable: Bool[Array, " n"]

    @classmethod
    def of(cls, refined: Refined) -> "Tracks":
        """Those of a window of keyframes."""
        base = BasePoint(refined.X.T, jnp.moveaxis(refined.spread, -1, 0))
        return cls(base, refined.lever, refined.angle, refined.usable)


class State(NamedTuple):
    """What is carried from frame to frame.

    Attributes:
        belief: Pose and twist of the camera, with the covariance (12, 12) of their errors.
        tracks: What is known of the track in each slot.
        window: The keyframes that are kept, and the tracks seen in them.
        covariance: (s, s), s = 6 k, of the errors of the keyframes at the time of the last one: left perturbations
            (linear, angular), each in the axes of its own camera, scene units and radians.
        sensitivity: (12, s) derivative of the error of `belief` with respect to these.
        seen: (n, 2) normalised image points of the last keyframe.
        held: (n,) tracks that have not broken since the last keyframe.
        depth: Median depth of the scene, scene units.
        coasted: Frames since the last update that was taken.
        noise: Standard deviation of a tracked point over `Settings.sigma`, as the frames so far have shown it.
        agreed: (n,) share of the latest frames that each track has agreed with, the latest of them counting most.
    """

    belief: ekf.Belief[Twist]
    tracks: Tracks
    window: Window
    covariance: Float[Array, "s s"]
    sensitivity: Float[Array, "12 s"]
    seen: Float[Array, "n 2"]
    held: Bool[Array, " n"]
    depth: Float[Array, ""]
    coasted: Int[Array, ""]
    noise: Float[Array, ""]
    agreed: Float[Array, " n"]


def _louder(settings: Settings, noise: Float[Array, ""]) -> Settings:
    """The settings with the noise that was found in the place of the one assumed.

    The robust weights stay as narrow as they are, in pixels: what is noisy is often a few blurred frames, and wider
    weights let in more that is wrong than they gain.
    """
    robust = replace(settings.robust, scale=settings.robust.scale / noise**2)
    return replace(settings, sigma=settings.sigma * noise, robust=robust)


def _model(settings: Settings, depth: Float[Array, ""]) -> BasePairs:
    return BasePairs(settings.sigma, settings.acceleration * depth, settings.angular_acceleration)


@checked
def init(
    settings: Settings,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    pose: SE3,
    *,
    world: SE3 | None = None,
    keyframes: int = 16,
    noise: Float[Array, ""] | float = 1.0,
) -> State:
    """The state at the first of two base frames whose relative pose X2 = pose X1 is known.

    `first` and `second` are normalised image points in slots, `mask` marks the slots seen in both. The length of the
    base line is the unit of length; the rest of `pose` is estimated anew from the points. `world` is the pose of the
    first frame (the identity by default). `keyframes` is how many of them are kept, at least 4. `noise` is the standard
    deviation of the points over `settings.sigma`, where it is known. Give the frames between the two, and the second,
    to `step` with `hold=True`.
    """
    if keyframes < FEWEST:
        raise InputError(f"keyframes is {keyframes}; keep at least {FEWEST}")
    dtype = first.dtype
    one = identity(dtype) if world is None else jax.tree.map(lambda x: x.astype(dtype), world)
    two = multiply(pose, one)
    first = jnp.where(mask[:, None], first, jnp.zeros((), dtype))
    second = jnp.where(mask[:, None], second, jnp.zeros((), dtype))
    inverse, good = jax.vmap(lambda a, b: _agreeing(settings, a, b, pose))(first, second)
    good &= mask
    depth = median(1 / jnp.where(good, inverse, 1.0), good)
    noise = jnp.asarray(noise, dtype)
    window, refined = start(_louder(settings, noise), first, second, good, one, two, depth, keyframes)
    # What the two frames did not agree on may still agree with later ones.
    window = window._replace(mask=window.mask.at[-2:].set(mask))
    belief = ekf.Belief(Twist(one, jnp.zeros(6, dtype)), _known(depth, jnp.asarray(START_VELOCITY, dtype)))
    sensitivity = jnp.zeros((12, 6 * keyframes), dtype)
    return State(
        belief,
        Tracks.of(refined),
        window,
        refined.covariance,
        sensitivity,
        second,
        mask,
        depth,
        jnp.asarray(0, jnp.int32),
        noise,
        jnp.ones(len(first), dtype),
    )


def _known(depth: Float[Array, ""], velocity: Float[Array, ""]) -> Float[Array, "12 12"]:
    """Covariance of a pose that is as good as exact, and of a twist that is known to `velocity` depths or radians."""
    fixed = jnp.asarray(GAUGE, depth.dtype)
    return jnp.diag(jnp.repeat(jnp.stack([fixed * depth, fixed, velocity * depth, velocity]), 3) ** 2)


def _agreeing(
    settings: Settings, first: Float[Array, "2"], second: Float[Array, "2"], pose: SE3
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Inverse depth of the point of a pair, in its first camera, and whether the two views agree on it."""
    R, T = pose.rotation().as_matrix(), pose.translation()
    inverse = inverse_depth(first, second, R, T, T)
    return inverse, (inverse > 0) & (jnp.abs(sampson(essential(R, T), first, second)) < settings.epipolar_gate)


def _rebase(settings: Settings, state: State, observed: Array, visible: Array) -> State:
    """The state with a keyframe at its pose, and all points from the keyframes as they are now."""
    belief = state.belief
    window, refined = add(
        settings, state.window, belief.mean.pose, observed, visible, state.held, state.depth, steps=settings.refinements
    )
    # The pose is the keyframe's, and so are its errors.
    pose = jax.tree.map(lambda x: x[-1], window.poses)
    mean = eqx.tree_at(lambda m: m.pose, belief.mean, pose)
    known = _known(state.depth, jnp.zeros_like(state.depth)).at[6:, 6:].set(belief.covariance[6:, 6:])
    sensitivity = jnp.zeros_like(state.sensitivity).at[:6, -6:].set(jnp.eye(6, dtype=observed.dtype))
    return state._replace(
        belief=ekf.Belief(mean, known),
        tracks=Tracks.of(refined),
        window=window,
        covariance=refined.covariance,
        sensitivity=sensitivity,
        seen=observed,
        held=visible,
    )


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
    late: Float[Array, " n"] | None = None,
) -> tuple[State, Report]:
    """One frame: predict, update with the tracks whose points are known, keep a keyframe when it is time.

    `observed` are normalised points in slots, `visible` the slots that hold one, `fresh` those whose track
    begins here (whatever the slot held before is forgotten). With `hold` no keyframe is made. `quality` is what
    `settings.point_noise` asks for; `late` are the frames from the time of this one to that at which each point was
    exposed, where the shutter rolls. Where too few points agree the state is the prediction and the status says so.
    """
    observed = jnp.where(visible[:, None], observed, jnp.zeros((), observed.dtype))
    keep = visible & ~fresh
    tracks = _only(state.tracks, keep)

    assumed, settings = settings, _louder(settings, state.noise)
    model, dt = _model(settings, state.depth), jnp.asarray(dt, observed.dtype)
    mask, scale = tracks.usable, noise_scale(settings, quality)
    points = stand_in(mask, tracks.base)
    if late is not None:
        late = jnp.where(visible, late, jnp.zeros((), observed.dtype))
        model = RollingShutter(model.sigma, model.acceleration, model.angular_acceleration)
        points = LatePoint(points.point, points.spread, late)
    items = projective.prepare(model, points)
    found = measure(settings, model, state.belief, items, observed, mask, dt, state.coasted, scale)
    belief, ok, drop = found.belief, found.taken, found.drop
    weights = jnp.where(ok, found.diagnostics.weights, 0.0)
    noise = jnp.where(ok, found_noise(assumed, state.noise, found.diagnostics.distance, mask), state.noise)
    sensitivity = carry(
        state.sensitivity,
        transition(model, state.belief.mean, dt),
        belief.covariance,
        *_owed(model, belief.mean, items, tracks, weights, scale),
    )
    if late is not None:
        observed = _at_frame_time(belief.mean, tracks, observed, late, state.depth)
    agreed = jnp.where(keep, state.agreed, 1.0)
    agreed = agreement(settings, agreed, found.diagnostics, ok & mask)
    moving = visible & (agreed < MINORITY)
    visible = visible & ~drop & ~moving
    tracks = _only(tracks, ~drop & ~moving)
    held = state.held & keep & ~drop & ~moving

    flow = median(jnp.sqrt(jnp.sum((observed - state.seen) ** 2, axis=-1)), held)

    live = jnp.sum(visible).astype(observed.dtype)
    usable = jnp.sum(tracks.usable).astype(observed.dtype)
    due = (flow > settings.keyframe_flow) | (jnp.sum(held) < settings.keyframe_common)
    due |= usable < settings.keyframe_usable * live
    keyframe = due & ok & ~jnp.asarray(hold)

    inverse = tracks.base.point[:, 3]
    depths = tracks.base.point[:, :3] @ belief.mean.pose.rotation().as_matrix()[2]
    depths = depths / jnp.where(jnp.abs(inverse) > FARTHEST, inverse, FARTHEST) + belief.mean.pose.translation()[2]
    depth = jnp.where(ok & (usable > 0), median(depths, tracks.usable & (depths > 0)), state.depth)
    plain = state._replace(
        belief=belief,
        tracks=tracks,
        sensitivity=sensitivity,
        held=held,
        depth=depth,
        coasted=found.coasted,
        noise=noise,
        agreed=agreed,
    )
    new = jax.lax.cond(keyframe, lambda: _rebase(settings, plain, observed, visible), lambda: plain)
    covariance = total(new.belief.covariance[:6, :6], new.covariance, new.sensitivity)
    status, said = judged(found.status, covariance, found.diagnostics), found.diagnostics
    parallax = median(tracks.angle, tracks.usable, jnp.nan)
    return new, Report(new.belief.mean.pose, covariance, status, keyframe, parallax, drop, said, state.noise, moving)


def recalled(state: State, source: Int[Array, " n"], kept: Bool[Array, " n"], pose: SE3) -> State:
    """An earlier state, to go on from at another pose, which is not known: tracks that it knew are seen again.

    `source` is a permutation: the slot that each slot's track had; `kept` marks those that go on. What is known of the
    points, and what they owe to the keyframes, is as it was.
    """
    window, dtype = state.window, state.seen.dtype
    base, lever, angle, usable = state.tracks
    base = jax.tree.map(lambda x: x[source], base)
    tracks = Tracks(base, lever[..., source], angle[source], usable[source] & kept)
    window = window._replace(
        observed=window.observed[..., source],
        mask=window.mask[:, source],
        X=window.X[:, source],
        known=window.known[source],
    )
    sd = jnp.stack([state.depth, jnp.ones_like(state.depth)])
    unknown = jnp.diag(jnp.repeat(jnp.concatenate([sd, START_VELOCITY * sd]), 3) ** 2)
    return state._replace(
        belief=ekf.Belief(Twist(pose, jnp.zeros(6, dtype)), unknown),
        tracks=tracks,
        window=window,
        sensitivity=jnp.zeros_like(state.sensitivity),
        seen=state.seen[source],
        held=kept,
        coasted=jnp.zeros_like(state.coasted),
        agreed=jnp.ones_like(state.agreed),
    )


def _at_frame_time(
    mean: Twist, tracks: Tracks, observed: Float[Array, "n 2"], late: Float[Array, " n"], depth: Float[Array, ""]
) -> Float[Array, "n 2"]:
    """Where points would have been at the time of the frame; one that is not known is taken to be as deep as most."""
    X, (R, T) = tracks.base.point, (mean.pose.rotation().as_matrix(), mean.pose.translation())
    camera = jnp.concatenate([X[:, :3] @ R.T + X[:, 3:] * T, X[:, 3:]], axis=1)
    one = jnp.ones_like(depth)
    guess = jnp.concatenate([observed, jnp.broadcast_to(jnp.stack([one, 1 / depth]), observed.shape)], axis=1)
    return at_frame_time(mean, jnp.where(tracks.usable[:, None], camera, guess), observed, late)


def _owed(
    model: BasePairs,
    mean: Twist,
    items: projective.Moments,
    tracks: Tracks,
    weights: Float[Array, " n"],
    scale: Float[Array, " n"] | None,
) -> tuple[Float[Array, "m m"], Float[Array, "m s"]]:
    """What the measurements of an update say of the m components of the error that they depend on, the pose's first.

    And of these together with the keyframes.
    """
    mask = weights > 0
    scale = replace_masked(mask, scale, 1.0)
    zero, unmeasured = jnp.zeros(12, weights.dtype), jnp.zeros((len(mask), 2), weights.dtype)
    said = projective.linearise(model, mean, zero, items, unmeasured, mask, scale)
    each = said.coupling(weights, items.spread.reshape(len(items.spread), -1, len(mask)))
    lever = jnp.where(mask, tracks.lever, 0.0)
    A, _ = said.normal_equations(weights)
    return A, -each.reshape(len(each), -1) @ lever.reshape(len(lever), -1).T


def _only(tracks: Tracks, keep: Bool[Array, " n"]) -> Tracks:
    """The tracks with all others forgotten."""
    return tracks._replace(usable=tracks.usable & keep)


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
    late: Float[Array, "t n"] | None = None,
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
        *arguments, held, known, late = frame
        return step(settings, carry, *arguments, hold=held, quality=known, late=late)

    return checkpointed(body, state, (observed, visible, fresh, dt, hold, quality, late), block)
