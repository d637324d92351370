"""A window of keyframes: frames whose poses are kept, and improved by all that is seen in them.

A window of the last keyframes, with the tracks that are seen in them. Whenever one is made, all their poses and points
take a step to maximum likelihood, the points eliminated (`jaxtri.estimation.bundle`). What leaves the window is not
forgotten, and nothing is counted twice: a track that has ended becomes, with all its observations, what it says of the
poses, a Gaussian, and a keyframe that leaves is marginalised out of that. A track that is still followed when the first
keyframe that sees it leaves is cut in two: its older part becomes prior, its newer part goes on as a point of its own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.estimation.bundle import (
    Linearised,
    PointPrior,
    Points,
    Reduced,
    Views,
    calibration_pull,
    held,
    linearise,
    looks,
    projected,
    reduce,
    seen_from,
    solver,
    without_length,
)
from jaxtri.estimation.precision import block_diagonal
from jaxtri.geometry.pose import adjoint, identity, inverse_left_jacobian, local, relative, retract
from jaxtri.odometry.measuring import FARTHEST
from jaxtri.odometry.settings import Settings

FAREST, NEAREST = 0.03, 30.0  # inverse depths, over that of the scene, between which a new point begins
# Standard deviation of a point's inverse depth before it is seen, over that of the scene. So little that it only keeps
# a matrix regular: at three times, the small pulls of thousands of points had moved the scale by a percent.
VAGUE = 100.0
THINNED = 12  # keyframes from which the middle of a window is far enough from its end to be thinned out
AGREES = 0.25  # robust weight from which an observation is one of the point
STEPS_OF_START = 6  # a start's points begin far off; those of later keyframes begin nearly right
DAMPING, BETTER = 1e-4, 0.1  # of the equations of a step: at first, and from step to step


class Window(NamedTuple):
    """A window of k keyframes, oldest first, and the tracks seen in them.

    Attributes:
        poses: (k,) world to camera; the newest is the last.
        kept: How many of them, from the last one back, are keyframes.
        made: How many were made so far.
        observed: (2, k, n) normalised image points.
        mask: (k, n) which of them are seen.
        X: (4, n) homogeneous points of the world.
        known: (n,) points that were triangulated.
        information: (6k, 6k) what has left the window says of the poses' errors.
        pull: (6k, 4) its right side: a cost of x' information x / 2 - pull' x for left perturbations x; and what errors
            of the camera's calibration add to that (`jaxtri.estimation.bundle.calibration_pull`).
        origin: The first pose of all; with it the gauge is held as long as the first two keyframes stay.
        role: (k,) 1 for the first keyframe of all, 2 for the second, 0 for any other.
    """

    poses: SE3
    kept: Int[Array, ""]
    made: Int[Array, ""]
    observed: Float[Array, "2 k n"]
    mask: Bool[Array, "k n"]
    X: Float[Array, "4 n"]
    known: Bool[Array, " n"]
    information: Float[Array, "s s"]
    pull: Float[Array, "s 4"]
    origin: SE3
    role: Int[Array, " k"]


class Refined(NamedTuple):
    """What the keyframes say once they are improved.

    A point's error is `spread @ (e - lever.T @ x)`: e are three errors of standard deviation sigma of its own, x those
    of the poses.

    Attributes:
        covariance: (6k, 6k) of the poses' errors, left perturbations (linear, angular), scene units and radians; what
            the calibration is not known to (`Settings.calibration`) is in it.
        X: (4, n) homogeneous points.
        spread: (4, 3, n) their own errors, over sigma.
        lever: (6k, 3, n) what they owe to the poses.
        angle: (n,) between the first and the newest ray of each point, radians.
        usable: (n,) points that may measure.
    """

    covariance: Float[Array, "s s"]
    X: Float[Array, "4 n"]
    spread: Float[Array, "4 3 n"]
    lever: Float[Array, "s 3 n"]
    angle: Float[Array, " n"]
    usable: Bool[Array, " n"]


def start(
    settings: Settings,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    one: SE3,
    two: SE3,
    depth: Float[Array, ""],
    k: int,
) -> tuple[Window, Refined]:
    """A window of k keyframes with the first two in it; the first pose and the length of their base line are the gauge.

    `first` and `second` are normalised image points, `mask` marks those seen in both, `depth` is that of the scene.
    """
    dtype, n = first.dtype, len(first)
    empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (k, *x.shape)), identity(dtype))
    poses = jax.tree.map(lambda e, a, b: e.at[-2].set(a).at[-1].set(b), empty, one, two)
    observed = jnp.zeros((2, k, n), dtype).at[:, -2].set(first.T).at[:, -1].set(second.T)
    two_ = jnp.asarray(2, jnp.int32)
    window = Window(
        poses,
        two_,
        two_,
        observed,
        jnp.zeros((k, n), bool).at[-2:].set(mask),
        jnp.zeros((4, n), dtype),
        jnp.zeros(n, bool),
        jnp.zeros((6 * k, 6 * k), dtype),
        jnp.zeros((6 * k, 4), dtype),
        one,
        jnp.zeros(k, jnp.int32).at[-2:].set(jnp.array([1, 2], jnp.int32)),
    )
    return _improved(settings, window, mask, jnp.zeros_like(mask), depth, STEPS_OF_START)


def add(
    settings: Settings,
    window: Window,
    pose: SE3,
    observed: Float[Array, "n 2"],
    visible: Bool[Array, " n"],
    held: Bool[Array, " n"],
    depth: Float[Array, ""],
    *,
    steps: int = 1,
) -> tuple[Window, Refined]:
    """The window with a keyframe more, improved by so many steps.

    `held` are the tracks that have not broken since the keyframe before; what else is visible begins here.
    """
    moved = window._replace(
        poses=jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), window.poses, pose),
        kept=window.kept + 1,
        made=window.made + 1,
        observed=jnp.concatenate([window.observed[:, 1:], observed.T[:, None]], axis=1),
        mask=jnp.concatenate([window.mask[1:], (visible & held)[None]]),
        information=jnp.pad(window.information[6:, 6:], ((0, 6), (0, 6))),
        pull=jnp.pad(window.pull[6:], ((0, 6), (0, 0))),
        role=jnp.pad(window.role[1:], (0, 1)),
    )
    return _improved(settings, moved, visible, ~held, depth, steps)


class _Estimate(NamedTuple):
    """Poses and points, and the normal equations of the poses there."""

    poses: SE3
    points: Points
    said: Linearised
    reduced: Reduced
    free: Float[Array, "k 6 6"]  # what the gauge leaves of the poses' errors
    information: Float[Array, "s s"]  # with the gauge held
    pull: Float[Array, " s"]
    carried: tuple[Float[Array, "s s"], Float[Array, "s 4"]]  # what has left the window says there
    damping: Float[Array, ""]


def _improved(
    settings: Settings,
    window: Window,
    visible: Bool[Array, " n"],
    over: Bool[Array, " n"],
    depth: Float[Array, ""],
    steps: int,
) -> tuple[Window, Refined]:
    """The window after some steps; tracks that are `over` become prior, and those that begin take their place."""
    k, n = window.mask.shape
    dtype = window.X.dtype
    points, angle = _begun(window, depth)
    vague = PointPrior(jnp.full(n, 1.0, dtype) / depth, jnp.full(n, VAGUE, dtype) / depth)
    views = Views(window.observed, window.mask)
    scale = settings.robust.scale.astype(dtype)

    def estimate(poses: SE3, points: Points, damping: Array) -> _Estimate:
        said = linearise(poses, points, views, settings.sigma, scale)
        reduced = reduce(said, points, vague)
        carried = information, pull = _carried(window, poses)
        free = _free(window, poses)
        equations = held(free, information + reduced.information, pull[:, 0] + reduced.pull)
        return _Estimate(poses, points, said, reduced, free, *equations, carried, damping)

    # Every step is taken: one that is taken or not by its cost would make steps in the result's derivative.
    def step(best: _Estimate, _: None) -> tuple[_Estimate, None]:
        x = solver(best.information, best.damping)(best.pull)
        poses = jax.vmap(retract)(best.poses, x.reshape(k, 6))
        return estimate(poses, best.points.moved(best.reduced.points(x)), best.damping * BETTER), None

    # The first of them goes nowhere: equations that say nothing. So the estimate is compiled once, and so its gradient.
    damping = jnp.asarray(DAMPING / BETTER, dtype)
    shapes = jax.eval_shape(estimate, window.poses, points, damping)
    begin = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    begin = begin._replace(poses=window.poses, points=points, information=jnp.eye(6 * k, dtype=dtype), damping=damping)
    best, _ = jax.lax.scan(step, begin, None, length=steps + 1)
    covariance = solver(best.information)(jnp.eye(6 * k, dtype=dtype))
    covariance = projected(best.free, (covariance + covariance.T) / 2, best.free)
    # Without its own derivative, whose reverse form is NaN on some sequences: that of the covariance lacks this part.
    said_of_it = jax.lax.stop_gradient(calibration_pull(best.said, best.reduced, window.observed, settings.sigma))
    response = settings.calibration * covariance @ (best.carried[1][:, 1:] + said_of_it)
    covariance = covariance + response @ response.T
    spread = jnp.einsum("qsn,tsn->qtn", best.points.basis, best.reduced.root) / settings.sigma
    lever = best.reduced.cross * settings.sigma
    agree = jnp.sum(best.said.weights > AGREES, axis=0) >= 2
    usable = agree & (angle > settings.usable_parallax) & (best.points.inverse_depth > 0) & ~over
    left = _left(settings, window, best, vague, visible, over)
    return left._replace(known=usable), Refined(covariance, best.points.X, spread, lever, angle, usable)


def _left(
    settings: Settings,
    window: Window,
    best: _Estimate,
    vague: PointPrior,
    visible: Bool[Array, " n"],
    over: Bool[Array, " n"],
) -> Window:
    """The window without what is over, and with room for the next keyframe.

    Where it is full the oldest leaves, and every other time the one in its middle: the tracks lose a look at that,
    which is little, and the window reaches half as far again.
    """
    k = len(window.mask)
    index = jnp.arange(k)
    leaving = window.kept == k
    middle = k // 2 - 1
    oldest = leaving & ((k < THINNED) | (window.made % 2 == 0) | (window.role[middle] > 0))
    # Each track is cut at another place, by its order from left to right in the oldest: wherever the window is divided,
    # most of them join its two sides.
    rank = jnp.argsort(jnp.argsort(window.observed[0, 0]))
    cut = 1 + (rank + window.made) % (k - 2)
    folded = window.mask & (over | (oldest & window.mask[0] & (index[:, None] < cut)))
    told = reduce(best.said, best.points, vague, folded)
    information, pull = best.carried
    of_calibration = jax.lax.stop_gradient(calibration_pull(best.said, told, window.observed, settings.sigma, folded))
    information, pull = information + told.information, pull + jnp.column_stack([told.pull, of_calibration])
    mask = (window.mask & ~folded & ~over).at[-1].set(visible)
    # The one that leaves comes first, and its place becomes empty.
    gone = jnp.where(leaving & ~oldest, middle, 0)
    order = jnp.where(index <= gone, jnp.roll(index, 1), index).at[0].set(gone)
    rows = (6 * order[:, None] + jnp.arange(6)).reshape(-1)
    information, pull = information[rows[:, None], rows], pull[rows]
    others = jnp.broadcast_to(jnp.eye(6, dtype=pull.dtype), (k - 1, 6, 6))
    marginal = _without_first(*held(jnp.concatenate([best.free[gone][None], others]), information, pull))
    information, pull = (jnp.where(leaving, a, b) for a, b in zip(marginal, (information, pull), strict=True))
    mask = mask[order]
    return window._replace(
        poses=jax.tree.map(lambda x: x[order], best.poses),
        kept=jnp.minimum(window.kept, k - 1),
        observed=window.observed[:, order],
        mask=mask.at[0].set(mask[0] & ~leaving),
        X=best.points.X,
        information=information,
        pull=pull,
        role=window.role[order].at[0].multiply(jnp.where(leaving, 0, 1)),
    )


def _free(window: Window, poses: SE3) -> Float[Array, "k 6 6"]:
    """Projections on what the gauge leaves of the poses' errors.

    The first pose of all is exact, and so is the length of the base line to the second; empty places have no errors.
    """
    k, dtype = len(window.role), window.pull.dtype
    all_, none = jnp.eye(6, dtype=dtype), jnp.zeros((6, 6), dtype)

    def one(role: Array, empty: Array, pose: SE3) -> Array:
        second = without_length(relative(window.origin, pose).translation())
        return jnp.where(empty | (role == 1), none, jnp.where(role == 2, second, all_))

    return jax.vmap(one)(window.role, jnp.arange(k) < k - window.kept, poses)


def _without_first(information: Float[Array, "s s"], pull: Float[Array, "s q"]) -> tuple[Array, Array]:
    """The first pose marginalised; zeros stand in its place."""
    s = len(pull)
    across = solver(information[:6, :6])(jnp.concatenate([information[:6, 6:], pull[:6]], axis=1))
    rest = information[6:, 6:] - information[6:, :6] @ across[:, : s - 6]
    rest, owed = (rest + rest.T) / 2, pull[6:] - information[6:, :6] @ across[:, s - 6 :]
    return jnp.pad(rest, ((6, 0), (6, 0))), jnp.pad(owed, ((6, 0), (0, 0)))


def _gauge(poses: SE3) -> Float[Array, "s 7"]:
    """What a similarity of the world does to the poses' errors, while nothing that is seen changes."""

    def one(pose: SE3) -> Array:
        growth = jnp.concatenate([pose.translation(), jnp.zeros(3, pose.wxyz_xyz.dtype)])
        return jnp.concatenate([adjoint(pose), growth[:, None]], axis=1)

    return jax.vmap(one)(poses).reshape(-1, 7)


def _carried(window: Window, poses: SE3) -> tuple[Float[Array, "s s"], Float[Array, "s 4"]]:
    """What has left the window says about other poses: its information and pull.

    The derivative is corrected so that a similarity of the world changes as little there as it did before. Without,
    what was said at several estimates would say something of the scale, which nobody has seen: that made it drift.
    Source: Huang, Mourikis & Roumeliotis 2010, for the filter.
    """

    each = jax.vmap(local)(window.poses, poses)
    x, A = each.reshape(-1), block_diagonal(jax.vmap(inverse_left_jacobian)(each))
    before, now = _gauge(window.poses), _gauge(poses)
    size = jnp.sqrt(jnp.sum(now**2, axis=0))
    before, now = before / size, now / size
    A = A + (before - A @ now) @ solver(now.T @ now)(now.T)
    return A.T @ window.information @ A, A.T @ window.pull.at[:, 0].add(-window.information @ x)


def _begun(window: Window, depth: Float[Array, ""]) -> tuple[Points, Float[Array, " n"]]:
    """The points as they are known, or from the first and the newest look; the angle between these two in radians."""
    first = looks(window.poses, Views(window.observed, window.mask))
    rho = jnp.clip(first.inverse_depth, FAREST / depth, NEAREST / depth)
    # As known: the same point, in the axes of the first camera that still sees it.
    camera = jnp.einsum("nij,jn->in", first.R, window.X[:3]) + first.T.T * window.X[3]
    ahead = window.known & (camera[2] > FARTHEST)
    z = jnp.where(ahead, camera[2], 1.0)
    u, rho = jnp.where(ahead, camera[:2] / z, first.u), jnp.where(ahead, window.X[3] / z, rho)
    return seen_from(first.R, first.T, u, rho), first.angle
