"""Keyframes: base frames whose poses are kept, and what their errors do to every later pose.

The filter measures as if the base poses were exact, which is what makes it O(N); their errors are not
forgotten, though. They are consider parameters (Schmidt 1966): the error of the current pose is its own, of
the covariance the filter reports, plus a linear function of the keyframes' errors, the `sensitivity`. So the
drift of a long sequence, its scale included, stands in the covariance of every pose.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from jaxtri.geometry.pose import identity


class Keyframes(NamedTuple):
    """A ring of k poses, the newest overwriting the oldest, with the joint covariance of their errors.

    Attributes:
        poses: (k,) world to camera.
        made: How many keyframes were made so far.
        covariance: (s, s), s = 6 k, of the errors of all poses: left perturbations (linear, angular), each in the axes
            of its own camera, scene units and radians.
    """

    poses: SE3
    made: Int[Array, ""]
    covariance: Float[Array, "s s"]

    @property
    def slot(self) -> Int[Array, ""]:
        """Place in the ring that the next keyframe takes."""
        return self.made % self.poses.wxyz_xyz.shape[0]


def start(one: SE3, two: SE3, covariance: Float[Array, "6 6"], k: int) -> Keyframes:
    """A ring of `k` keyframes with the first two in it: `one` is the gauge, `two` has the covariance relative to it."""
    dtype = covariance.dtype
    empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (k, *x.shape)), identity(dtype))
    poses = jax.tree.map(lambda e, a, b: e.at[0].set(a).at[1].set(b), empty, one, two)
    joint = jnp.zeros((6 * k, 6 * k), dtype).at[6:12, 6:12].set(covariance)
    return Keyframes(poses, jnp.asarray(2, jnp.int32), joint)


def add(
    keyframes: Keyframes, pose: SE3, own: Float[Array, "6 6"], sensitivity: Float[Array, "d s"]
) -> tuple[Keyframes, Float[Array, "d s"]]:
    """A new keyframe at the current pose, whose own covariance and sensitivity (first six rows) are given.

    The sensitivity is returned without its part for the keyframe that was overwritten: what that keyframe's error does
    to the pose is dropped.
    """
    slot = keyframes.slot
    rows = 6 * slot + jnp.arange(6)
    poses = jax.tree.map(lambda all_, p: all_.at[slot].set(p), keyframes.poses, pose)
    sensitivity = sensitivity.at[:, rows].set(0.0)
    B, S = sensitivity[:6], keyframes.covariance.at[rows].set(0.0).at[:, rows].set(0.0)
    cross = B @ S
    S = S.at[rows].set(cross).at[:, rows].set(cross.T)
    S = S.at[rows[:, None], rows].set(own + cross @ B.T)
    return Keyframes(poses, keyframes.made + 1, S), sensitivity


def carry(
    sensitivity: Float[Array, "d s"],
    transition: Float[Array, "d d"],
    covariance: Float[Array, "d d"],
    information: Float[Array, "6 6"],
    coupling: Float[Array, "6 s"],
) -> Float[Array, "d s"]:
    """The sensitivity after a prediction and an update: B <- (I - P A) F B - P C.

    P is the posterior `covariance`; `information` A = sum w H' D^-1 H and `coupling` C = sum w H' D^-1 J are what
    the update's measurements say of the pose, the first six components of the error, and of the pose together with
    the keyframes (`jaxtri.filters.projective`).
    """
    moved = transition @ sensitivity
    return moved - covariance[:, :6] @ (information @ moved[:6] + coupling)


def total(own: Float[Array, "6 6"], keyframes: Keyframes, sensitivity: Float[Array, "d s"]) -> Float[Array, "6 6"]:
    """Covariance of the current pose: its `own`, and what the errors of the keyframes add to it."""
    B = sensitivity[:6]
    return own + B @ keyframes.covariance @ B.T
