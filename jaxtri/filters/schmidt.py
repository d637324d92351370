"""An extended Kalman filter whose items have an error of their own that every frame meets again.

A point that stands on a few base frames brings the same error to all later ones. Taken for new each time it
makes a filter over-confident; put into the state it costs O(N^3). Here it is *considered* (Schmidt 1966): not
corrected, but counted with all that it has in common with the state, O(N d^2) a frame.

The error of the state is kept as a sum, its own and `sensitivity` times the errors m of the items. So its
covariance is a sum of squares and stays positive, in float32 too; the textbook form carries the
cross-covariances instead and subtracts.

Where to linearise is sought for state and items together: derivatives taken at an item that is wrong by m
have an error in common with the innovation, which m is part of, and it adds up to a drift of the scale.
"""

from typing import Any, Generic, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxtri.checks import checked
from jaxtri.filters.diagnostics import Diagnostics, Robust, count_passes, unless_overflown, weigh
from jaxtri.filters.linalg import posterior_error, scales, whiten
from jaxtri.filters.masks import replace_masked, safe_root, seen, stand_in
from jaxtri.filters.model import Belief, Dynamics, Mean, change_of_origin, transition
from jaxtri.filters.scan import checkpointed, each_frame


class ConsiderBelief(eqx.Module, Generic[Mean]):
    """A Gaussian on a manifold: the true state is `retract(mean, e)`, e ~ N(0, own) + sum_i sensitivity_i m_i."""

    mean: Mean
    own: Float[Array, "d d"]  # covariance of what the items have no part in
    sensitivity: Float[Array, "d n p"]

    def covariance(self, noise: Float[Array, "n p p"]) -> Float[Array, "d d"]:
        """Covariance of the whole error, given those of the items."""
        return self.own + owed(self.sensitivity, noise)


class Measured(NamedTuple):
    """The measurements of all items and their derivatives."""

    predicted: Float[Array, "n m"]
    jacobian: Float[Array, "n m d"]  # with respect to the error of the state
    spread: Float[Array, "n m p"]  # with respect to the error of the item


@runtime_checkable
class ConsiderModel(Dynamics[Mean], Protocol[Mean]):
    """What this filter asks of its problem: as `jaxtri.filters.model.Model`, but for the measurements, all at once."""

    sigma: Float[Array, ""]  # of a component of a measurement

    def measured(self, mean: Mean, items: Any, moved: Float[Array, "n p"]) -> Measured:
        """The measurements of items moved by an error."""
        ...

    def item_noise(self, mean: Mean, items: Any) -> Float[Array, "n p p"]:
        """Covariances of the errors of all items, finite for those too that are never seen."""
        ...


class ItemUpdate(NamedTuple):
    """What a frame says of the items, the state being as it is: least squares, item by item.

    As `update` returns it, zero but for the items that are absorbed.
    """

    moved: Float[Array, "n p"]  # where it moves them
    gain: Float[Array, "n p m"]
    at: Measured  # where it was linearised


def owed(sensitivity: Float[Array, "d n p"], noise: Float[Array, "n p p"]) -> Float[Array, "d d"]:
    """Covariance of what a state owes to the errors of the items."""
    return _rows(jnp.einsum("dnp,npq->dnq", sensitivity, noise)) @ _rows(sensitivity).T


def _rows(x: Float[Array, "d n p"]) -> Float[Array, "d np"]:
    return x.reshape(x.shape[0], -1)


def _times(F: Float[Array, "e d"], x: Float[Array, "d n p"]) -> Float[Array, "e n p"]:
    return (F @ _rows(x)).reshape(-1, *x.shape[1:])


@checked
def predict(
    model: ConsiderModel[Mean], belief: ConsiderBelief[Mean], dt: Float[Array, ""] | float = 1.0
) -> ConsiderBelief[Mean]:
    """The belief one time step later."""
    dt = jnp.asarray(dt, belief.own.dtype)
    F = transition(model, belief.mean, dt)
    own = F @ belief.own @ F.T + model.process_noise(belief.mean, dt)
    return ConsiderBelief(model.predict(belief.mean, dt), own, _times(F, belief.sensitivity))


def total(model: ConsiderModel[Mean], belief: ConsiderBelief[Mean], items: PyTree[Array]) -> Belief[Mean]:
    """The belief with the covariance of its whole error."""
    return Belief(belief.mean, belief.covariance(model.item_noise(belief.mean, items)))


class _Pass(NamedTuple):
    """One linearisation; innovations are those of items that have not moved."""

    at: Measured
    item_noise: Float[Array, "n p p"]
    innovation: Float[Array, "n m"]
    whitener: Float[Array, "n m m"]  # of D = spread item_noise spread' + sigma^2
    distance: Float[Array, " n"]
    log_det: Float[Array, " n"]
    noise: Float[Array, "n m m"]  # D

    def whitened(self, root: Float[Array, " n"]) -> tuple[Float[Array, "r d"], Float[Array, " r"]]:
        """Jacobian and innovation, r = n m, over the noise."""
        H = jnp.einsum("n,nij,njd->nid", root, self.whitener, self.at.jacobian)
        v = jnp.einsum("n,nij,nj->ni", root, self.whitener, self.innovation)
        return H.reshape(-1, H.shape[-1]), v.reshape(-1)

    def item_update(self, e: Float[Array, " d"]) -> ItemUpdate:
        """Where the items belong, for a state that is off by e."""
        inverse = jnp.einsum("nij,nik->njk", self.whitener, self.whitener)
        gain = jnp.einsum("npq,nmq,nmk->npk", self.item_noise, self.at.spread, inverse)
        left = self.innovation - jnp.einsum("nmd,d->nm", self.at.jacobian, e)
        return ItemUpdate(jnp.einsum("npm,nm->np", gain, left), gain, self.at)


def _linearise(
    model: ConsiderModel[Mean],
    mean: Mean,
    items: PyTree,
    moved: Float[Array, "n p"],
    item_noise: Float[Array, "n p p"],
    observed: Float[Array, "n m"],
    present: Bool[Array, " n"],
) -> _Pass:
    at = Measured(*replace_masked(present, model.measured(mean, items, moved), 0.0))
    predicted, _, spread = at
    innovation = observed - predicted + jnp.einsum("nmp,np->nm", spread, moved)
    D = jnp.einsum("nmp,npq,nkq->nmk", spread, item_noise, spread)
    D = D + jnp.square(model.sigma) * jnp.eye(observed.shape[1], dtype=D.dtype)
    W, log_det = jax.vmap(whiten)(D)
    distance = jnp.sum(jnp.einsum("nij,nj->ni", W, innovation) ** 2, axis=-1)
    return _Pass(at, item_noise, innovation, W, distance, log_det, D)


class _Gain(NamedTuple):
    """Schmidt's gain at the last linearisation."""

    error: Float[Array, " d"]  # the best one
    gain: Float[Array, "d n m"]
    log_det: Float[Array, ""]  # of the innovations' covariance over that of the noise
    nis: Float[Array, ""]


def _schmidt_gain(
    lin: _Pass,
    weights: Float[Array, " n"],
    sensitivity: Float[Array, "d n p"],
    prior: Float[Array, "d d"],
    reset: Float[Array, "d d"],
    centre: Float[Array, " d"],
) -> _Gain:
    """The gain of a `prior` about `centre` whose error has the items' errors in it; `reset` takes errors there.

    S = D + G M G' with G = [H, spread C'], C = sensitivity noise, and M = [[P, I], [I, 0]]; O(d) by Woodbury.
    """
    d, root = len(prior), safe_root(weights)
    H, v = lin.whitened(root)
    v = v - H @ centre
    cross = jnp.einsum("nmp,npq,dnq->nmd", lin.at.spread, lin.item_noise, sensitivity)
    cross = jnp.einsum("n,nij,njd->nid", root, lin.whitener, cross).reshape(-1, d) @ reset.T
    s = scales(prior)
    G = jnp.concatenate([H * s, cross / s], axis=1)
    zero, eye = jnp.zeros((d, d), prior.dtype), jnp.eye(d, dtype=prior.dtype)
    inner = jnp.block([[zero, eye], [eye, -prior / jnp.outer(s, s)]]) + G.T @ G
    right = jnp.concatenate([jnp.eye(2 * d, d, dtype=prior.dtype), (G.T @ v)[:, None]], axis=1)
    solved = jnp.linalg.solve(inner, right)
    nis = v @ v - (G.T @ v) @ solved[:, -1]
    # K of the whitened, then of the plain measurements.
    gain = s[:, None] * (solved[:, :-1].T @ G.T)
    error = centre + gain @ v
    gain = jnp.einsum("dni,n,nij->dnj", gain.reshape(d, *lin.innovation.shape), root, lin.whitener)
    return _Gain(error, gain, jnp.linalg.slogdet(inner)[1], nis)


def _posterior(
    model: ConsiderModel[Mean],
    belief: ConsiderBelief[Mean],
    mean: Mean,
    reset: Float[Array, "d d"],
    lin: _Pass,
    found: _Gain,
    absorbed: Bool[Array, " n"] | None,
) -> tuple[ConsiderBelief[Mean], ItemUpdate]:
    """The belief after the gain, and what the frame says of the items; `mean` is where it was linearised."""
    # The error now lives at the new mean, close by.
    final = model.retract(mean, found.error)
    shift = change_of_origin(model, mean, found.error, final)
    gain = _times(shift, found.gain)
    keep = (shift - _rows(gain) @ lin.at.jacobian.reshape(-1, len(reset))) @ reset
    sensitivity = _times(keep, belief.sensitivity)
    pulled = sensitivity - jnp.einsum("dnm,nmp->dnp", gain, lin.at.spread)
    own = keep @ belief.own @ keep.T
    said = lin.item_update(found.error)
    fresh = jnp.square(model.sigma) * gain
    if absorbed is not None:
        new = jnp.einsum("dnp,npm->dnm", sensitivity, said.gain) - gain
        fresh = jnp.where(absorbed[:, None], jnp.einsum("dnm,nmk->dnk", new, lin.noise), fresh)
        gain = jnp.where(absorbed[:, None], new, gain)
        pulled = jnp.where(absorbed[:, None], sensitivity, pulled)
    own = own + _rows(fresh) @ _rows(gain).T
    return ConsiderBelief(final, (own + own.T) / 2, pulled), said


@checked
def update(
    model: ConsiderModel[Mean],
    belief: ConsiderBelief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"] | None = None,
    *,
    absorb: Bool[Array, " n"] | None = None,
    passes: int | None = None,
    robust: Robust | None = None,
) -> tuple[ConsiderBelief[Mean], Diagnostics, ItemUpdate]:
    """The belief after the measurements of one frame; arguments as of `jaxtri.ekf.update`.

    `absorb` marks items whose measurement is about to enter their own estimate, as `ItemUpdate` says; those
    that the robust gate leaves out are not absorbed. The belief comes back with the sensitivity to the errors
    that they then have: what is new is the innovation s = spread m + v, and an item keeps m - gain s, which has
    nothing in common with it. So no measurement is counted twice.

    The passes before the last seek the point of linearisation and take the items' errors for new; the last
    one's gain is Schmidt's.
    """
    mask = seen(mask, observed.shape[:1])
    passes = count_passes(passes, robust)
    present = mask if absorb is None else mask | absorb
    item_noise = model.item_noise(belief.mean, items)
    items, observed = stand_in(present, items), replace_masked(present, observed, 0.0)
    P = belief.covariance(item_noise)

    def at(mean: Mean, moved: Array, k: Array) -> tuple[Array, Array, _Pass, Array, Array]:
        """The change to the errors of another mean, the prior's centre in these, and the linearisation there."""
        delta = model.local(belief.mean, mean)
        reset = change_of_origin(model, belief.mean, delta, mean)
        lin = _linearise(model, mean, items, moved, item_noise, observed, present)
        return reset, -reset @ delta, lin, *weigh(robust, lin.distance, mask, k, passes)

    def iterate(k: Array, carry: tuple[Mean, Array]) -> tuple[Mean, Array]:
        mean, moved = carry
        reset, centre, lin, weights, _ = at(mean, moved, k)
        H, v = lin.whitened(safe_root(weights))
        e = centre + posterior_error(reset @ P @ reset.T, H.T @ H, H.T @ (v - H @ centre))
        # An outlier says nothing of its item, which it might move to where the measurement is singular.
        believed = jnp.where(mask, weights, 1.0)[:, None]
        return model.retract(mean, e), believed * lin.item_update(e).moved

    still = jnp.zeros((mask.size, belief.sensitivity.shape[2]), belief.own.dtype)
    mean, moved = jax.lax.fori_loop(0, passes - 1, iterate, (belief.mean, still))
    reset, centre, lin, weights, used = at(mean, moved, jnp.asarray(passes - 1))
    found = _schmidt_gain(lin, weights, belief.sensitivity, reset @ P @ reset.T, reset, centre)
    absorbed = absorb
    if absorb is not None and robust is not None:
        absorbed = absorb & (lin.distance < robust.gate.astype(lin.distance.dtype))
    posterior, said = _posterior(model, belief, mean, reset, lin, found, absorbed)

    log_det = found.log_det + jnp.sum(jnp.where(used, lin.log_det, 0.0))
    left = lin.innovation - jnp.einsum("nmd,d->nm", lin.at.jacobian, found.error)
    distance = jnp.sum(jnp.einsum("nij,nj->ni", lin.whitener, left) ** 2, axis=-1)
    nis = found.nis + jnp.sum(jnp.where(used, 1 - weights, 0.0) * distance)  # each that is used counts in full
    diagnostics = Diagnostics.of(nis, log_det, observed.shape[1], mask, used, weights=weights, distance=distance)
    posterior, diagnostics, finite = unless_overflown(belief, posterior, diagnostics)
    absorbed = jnp.zeros_like(mask) if absorbed is None else absorbed
    moved, gain = replace_masked(absorbed, (said.moved, said.gain), 0.0)
    return posterior, diagnostics, jax.tree.map(lambda x: jnp.where(finite, x, 0), ItemUpdate(moved, gain, lin.at))


@checked
def step(
    model: ConsiderModel[Mean],
    belief: ConsiderBelief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"] | None = None,
    dt: Float[Array, ""] | float = 1.0,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
) -> tuple[ConsiderBelief[Mean], Diagnostics]:
    """Predict to the next frame and update with it."""
    return update(model, predict(model, belief, dt), items, observed, mask, passes=passes, robust=robust)[:2]


@checked
def filter(
    model: ConsiderModel[Mean],
    belief: ConsiderBelief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "t n m"],
    mask: Bool[Array, "t n"] | None = None,
    dt: Float[Array, " t"] | Float[Array, ""] | float | None = None,
    *,
    passes: int | None = None,
    robust: Robust | None = None,
    block: int = 1,
) -> tuple[Belief[Mean], Diagnostics]:
    """Beliefs, with their whole covariance, and diagnostics of all frames: as `jaxtri.ekf.filter`."""
    mask = seen(mask, observed.shape[:2])
    steps = each_frame(dt, len(observed), belief.own.dtype)

    def body(carry: ConsiderBelief, frame: tuple) -> tuple[ConsiderBelief, tuple]:
        z, visible, elapsed = frame
        carry, diagnostics = step(model, carry, items, z, visible, elapsed, passes=passes, robust=robust)
        return carry, (total(model, carry, items), diagnostics)

    return checkpointed(body, belief, (observed, mask, steps), block)[1]
