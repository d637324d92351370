"""The transfer from K base frames: the pose of a camera and of its base frames, and points that stand on these.

The trifocal filter knows a point from a pair of base frames. Here the pair's point goes on: whatever frame is
made a base frame adds its observation to the point by least squares, given the base poses. These are in the
state, and the structure is not: a point moves with the errors of the base poses (`lever`) and has an error
of its own, which `jaxtri.schmidt` considers. So a frame costs O(N), no information of a base frame is lost and
none is counted twice. With the pair alone it is the trifocal filter, to first order.

A lever is taken at the point as the current frame corrects it (`slope`). Taken at the noisy point itself it
would have an error in common with the innovation, which adds up to a drift of the scale.

A point may begin in any base frame, with a prior on its inverse depth. The error of a base frame that makes room for
another is written as a function of the errors of the base frames that stay. What these do not tell of it becomes an
error of the points.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import checked, number
from jaxtri.estimation.two_view import TwoView, sensitivity
from jaxtri.filters import schmidt
from jaxtri.filters.diagnostics import Diagnostics, Robust, unless_overflown
from jaxtri.filters.linalg import regression
from jaxtri.filters.masks import select
from jaxtri.filters.schmidt import ConsiderBelief, Measured
from jaxtri.geometry.epipolar import dehomogenise, homogeneous, inverse_depth
from jaxtri.geometry.pose import local, retract, shear
from jaxtri.models.motion import Kinematics, Twist, acceleration_noise, from_two_view, twist_noise
from jaxtri.models.point_noise import SIGMA


class BaseFramesPoints(NamedTuple):
    """World points that move with the base poses.

    b = 6 (K - 1) is the number of errors of the base poses: all but the first, which is the world.

    Attributes:
        point: (n, 4) homogeneous, scene units.
        basis: (n, 4, 3) where a point's own error takes it: the error is that of its image point (normalised) and
            inverse depth where it was first seen.
        lever: (n, 4, b) where the errors of the base poses take it.
        slope: (n, 4, b) derivative of the lever with respect to the inverse depth.
        noise: (n, 3, 3) covariance of a point's own error, over sigma^2.
    """

    point: Float[Array, "n 4"]
    basis: Float[Array, "n 4 3"]
    lever: Float[Array, "n 4 b"]
    slope: Float[Array, "n 4 b"]
    noise: Float[Array, "n 3 3"]

    @property
    def owed(self) -> Float[Array, "n 3 b"]:
        """What the errors of the base poses do to a point, written as an error of its own."""
        # The point is homogeneous: a change of its length is no error, and is left out.
        return jnp.linalg.solve(jnp.concatenate([self.basis, self.point[:, :, None]], axis=2), self.lever)[:, :3]


class BaseFramesState(eqx.Module):
    """The current pose with its velocity, the base poses, and the points that move with these.

    Attributes:
        motion: Pose and velocity of the current frame: 12 error components.
        bases: (k - 1,) poses of the base frames 2 to K, world to camera. Their errors are left perturbations.
        points: The world points, in slots.
    """

    motion: Kinematics | Twist
    bases: SE3
    points: BaseFramesPoints


class BaseFrames(eqx.Module):
    """Model of `jaxtri.schmidt` without items: the points are part of the state. Every field is a leaf.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length.
        acceleration: Standard deviation of the camera's acceleration, scene units per frame^2.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(**SIGMA)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)

    def retract(self, mean: BaseFramesState, delta: Float[Array, " d"]) -> BaseFramesState:
        """The state moved by an error; the points move with their base frames."""
        bases = jax.vmap(retract)(mean.bases, delta[12:].reshape(-1, 6))
        p = mean.points
        point = p.point + p.lever @ delta[12:]
        return BaseFramesState(retract(mean.motion, delta[:12]), bases, p._replace(point=point))

    def local(self, mean: BaseFramesState, other: BaseFramesState) -> Float[Array, " d"]:
        """The error that takes `mean` to `other`."""
        bases = jax.vmap(local)(mean.bases, other.bases).reshape(-1)
        return jnp.concatenate([local(mean.motion, other.motion), bases])

    def predict(self, mean: BaseFramesState, dt: Float[Array, ""]) -> BaseFramesState:
        """Constant velocity; base frames and points stay."""
        return BaseFramesState(mean.motion.advance(dt), mean.bases, mean.points)

    def process_noise(self, mean: BaseFramesState, dt: Float[Array, ""]) -> Float[Array, "d d"]:
        """White acceleration."""
        noise = twist_noise if isinstance(mean.motion, Twist) else acceleration_noise
        return jnp.pad(noise(self.acceleration, self.angular_acceleration, dt), (0, mean.points.lever.shape[2]))

    def measured(self, mean: BaseFramesState, items: None, moved: Float[Array, "n 3"]) -> Measured:
        """Measurements of all points in the current view, and their derivatives."""
        p, motion = mean.points, mean.motion
        pose = motion.pose
        onto = _of_pose(motion)

        def one(p: BaseFramesPoints, m: Array) -> tuple[Array, Array, Array]:
            y, A, B = _derivatives(pose, p.point + p.basis @ m)
            return y, jnp.concatenate([A @ onto, B @ (p.lever + p.slope * m[2])], axis=1), B @ p.basis

        y, H, B = jax.vmap(one)(p, moved)
        return Measured(y, H, B)

    def item_noise(self, mean: BaseFramesState, items: None) -> Float[Array, "n 3 3"]:
        """Covariance of each point's own error, in which the base poses have no part."""
        return jnp.square(self.sigma) * mean.points.noise


def _of_pose(motion: Kinematics | Twist) -> Float[Array, "6 12"]:
    """Derivative of the error of the pose, a left perturbation, with respect to the error of the motion."""
    pose = motion.pose
    return jax.jacfwd(lambda e: local(pose, retract(motion, e).pose))(jnp.zeros(12, pose.wxyz_xyz.dtype))


def _derivatives(pose: SE3, X: Float[Array, "4"]) -> tuple[Float[Array, "2"], Float[Array, "2 6"], Float[Array, "2 4"]]:
    """Image point, and its derivatives with respect to a left perturbation of the pose and to the point."""
    R, T, eye = pose.rotation().as_matrix(), pose.translation(), jnp.eye(3, dtype=X.dtype)
    x = R @ X[:3] + X[3] * T
    J = jax.jacfwd(dehomogenise)(x)
    A = jnp.concatenate([X[3] * eye, jnp.cross(eye, x).T], axis=1)
    return dehomogenise(x), J @ A, J @ jnp.concatenate([R, T[:, None]], axis=1)


@checked
def start(
    two_view: TwoView,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""],
    k: int,
    *,
    frames: Float[Array, ""] | float = 1.0,
    velocity_sd: Float[Array, ""] | float,
    angular_velocity_sd: Float[Array, ""] | float,
) -> ConsiderBelief[BaseFramesState]:
    """The belief at the second of `k` base frames, `frames` after the first, from a two-view estimate.

    `mask` marks the pairs of normalised image points that the estimate was made from, `sigma` is their noise. The
    velocity and its standard deviations are as in `jaxtri.models.motion.from_two_view`. The points are those of the
    transfer (Yu et al. 2006, eqs 7-9).
    """
    motion, _, of_motion, variance = from_two_view(
        two_view, frames=frames, velocity_sd=velocity_sd, angular_velocity_sd=angular_velocity_sd
    )
    pose, dtype, n, b = motion.pose, first.dtype, len(first), 6 * (k - 1)
    pairs = jnp.concatenate([first, second], axis=-1)
    pairs = jnp.where(mask[:, None], pairs, pairs[jnp.argmax(mask)])

    def depth(pair: Float[Array, "4"], error: Float[Array, "6"]) -> Array:
        two = retract(pose, error)
        T = two.translation()
        return inverse_depth(pair[:2], pair[2:], two.rotation().as_matrix(), T, T)

    zero = jnp.zeros(6, dtype)
    value, by_pair = jax.vmap(jax.value_and_grad(depth), (0, None))(pairs, zero)
    # As the second observation moves along `onward`, the point moves along its first ray.
    seen = by_pair.at[:, :2].set(0.0)
    onward = seen / jnp.maximum(jnp.sum(seen**2, axis=1, keepdims=True), jnp.finfo(dtype).tiny)
    of_pose = jax.vmap(lambda x, dx: jax.jvp(lambda x: jax.grad(depth, 1)(x, zero), (x,), (dx,)))(pairs, onward)
    point = jnp.concatenate([pairs[:, :2], jnp.ones((n, 1), dtype), value[:, None]], axis=1)
    M = jnp.broadcast_to(jnp.eye(3, 4, dtype=dtype), (n, 3, 4)).at[:, 2].set(by_pair)
    Q = M @ M.mT
    basis = jnp.eye(4, dtype=dtype)[:, jnp.array([0, 1, 3])]
    lever, slope = (jnp.zeros((n, 4, b), dtype).at[:, 3, :6].set(x) for x in of_pose)
    points = BaseFramesPoints(point, jnp.broadcast_to(basis, (n, 4, 3)), lever, slope, Q)
    bases = jax.tree.map(lambda x: jnp.broadcast_to(x, (k - 1, *x.shape)), pose)
    # What the noise of the pairs does to the estimate: a part by way of the points' own errors, and the rest.
    onto = jnp.zeros((12 + b, 6), dtype).at[:12].set(of_motion).at[12:18].set(shear(pose.translation()))
    S = jnp.einsum("de,nep->dnp", onto, sensitivity(two_view, first, second, mask, sigma))
    by_points = jnp.einsum("dnp,niq,nqp->dni", S, jnp.linalg.inv(Q), M)
    rest = (S - jnp.einsum("dni,nip->dnp", by_points, M)).reshape(12 + b, -1)
    own = jnp.diag(jnp.pad(variance, (0, b))) + jnp.square(sigma) * rest @ rest.T
    return ConsiderBelief(BaseFramesState(motion, bases, points), own, by_points)


def informative(
    model: BaseFrames, belief: ConsiderBelief[BaseFramesState], smallest: Float[Array, ""] | float
) -> Bool[Array, " n"]:
    """Points whose inverse depth is at least `smallest` times its standard deviation; do not use the others.

    A point near the epipole of its base frames says nothing, and a linear model of it is wrong.
    """
    p = belief.mean.points
    return p.point[:, 3] > smallest * model.sigma * jnp.sqrt(p.noise[:, 2, 2])


def release(
    model: BaseFrames, belief: ConsiderBelief[BaseFramesState], slot: Int[Array, ""]
) -> ConsiderBelief[BaseFramesState]:
    """The belief without the base frame in `slot` (0 to K - 2), which then holds nothing.

    The error of this base frame is written as a linear function of the errors of the other base frames. The remainder
    becomes a part of each point's own error.
    """
    p, dtype = belief.mean.points, belief.own.dtype
    b = p.lever.shape[2]
    Q = model.item_noise(belief.mean, None)
    P = belief.covariance(Q)[12:, 12:]
    at = 6 * slot + jnp.arange(6)
    others = jnp.ones(b, dtype).at[at].set(0.0)
    Phi = regression(P * jnp.outer(others, others), P[:, at] * others[:, None])
    remainder = jnp.eye(b, dtype=dtype)[at] - Phi
    left = remainder @ P @ remainder.T
    onto = p.owed[:, :, at]
    more = onto @ left @ onto.mT
    T = jnp.linalg.solve(Q + more, Q).mT
    keep = jnp.eye(3, dtype=dtype) - T
    lost = keep @ Q @ keep.mT + T @ more @ T.mT
    lever, slope = (x * others + x[:, :, at] @ Phi for x in (p.lever, p.slope))
    points = p._replace(lever=lever, slope=slope, noise=p.noise + more / jnp.square(model.sigma))
    own = belief.own + schmidt.owed(belief.sensitivity, lost)
    kept = jnp.concatenate([jnp.ones(12, dtype), others])
    mean = BaseFramesState(belief.mean.motion, belief.mean.bases, points)
    return ConsiderBelief(
        mean, own * jnp.outer(kept, kept), jnp.einsum("dnp,npq->dnq", belief.sensitivity, T) * kept[:, None, None]
    )


def forget(
    model: BaseFrames, belief: ConsiderBelief[BaseFramesState], gone: Bool[Array, " n"]
) -> ConsiderBelief[BaseFramesState]:
    """The belief without the points that are `gone`: what their errors did to the state becomes its own error."""
    S = jnp.where(gone[:, None], belief.sensitivity, 0.0)
    own = belief.own + schmidt.owed(S, model.item_noise(belief.mean, None))
    return ConsiderBelief(belief.mean, own, belief.sensitivity - S)


def promote(
    belief: ConsiderBelief[BaseFramesState], slot: Int[Array, ""], said: schmidt.ItemUpdate
) -> ConsiderBelief[BaseFramesState]:
    """The belief with the current pose as a base frame in `slot`, which must be empty.

    The points that the update has absorbed, as it `said`, are estimated anew.
    """
    mean, p = belief.mean, belief.mean.points
    pose, dtype = mean.motion.pose, belief.own.dtype
    at = 6 * slot + jnp.arange(6)
    onto = _of_pose(mean.motion)

    def one(p: BaseFramesPoints, moved: Array, k: Array, B: Array) -> BaseFramesPoints:
        def lever(further: Array) -> Array:
            m = moved.at[2].add(further)
            _, A, B = _derivatives(pose, p.point + p.basis @ m)
            old = p.lever + p.slope * m[2]
            return old - p.basis @ k @ (B @ old).at[:, at].add(A)

        keep = jnp.eye(3, dtype=dtype) - k @ B
        zero = jnp.zeros((), dtype)
        value, slope = jax.jvp(lever, (zero,), (jnp.ones_like(zero),))
        noise = keep @ p.noise @ keep.T + k @ k.T
        return BaseFramesPoints(p.point + p.basis @ moved, p.basis, value, slope, noise)

    points = jax.vmap(one)(p, said.moved, said.gain, said.at.spread)
    bases = jax.tree.map(lambda all_, x: all_.at[slot].set(x), mean.bases, pose)
    rows = 12 + at
    own = belief.own.at[rows].set(onto @ belief.own[:12])
    own = own.at[:, rows].set(own[:, :12] @ onto.T)
    S = belief.sensitivity.at[rows].set(jnp.einsum("ed,dnp->enp", onto, belief.sensitivity[:12]))
    return ConsiderBelief(BaseFramesState(mean.motion, bases, points), own, S)


def begin(
    model: BaseFrames,
    belief: ConsiderBelief[BaseFramesState],
    slot: Int[Array, ""],
    observed: Float[Array, "n 2"],
    fresh: Bool[Array, " n"],
    inverse_depth: Float[Array, ""],
    sd: Float[Array, ""],
) -> ConsiderBelief[BaseFramesState]:
    """The belief with new points, first seen from the base frame in `slot`, the current pose.

    `observed` are normalised image points. All new points have the given inverse depth with the standard deviation
    `sd`. Make `sd` wide: a narrow one that is wrong for all points alike changes the scale. The state does not depend
    on the new points yet. `forget` the points that they replace first.
    """
    pose, p, dtype = belief.mean.motion.pose, belief.mean.points, belief.own.dtype
    R, T, eye = pose.rotation().as_matrix(), pose.translation(), jnp.eye(3, dtype=dtype)
    at = 6 * slot + jnp.arange(6)
    one = jnp.ones((), dtype)
    noise = jnp.diag(jnp.stack([one, one, jnp.square(sd / model.sigma)]))
    # From (u, 1, inverse depth) in the camera to the world.
    back = jnp.block([[R.T, -(R.T @ T)[:, None]], [jnp.zeros((1, 3), dtype), one[None, None]]])

    def seen(u: Float[Array, "2"]) -> tuple[Array, Array]:
        x = homogeneous(u)
        return back @ jnp.append(x, inverse_depth), jnp.concatenate([inverse_depth * eye, jnp.cross(eye, x).T], axis=1)

    point, turned = jax.vmap(seen)(observed)
    new = BaseFramesPoints(
        point,
        jnp.broadcast_to(back[:, jnp.array([0, 1, 3])], p.basis.shape),
        jnp.zeros_like(p.lever).at[:, :, at].set(-back[:, :3] @ turned),
        jnp.zeros_like(p.slope).at[:, :, at[:3]].set(-back[:, :3]),
        jnp.broadcast_to(noise, p.noise.shape),
    )
    points = select(fresh, new, p)
    mean = BaseFramesState(belief.mean.motion, belief.mean.bases, points)
    return ConsiderBelief(mean, belief.own, jnp.where(fresh[:, None], 0.0, belief.sensitivity))


@checked
def step(
    model: BaseFrames,
    belief: ConsiderBelief[BaseFramesState],
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    base: Bool[Array, ""],
    slot: Int[Array, ""],
    dt: Float[Array, ""] | float = 1.0,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
) -> tuple[ConsiderBelief[BaseFramesState], Diagnostics]:
    """One frame, which becomes the base frame in `slot` if `base` is True; the base frame that was there is released.

    `observed` are normalised image points. A frame that becomes no base frame costs no more for it, except under vmap,
    where both ways are computed.
    """
    predicted = schmidt.predict(model, belief, dt)
    ready = jax.lax.cond(base, lambda x: release(model, x, slot), lambda x: x, predicted)
    updated, diagnostics, said = schmidt.update(
        model, ready, None, observed, mask, absorb=mask & base, passes=passes, robust=robust
    )

    def kept(belief: ConsiderBelief[BaseFramesState]) -> tuple[ConsiderBelief[BaseFramesState], Diagnostics]:
        return unless_overflown(predicted, promote(belief, slot, said), diagnostics)[:2]

    return jax.lax.cond(base, kept, lambda x: (x, diagnostics), updated)
