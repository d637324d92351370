"""One extended Kalman filter for every model: iterated, masked, robust, O(N d^2 + d^3) a frame.

A belief is a mean on a manifold and the covariance of its d-dimensional error. A model supplies the motion,
the manifold and the measurement of one item; the update sums over N items and never forms the innovation
covariance of all of them. Nothing here knows of cameras.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxtri.checks import checked
from jaxtri.errors import InputError
from jaxtri.filters import projective
from jaxtri.filters.diagnostics import Diagnostics, Robust, count_passes, unless_overflown, weigh
from jaxtri.filters.linalg import Inverse, Prior, linearised, whiten
from jaxtri.filters.masks import replace_masked, safe_root, seen, stand_in
from jaxtri.filters.model import Belief, Dynamics, Mean, Model, change_of_origin, predict
from jaxtri.filters.projective import Moments, Projective
from jaxtri.filters.scan import checkpointed, each_frame
from jaxtri.filters.smoother import smooth

__all__ = [
    "Belief",
    "Diagnostics",
    "Dynamics",
    "Model",
    "Robust",
    "filter",
    "predict",
    "prepare",
    "smooth",
    "step",
    "update",
]


@runtime_checkable
class Evidence(Protocol):
    """What a frame's measurements say at one state, in the s components of the error that they depend on."""

    log_det: Float[Array, " n"]  # of the noise of each item, zero where masked

    @property
    def distance(self) -> Float[Array, " n"]:
        """Squared Mahalanobis distance of the residual of each item, zero where masked."""
        ...

    def distance_after(self, step: Float[Array, " s"]) -> Float[Array, " n"]:
        """The same after a step of the error, by the linearisation."""
        ...

    def normal_equations(self, weights: Float[Array, " n"]) -> tuple[Float[Array, "s s"], Float[Array, " s"]]:
        """A = sum w H' D^-1 H and sum w H' D^-1 r: all that the items say, in s numbers."""
        ...


class _Linearisation(eqx.Module):
    """The plain form: a residual, a Jacobian and a noise for each item."""

    residual: Float[Array, "n m"]
    jacobian: Float[Array, "n m d"]
    whitener: Float[Array, "n m m"]  # W with W' W = inverse noise
    log_det: Float[Array, " n"]

    @property
    def distance(self) -> Array:
        return jnp.sum(jnp.einsum("nij,nj->ni", self.whitener, self.residual) ** 2, axis=-1)

    def distance_after(self, step: Array) -> Array:
        left = self.residual - jnp.einsum("nmd,d->nm", self.jacobian, step)
        return jnp.sum(jnp.einsum("nij,nj->ni", self.whitener, left) ** 2, axis=-1)

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        root = safe_root(weights)[:, None]
        H = jnp.einsum("nij,njd->nid", self.whitener, self.jacobian) * root[..., None]
        r = jnp.einsum("nij,nj->ni", self.whitener, self.residual) * root
        H = H.reshape(-1, H.shape[-1])
        return H.T @ H, H.T @ r.reshape(-1)


def _each(function: Callable[[Any], Array], items: PyTree, n: int) -> Array:
    """The function of all items; of none, where a model measures without, n times the same."""
    if not jax.tree.leaves(items):
        value = function(items)
        return jnp.broadcast_to(value, (n, *value.shape))
    return jax.vmap(function)(items)


def _linearise(
    model: Model, prior: Any, delta: Array, items: PyTree, observed: Array, mask: Array, scale: Array | None
) -> _Linearisation:
    """Residual, Jacobian with respect to the error of the *prior*, and noise, at `retract(prior, delta)`."""
    compare = getattr(model, "residual", jnp.subtract)
    # A copy of another observation stands in for what is masked: a residual may be singular at zero.
    filled = stand_in(mask, observed)

    def residual(error: Array) -> Array:
        mean = model.retract(prior, error)
        return jax.vmap(compare)(filled, _each(lambda item: model.measure(mean, item), items, len(filled)))

    left, slope = linearised(residual, delta)
    mean = model.retract(prior, delta)
    noise = _each(lambda item: model.noise(mean, item), items, len(filled))
    if scale is not None:
        noise = noise * jnp.square(scale)[:, None, None]
    whitener, log_det = jax.vmap(whiten)(noise)
    return _Linearisation(*replace_masked(mask, (left, -slope, whitener, log_det), 0.0))


def prepare(model: Model[Mean], items: PyTree[Array], mask: Bool[Array, " n"]) -> PyTree[Array]:
    """The items in the form in which `update` sums over them, where the model has one (`jaxtri.filters.projective`).

    Made once for all frames in which a part of those in `mask` is seen: a frame then costs less. What is prepared
    already, and the items of other models, come back as they are.
    """
    if isinstance(items, Moments) or not isinstance(model, Projective):
        return items
    return projective.prepare(model, stand_in(mask, items))


def _measuring(
    model: Model[Mean], belief: Belief[Mean], items: PyTree, mask: Bool[Array, " n"]
) -> tuple[Callable[..., Evidence], np.ndarray, int]:
    """A frame's evidence as a function of prior, error, observations, mask and noise scale.

    Also the components of the error that it depends on, and how many components an item's residual has.
    """
    items = prepare(model, items, mask)
    if isinstance(items, Moments):
        assert isinstance(model, Projective)

        def at(prior: Mean, delta: Array, observed: Array, mask: Array, scale: Array | None) -> Evidence:
            return projective.linearise(model, prior, delta, items, observed, mask, scale)

        return at, model.support, 2
    items = stand_in(mask, items)
    noise = jax.eval_shape(lambda: _each(lambda item: model.noise(belief.mean, item), items, len(mask)))
    support = np.arange(len(belief.covariance))
    return lambda prior, delta, *frame: _linearise(model, prior, delta, items, *frame), support, noise.shape[-1]


class _Pass(NamedTuple):
    """What one pass of an update found, no more than is needed after it: a loop is slow to hand on much."""

    optimal: Float[Array, " d"]  # the error that is best by it
    A: Float[Array, "s s"]
    inverse: Inverse
    weights: Float[Array, " n"]
    used: Bool[Array, " n"]
    distance: Float[Array, " n"]  # of the items once the error is corrected
    log_det: Float[Array, ""]  # of the noise of the items used
    nis: Float[Array, ""]


class _Passes(NamedTuple):
    """The passes of an update: Gauss-Newton on the posterior, the weights coming down."""

    at: Callable[[Array], Evidence]  # what the frame says at an error of the prior's mean
    prior: Prior
    mask: Bool[Array, " n"]
    considered: Bool[np.ndarray | Array, " d"] | None
    robust: Robust | None
    linearisations: int
    begin: Float[Array, " d"] | None

    def correct(self, error: Float[Array, " d"]) -> Float[Array, " d"]:
        """The error without its considered components."""
        return error if self.considered is None else jnp.where(self.considered, 0.0, error)

    def run(self) -> _Pass:
        """The last of them."""
        P, support = self.prior.P, self.prior.support
        # A loop, all of it: another linearisation in the program would double the time its gradient takes to compile.
        zero, matrix = jnp.zeros((), P.dtype), jnp.zeros((len(support), len(support)), P.dtype)
        valid, each = self.mask.astype(P.dtype), jnp.zeros(len(self.mask), P.dtype)
        begin = jnp.zeros(len(P), P.dtype) if self.begin is None else self.begin
        first = _Pass(begin, matrix, Inverse(matrix, zero), valid, self.mask, each, zero, zero)
        return jax.lax.fori_loop(0, self.linearisations, lambda k, found: self._one(k, found.optimal), first)

    def _one(self, k: Array, before: Array) -> _Pass:
        delta, support = self.correct(before), self.prior.support
        evidence = self.at(delta)
        weights, used = weigh(self.robust, evidence.distance, self.mask, k, self.linearisations)
        A, b = evidence.normal_equations(weights)
        at = delta[support]
        b = b + A @ at
        inverse = self.prior.inverse(A)
        optimal = self.prior.error(inverse, b)
        # nu' S^-1 nu without S: by the solution's own normal equations, free of cancellation.
        best = optimal[support]
        left = distance = evidence.distance_after(best - at)
        if self.considered is not None:
            distance = evidence.distance_after(self.correct(optimal)[support] - at)
        nis = jnp.sum(jnp.where(used, left, 0.0)) + best @ (b - A @ best)
        log_det = jnp.sum(jnp.where(used, evidence.log_det, 0.0))
        return _Pass(optimal, A, inverse, weights, used, distance, log_det, nis)


@checked
def update(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"] | None = None,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
    noise_scale: Float[Array, " n"] | None = None,
    begin: Float[Array, " d"] | None = None,
) -> tuple[Belief[Mean], Diagnostics]:
    """The belief after the measurements of one frame.

    `items` is what `model.measure` takes, with a leading axis n, or None where it needs nothing. `observed` are the
    measurements of all items; `mask` False leaves an item out, by default none. `passes` counts the linearisations
    (Gauss-Newton on the posterior, Bell & Cathey 1993): one is the plain EKF, 4 the default. With `robust` the passes
    before the last bring the weights down, and the default is `robust.passes`. `noise_scale` is the standard deviation
    of each item's noise over what the model says, where something more is known of it. `begin` is the error of the
    prediction at which the first pass linearises, zero by default: `jaxtri.filters.consensus`.

    Raises `InputError` where shapes or kinds do not fit, `passes` is below 1, a covariance is none, or the model's
    sigma is not positive; warns (`UnitsWarning`) where normalised image points are clearly pixels.
    """
    P, mean = belief.covariance, belief.mean
    mask = seen(mask, observed.shape[:1])
    linearise, support, components = _measuring(model, belief, items, mask)
    noise_scale, observed = replace_masked(mask, noise_scale, 1.0), replace_masked(mask, observed, 0.0)
    considered = getattr(model, "considered", None)
    if begin is not None and begin.shape != P.shape[:1]:
        raise InputError(f"begin has the shape {begin.shape}; an error of the prediction has {P.shape[:1]}")
    passes_ = _Passes(
        lambda delta: linearise(mean, delta, observed, mask, noise_scale),
        Prior.of(P, support),
        mask,
        considered,
        robust,
        count_passes(passes, robust),
        begin,
    )
    last = passes_.run()
    covariance, final = passes_.prior.posterior(last.A, last.inverse), passes_.correct(last.optimal)
    if considered is not None:
        # The gain of all other components is the optimal one, and so is what they have in common with these.
        covariance = jnp.where(jnp.logical_and.outer(considered, considered), P, covariance)
    moved = model.retract(mean, final)
    # The error now lives at the new mean: carry the covariance there.
    reset = change_of_origin(model, mean, final, moved)
    posterior = Belief(moved, reset @ covariance @ reset.T)
    log_det = last.inverse.log_det + last.log_det
    said = Diagnostics.of(last.nis, log_det, components, mask, last.used, weights=last.weights, distance=last.distance)
    return unless_overflown(belief, posterior, said)[:2]


@checked
def step(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"] | None = None,
    dt: Float[Array, ""] | float = 1.0,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
) -> tuple[Belief[Mean], Diagnostics]:
    """Predict to the next frame, `dt` later, and update with it: arguments as of `update`."""
    return update(model, predict(model, belief, dt), items, observed, mask, passes=passes, robust=robust)


@checked
def filter(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "t n m"],
    mask: Bool[Array, "t n"] | None = None,
    dt: Float[Array, " t"] | Float[Array, ""] | float | None = None,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
    block: int = 1,
) -> tuple[Belief[Mean], Diagnostics]:
    """Beliefs and diagnostics of all frames, stacked along a leading axis t: arguments as of `update`.

    `belief` stands before the first frame, which is predicted to. `items` are the same in every frame; `dt` is the
    time since the frame before, one for all or one a frame, 1 by default. A reverse gradient keeps a belief a frame;
    of a long sequence, with `block`, one in every `block` frames: `jaxtri.filters.scan`.
    """
    mask = seen(mask, observed.shape[:2])
    steps = each_frame(dt, len(observed), belief.covariance.dtype)
    items = prepare(model, items, mask.any(axis=0))

    def body(carry: Belief, frame: tuple) -> tuple[Belief, tuple]:
        z, visible, elapsed = frame
        carry, diagnostics = step(model, carry, items, z, visible, elapsed, passes=passes, robust=robust)
        return carry, (carry, diagnostics)

    # Checkpointed: the reverse pass keeps one belief a frame, and recomputes the rest.
    return checkpointed(body, belief, (observed, mask, steps), block)[1]
