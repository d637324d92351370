"""One frame measured, whichever base frames its tracks stand on: predict, update, and judge what came of it."""

import math
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxtri.filters import consensus, ekf
from jaxtri.filters.model import Mean
from jaxtri.filters.projective import Moments, Projective
from jaxtri.models.depth import Depth
from jaxtri.odometry.settings import Settings, Status

# Share of the measured tracks that must agree for an update to stand: below it most of what is seen contradicts it.
LEAST_SHARE = 0.25
# A measured frame is in doubt where the normalised innovation squared of its points is so many times what it should be
# (of points that agree with nothing, and lie evenly in the gate, it is 3.45 times that), where no more than this share
# of what was measured agrees, and where a rotation is known to no more than this angle (radians).
MISFIT, MINORITY, BLURRED = 2.5, 0.5, 0.0175
# Standard deviation of the first pose, in scene depths and radians. It is the gauge, so this is as good as exact, far
# below what any image tells; at zero its components would have no scale.
GAUGE = 1e-6
# Standard deviation of the velocity at a start, in scene depths and in radians per frame: at video rate it is all but
# unknown, and the first update fixes it.
START_VELOCITY = 0.05
# Variance of the noise over what it was taken for, that a frame may show at most: a bad frame does not rule the next.
SUDDEN = 10.0
# How fast a track that is not measured is trusted again, over how fast one that does not agree loses trust.
FORGIVING = 0.1
# Inverse depth (1 / scene units) from which a point counts as infinitely far: what is divided by it stays finite.
FARTHEST = 1e-9


def structure_model(settings: Settings) -> Depth:
    """The model of the filters of the points. Their gate is that of the pose's filter."""
    return Depth.of(settings.sigma, gate=settings.robust.gate)


def noise_scale(settings: Settings, quality: Float[Array, "n 2"] | None) -> Float[Array, " n"] | None:
    """Standard deviation of each point over sigma; None where there is no `point_noise` or no `quality`."""
    return None if quality is None or settings.point_noise is None else settings.point_noise.scale(quality)


class Measured(NamedTuple):
    """What a frame gave: the belief to go on with, and what is to be said of it.

    Attributes:
        belief: The update where enough points agree, else the prediction.
        taken: Whether `belief` is the update.
        coasted: Frames since the last one whose update was taken.
        status: A `Status`, as an integer.
        drop: (n,) tracks that are outliers.
        diagnostics: What the update found, taken or not; see `jaxtri.Diagnostics`.
    """

    belief: ekf.Belief
    taken: Bool[Array, ""]
    coasted: Int[Array, ""]
    status: Int[Array, ""]
    drop: Bool[Array, " n"]
    diagnostics: ekf.Diagnostics


class Transfer(ekf.Model[Mean], Projective[Mean], Protocol):
    """A model whose measurements are a linear map and a division."""


def measure(
    settings: Settings,
    model: Transfer[Mean],
    before: ekf.Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    dt: Float[Array, ""],
    coasted: Int[Array, ""],
    scale: Float[Array, " n"] | None,
) -> Measured:
    """Predict from the belief of the frame before, update with the tracks in `mask`, judge by how many agree.

    `observed` are normalised image points, `dt` is in frames, `coasted` the frames since the last update that was
    taken, `scale` what `noise_scale` gives.
    """
    predicted, items = ekf.predict(model, before, dt), ekf.prepare(model, items, mask)
    assert isinstance(items, Moments)
    robust = settings.robust
    begin = consensus.begin(model, predicted, items, observed, mask, robust, noise_scale=scale)
    updated, said = ekf.update(
        model, predicted, items, observed, mask, passes=settings.passes, robust=robust, noise_scale=scale, begin=begin
    )
    count = jnp.sum(mask).astype(settings.minimum.dtype)
    taken = said.used >= jnp.maximum(settings.minimum, LEAST_SHARE * count)
    belief = jax.tree.map(lambda a, b: jnp.where(taken, a, b), updated, predicted)
    coasted = jnp.where(taken, 0, coasted + 1)
    # Tracks do not come back: where too few of them are left, too few will agree in every later frame.
    lost = (coasted > settings.patience) | (count < settings.minimum)
    status = jnp.where(taken, Status.TRACKING, jnp.where(lost, Status.LOST, Status.COASTING)).astype(jnp.int32)
    return Measured(belief, taken, coasted, status, taken & mask & (said.distance > settings.outlier), said)


class Doubts(NamedTuple):
    """What speaks against a measured pose.

    Attributes:
        misfit: The points that agree fit much worse than their noise explains.
        minority: Fewer than half of the points measured agree.
        blurred: The rotation is known to a degree or worse.
    """

    misfit: Any
    minority: Any
    blurred: Any


def doubts(nis: Any, used: Any, measured: Any, rotation_sd: Any) -> Doubts:
    """Of a frame's numbers, of JAX's, NumPy's or Python's kind; `rotation_sd` in radians."""
    return Doubts(nis > MISFIT * 2 * used, used < MINORITY * measured, rotation_sd > BLURRED)


def judged(status: Int[Array, ""], covariance: Float[Array, "6 6"], said: ekf.Diagnostics) -> Int[Array, ""]:
    """The status of a frame once the covariance of its pose is known: a measured one may be uncertain."""
    sd = jnp.sqrt(jnp.max(jnp.diagonal(covariance)[3:]))
    found = doubts(said.nis, said.used, said.measured, sd)
    doubted = (status == Status.TRACKING) & (found.misfit | found.minority | found.blurred)
    return jnp.where(doubted, Status.UNCERTAIN, status).astype(jnp.int32)


def found_noise(
    settings: Settings, noise: Float[Array, ""], distance: Float[Array, " n"], measured: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Noise over `settings.sigma` once a frame has shown its points; `noise` is what it was taken for.

    `distance` are their squared distances in standard deviations by that. Half of them should lie below 2 log 2, the
    median of a chi-square of two degrees of freedom, and an outlier moves that little. It is never less than 1: an
    error that neighbours share goes into the pose, and no point shows it.
    Source: Mehra 1970, for covariance matching; Huber 1981, section 5.1, for the median.
    """
    shown = median(distance, measured) / (2 * math.log(2))
    share = jnp.clip(shown, 1 / SUDDEN, SUDDEN) ** (settings.noise_gain / 2)
    return jnp.maximum(noise * share, 1.0)


def agreement(
    settings: Settings, agreed: Float[Array, " n"], said: ekf.Diagnostics, measured: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Share of the latest frames that each track has agreed with, once one more is `measured`.

    A track of which that is less than half moves by itself, or is followed wrongly. It stays out until it is trusted
    again, a tenth as fast as it lost trust: of what moves, new points would agree again and again for some frames.
    """
    gain = settings.suspicion
    now = jnp.where(said.weights > 0, 1.0, 0.0).astype(agreed.dtype)
    return jnp.where(measured, agreed + gain * (now - agreed), agreed + FORGIVING * gain * (1 - agreed))


def median(x: Float[Array, " n"], mask: Bool[Array, " n"], without: float = 1.0) -> Float[Array, ""]:
    """Median of the unmasked entries; `without` where there is none."""
    ordered = jnp.sort(jnp.where(mask, x, jnp.inf))
    count = jnp.sum(mask)
    return jnp.where(count > 0, ordered[jnp.maximum(count - 1, 0) // 2], jnp.asarray(without, x.dtype))
