"""One frame measured, whichever base frames its tracks stand on: predict, update, and judge what came of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxtri.filters import ekf
from jaxtri.filters.model import Mean
from jaxtri.models.depth import Depth
from jaxtri.odometry.settings import Settings, Status

LEAST_SHARE = 0.25  # of the tracks measured that must agree for an update to stand


def structure_model(settings: Settings) -> Depth:
    """The filters of the points, which are gated as the pose's are."""
    return Depth.of(settings.sigma, gate=settings.robust.gate)


def noise_scale(settings: Settings, quality: Float[Array, "n 2"] | None) -> Float[Array, " n"] | None:
    """Noise of each point over sigma, where the settings have a model of it."""
    return None if quality is None or settings.point_noise is None else settings.point_noise.scale(quality)


class Measured(NamedTuple):
    """What a frame gave: the belief to go on with, and what is to be said of it."""

    belief: ekf.Belief  # the update where enough points agree, else the prediction
    taken: Bool[Array, ""]  # the update stands
    coasted: Int[Array, ""]  # frames since the last that did
    status: Int[Array, ""]
    drop: Bool[Array, " n"]  # tracks that are outliers
    diagnostics: ekf.Diagnostics


def measure(
    settings: Settings,
    model: ekf.Model[Mean],
    before: ekf.Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    dt: Float[Array, ""],
    coasted: Int[Array, ""],
    scale: Float[Array, " n"] | None,
) -> Measured:
    """Predict from the belief of the frame before, update with the tracks in `mask`, judge by how many agree."""
    predicted = ekf.predict(model, before, dt)
    updated, said = ekf.update(
        model, predicted, items, observed, mask, passes=settings.passes, robust=settings.robust, noise_scale=scale
    )
    count = jnp.sum(mask).astype(settings.minimum.dtype)
    taken = said.used >= jnp.maximum(settings.minimum, LEAST_SHARE * count)
    belief = jax.tree.map(lambda a, b: jnp.where(taken, a, b), updated, predicted)
    coasted = jnp.where(taken, 0, coasted + 1)
    # Tracks do not come back: with too few of them left no later frame can agree either.
    lost = (coasted > settings.patience) | (count < settings.minimum)
    status = jnp.where(taken, Status.TRACKING, jnp.where(lost, Status.LOST, Status.COASTING)).astype(jnp.int32)
    return Measured(belief, taken, coasted, status, taken & mask & (said.distance > settings.outlier), said)


def median(x: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median of the unmasked entries; 1 where there is none."""
    ordered = jnp.sort(jnp.where(mask, x, jnp.inf))
    count = jnp.sum(mask)
    return jnp.where(count > 0, ordered[jnp.maximum(count - 1, 0) // 2], jnp.ones((), x.dtype))
