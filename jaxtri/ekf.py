"""One extended Kalman filter for every model: iterated, masked, robust, O(N d^2 + d^3) a frame.

A belief is a mean on a manifold and the covariance of its d-dimensional error. A model supplies the motion,
the manifold and the measurement of one item; the update sums over N items and never forms the innovation
covariance of all of them. Nothing here knows of cameras.
"""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxtri import moments
from jaxtri.moments import Moments, Projective
from jaxtri.scan import checkpointed

Mean = TypeVar("Mean")
Taken = TypeVar("Taken", bound=PyTree)


class Belief(eqx.Module, Generic[Mean]):
    """A Gaussian on a manifold: the true state is `retract(mean, delta)` with delta ~ N(0, covariance)."""

    mean: Mean
    covariance: Float[Array, "d d"]


@runtime_checkable
class Dynamics(Protocol[Mean]):
    """The state of a filter and its motion; every method is a pure function."""

    def retract(self, mean: Mean, delta: Float[Array, " d"]) -> Mean:
        """The state moved by an error."""
        ...

    def local(self, mean: Mean, other: Mean) -> Float[Array, " d"]:
        """The error that takes `mean` to `other`."""
        ...

    def predict(self, mean: Mean, dt: Float[Array, ""]) -> Mean:
        """The state one time step later."""
        ...

    def process_noise(self, mean: Mean, dt: Float[Array, ""]) -> Float[Array, "d d"]:
        """Covariance of what the motion model leaves out."""
        ...


@runtime_checkable
class Model(Dynamics[Mean], Protocol[Mean]):
    """What a filter asks of its problem; every method is a pure function of one item.

    A model may also have an attribute `considered`, a boolean array (d,): error components that are counted
    with their covariance and never corrected (consider parameters, Schmidt 1966).
    """

    def measure(self, mean: Mean, item: Any) -> Float[Array, " m"]:
        """Predicted measurement of one item."""
        ...

    def noise(self, mean: Mean, item: Any) -> Float[Array, "m m"]:
        """Measurement noise of one item; may depend on the state."""
        ...


def number(x: Array | float) -> Array:
    """A leaf of a definite dtype: a weakly typed one would compile once more than a plain one."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.result_type(float))


class Robust(eqx.Module):
    """Graduated Geman-McClure weights w = (1 + m2/c)^-2, then a hard gate.

    The scale c falls geometrically from `start` to `scale` over the passes, so that the first pass sees a
    convex problem; m2 is the squared Mahalanobis distance under the measurement noise, not under the
    prediction: gating against the prediction throws good points away whenever the motion changes. `gate`
    is the m2 above which an item is left out in the end; 13.8 is the 99.9 % quantile of 2 components. A
    higher `start` survives a worse prediction and needs more passes: 1e5 nine, 1e7 about sixteen.
    """

    start: Float[Array, ""] = eqx.field(default=1e5, converter=number)
    scale: Float[Array, ""] = eqx.field(default=16.0, converter=number)
    gate: Float[Array, ""] = eqx.field(default=13.8, converter=number)

    def weights(self, distance: Float[Array, " n"], k: Int[Array, ""], passes: int) -> Float[Array, " n"]:
        """Weights in pass k of `passes`, of items whose squared Mahalanobis distance is given."""
        start, scale = self.start.astype(distance.dtype), self.scale.astype(distance.dtype)
        share = k.astype(distance.dtype) / max(passes - 2, 1)
        c = jnp.exp(jnp.log(start) + jnp.minimum(share, 1) * (jnp.log(scale) - jnp.log(start)))
        return (1 + distance / c) ** -2


class Diagnostics(eqx.Module):
    """What an update reports beside the belief.

    `log_likelihood` of the innovations and `nis`, the normalised innovation squared (chi-square with
    `used * m` degrees of freedom for a consistent filter), are taken at the last linearisation: Laplace's
    approximation, exact for one pass of a linear model. After robust weights both are those of the `used` items,
    each counted in full, about the robust estimate; of the `measured` ones the gate has left out the others.
    `distance` is m2 of every item after the update under the measurement noise alone (zero where masked).

    An update that overflows, as that of a filter which has long lost the track may, is not taken: the belief
    stays as predicted, `used` is zero and `log_likelihood` minus infinity.
    """

    log_likelihood: Float[Array, ""]
    nis: Float[Array, ""]
    measured: Int[Array, ""]
    used: Int[Array, ""]
    weights: Float[Array, " n"]
    distance: Float[Array, " n"]


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


def whiten(D: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Float[Array, ""]]:
    """W with W D W' = I, and log det D, in closed form: batched LAPACK calls on tiny blocks are slow."""
    if D.shape[0] == 1:
        return 1 / jnp.sqrt(D), jnp.log(D[0, 0])
    if D.shape[0] != 2:
        L = jnp.linalg.cholesky(D)
        W = jax.scipy.linalg.solve_triangular(L, jnp.eye(D.shape[0], dtype=D.dtype), lower=True)
        return W, 2 * jnp.sum(jnp.log(jnp.diagonal(L)))
    a, b = D[0, 0], D[0, 1]
    schur = D[1, 1] - b * b / a
    first, second = 1 / jnp.sqrt(a), 1 / jnp.sqrt(schur)
    W = jnp.stack([jnp.stack([first, jnp.zeros_like(a)]), jnp.stack([-b / a * second, second])])
    return W, jnp.log(a) + jnp.log(schur)


def replace_masked(mask: Bool[Array, " n"], items: PyTree, value: float) -> PyTree:
    """Masked entries become `value` before any mathematics, so that a NaN in them changes nothing."""

    def replace(x: Array) -> Array:
        shaped = mask.reshape(mask.shape + (1,) * (x.ndim - 1))
        return jnp.where(shaped, x, jnp.asarray(value, x.dtype))

    return jax.tree.map(replace, items)


def stand_in(mask: Bool[Array, " n"], items: PyTree) -> PyTree:
    """Masked items become copies of an unmasked one, or zero where there is none.

    Not zero everywhere: a model may be singular there, and 0 * inf in its gradient would be NaN.
    """
    some = jnp.argmax(mask)

    def replace(x: Array) -> Array:
        one = jnp.where(mask[some], x[some], jnp.zeros((), x.dtype))
        return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, one)

    return jax.tree.map(replace, items)


def _linearise(
    model: Model, prior: Any, delta: Array, items: PyTree, observed: Array, mask: Array, scale: Array | None
) -> _Linearisation:
    """Residual, Jacobian with respect to the error of the *prior*, and noise, at `retract(prior, delta)`."""

    def predicted(error: Array) -> Array:
        mean = model.retract(prior, error)
        return jax.vmap(lambda item: model.measure(mean, item))(items)

    h, push = jax.linearize(predicted, delta)
    columns = jax.vmap(push, out_axes=-1)(jnp.eye(delta.size, dtype=delta.dtype))
    mean = model.retract(prior, delta)
    noise = jax.vmap(lambda item: model.noise(mean, item))(items)
    if scale is not None:
        noise = noise * jnp.square(scale)[:, None, None]
    whitener, log_det = jax.vmap(whiten)(noise)
    whitened = replace_masked(mask, (observed - h, columns, whitener, log_det), 0.0)
    return _Linearisation(*whitened)


def prepare(model: Model[Mean], items: PyTree[Array], mask: Bool[Array, " n"]) -> PyTree[Array]:
    """The items in the form in which `update` sums over them, where the model has one (`jaxtri.moments`).

    Made once for all frames in which a part of those in `mask` is seen: a frame then costs less. What is prepared
    already, and the items of other models, come back as they are.
    """
    if isinstance(items, Moments) or not isinstance(model, Projective):
        return items
    return moments.prepare(model, stand_in(mask, items))


def _measuring(
    model: Model[Mean], d: int, items: PyTree, mask: Bool[Array, " n"]
) -> tuple[Callable[..., Evidence], np.ndarray]:
    """A frame's evidence as a function of prior, error, observations, mask and noise scale; and the error's support."""
    items = prepare(model, items, mask)
    if isinstance(items, Moments):
        assert isinstance(model, Projective)

        def at(prior: Mean, delta: Array, observed: Array, mask: Array, scale: Array | None) -> Evidence:
            return moments.linearise(model, prior, delta, items, observed, mask, scale)

        return at, model.support
    items = stand_in(mask, items)
    return lambda prior, delta, *frame: _linearise(model, prior, delta, items, *frame), np.arange(d)


def safe_root(weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Square root with a zero derivative at the zero of a masked item."""
    positive = weights > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, weights, 1.0)), 0.0)


def scales(P: Float[Array, "d d"]) -> Float[Array, " d"]:
    """Standard deviations of a covariance, to scale its coordinates by; 1 where there is no uncertainty."""
    variance = jnp.diagonal(P)
    return jnp.sqrt(jnp.where(variance > 0, variance, 1.0))


def regression(P: Float[Array, "d d"], cross: Float[Array, "d e"]) -> Float[Array, "e d"]:
    """cross' P^-1, what errors of covariance P say of others; a P that may be singular, where `cross` is zero, too."""
    s = scales(P)
    scaled, cross = P / jnp.outer(s, s), cross / s[:, None]
    # A direction without uncertainty gets no weight: rounding over the ridge, which must be far above it. What the
    # ridge takes from all others a second step gives back, up to its square.
    ridge = jnp.sqrt(jnp.finfo(P.dtype).eps)
    factors = jax.scipy.linalg.lu_factor(scaled + ridge * jnp.eye(len(P), dtype=P.dtype))
    found = jax.scipy.linalg.lu_solve(factors, cross)
    found = found + jax.scipy.linalg.lu_solve(factors, cross - scaled @ found)
    return (found / s[:, None]).T


class _Inverse(NamedTuple):
    """(I + A P)^-1 of the support, and log det (I + A P)."""

    matrix: Float[Array, "s s"]
    log_det: Float[Array, ""]


class _Prior(NamedTuple):
    """A prior covariance P, to be corrected by an A that is zero but for the rows and columns of the support.

    In coordinates scaled by the prior's standard deviations: without, float32 does not survive. A alone is never
    inverted (a scale it does not see leaves it rank deficient), nor is P (a pinned direction has no uncertainty),
    but I + A P of the support: once, all else is products.
    """

    P: Float[Array, "d d"]
    rows: Float[Array, "s d"]  # of P
    scales: Float[Array, " d"]
    support: np.ndarray  # (s,)

    @classmethod
    def of(cls, P: Float[Array, "d d"], support: np.ndarray) -> "_Prior":
        s = scales(P)
        P = P / jnp.outer(s, s)
        return cls(P, P[support], s, support)

    def _scaled(self, A: Float[Array, "s s"]) -> Float[Array, "s s"]:
        s = self.scales[self.support]
        return A * jnp.outer(s, s)

    def inverse(self, A: Float[Array, "s s"]) -> _Inverse:
        """(I + A P)^-1 of the support, and the logarithm of |I + A P|."""
        eye = jnp.eye(len(A), dtype=A.dtype)
        factors = jax.scipy.linalg.lu_factor(eye + self._scaled(A) @ self.rows[:, self.support])
        log_det = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(factors[0]))))
        return _Inverse(jax.scipy.linalg.lu_solve(factors, eye), log_det)

    def error(self, inverse: _Inverse, b: Float[Array, " s"]) -> Float[Array, " d"]:
        """(P^-1 + A)^-1 b."""
        return inverse.matrix @ (b * self.scales[self.support]) @ self.rows * self.scales

    def posterior(self, A: Float[Array, "s s"], inverse: _Inverse) -> Float[Array, "d d"]:
        """(P^-1 + A)^-1.

        With G = P (I + A P)^-1 it is P - G A P. Written as a sum of squares,
        (I - G A) P (I - G A)' + G A G', which is Joseph's form, it stays positive when G is off by rounding: in
        float32 the difference does not.
        """
        A, d = self._scaled(A), len(self.P)
        G = self.rows.T @ inverse.matrix
        GA = G @ A
        left = jnp.eye(d, dtype=A.dtype) - moments.embed(GA, self.support, d)
        covariance = left @ self.P @ left.T + GA @ G.T
        return (covariance + covariance.T) / 2 * jnp.outer(self.scales, self.scales)


def posterior_error(P: Float[Array, "d d"], A: Float[Array, "d d"], b: Float[Array, " d"]) -> Float[Array, " d"]:
    """(P^-1 + A)^-1 b, for a P that may be singular."""
    prior = _Prior.of(P, np.arange(len(P)))
    return prior.error(prior.inverse(A), b)


class _Pass(NamedTuple):
    """What one pass of an update found, no more than is needed after it: a loop is slow to hand on much."""

    optimal: Float[Array, " d"]  # the error that is best by it
    A: Float[Array, "s s"]
    inverse: _Inverse
    weights: Float[Array, " n"]
    used: Bool[Array, " n"]
    distance: Float[Array, " n"]  # of the items once the error is corrected
    log_det: Float[Array, ""]  # of the noise of the items used
    nis: Float[Array, ""]


def unless_overflown(
    prior: Taken, posterior: Taken, diagnostics: Diagnostics
) -> tuple[Taken, Diagnostics, Bool[Array, ""]]:
    """The posterior and its diagnostics, or where any number of these is not finite the prior; and whether all are."""
    numbers = [x.ravel() for x in jax.tree.leaves((posterior, diagnostics)) if jnp.issubdtype(x.dtype, jnp.inexact)]
    finite = jnp.isfinite(jnp.concatenate(numbers)).all()
    belief = jax.tree.map(lambda new, old: jnp.where(finite, new, old), posterior, prior)
    nothing = jax.tree.map(lambda x: jnp.where(finite, x, 0), diagnostics)
    unlikely = jnp.where(finite, diagnostics.log_likelihood, -jnp.inf)
    return belief, eqx.tree_at(lambda d: d.log_likelihood, nothing, unlikely), finite


def _nearby(model: Dynamics[Mean], mean: Mean, other: Mean) -> Float[Array, " d"]:
    """`model.local`, or what has the same derivative where the two coincide."""
    return getattr(model, "difference", model.local)(mean, other)


def change_of_origin(model: Dynamics[Mean], mean: Mean, delta: Float[Array, " d"], moved: Mean) -> Float[Array, "d d"]:
    """Derivative of the error at `moved`, which is `retract(mean, delta)`, with respect to that at `mean`."""
    return jax.jacfwd(lambda e: _nearby(model, moved, model.retract(mean, delta + e)))(jnp.zeros_like(delta))


def transition(model: Dynamics[Mean], mean: Mean, dt: Float[Array, ""]) -> Float[Array, "d d"]:
    """Derivative of the error after one time step with respect to the error before it."""
    after = model.predict(mean, dt)

    def error(delta: Array) -> Array:
        return _nearby(model, after, model.predict(model.retract(mean, delta), dt))

    noise = model.process_noise(mean, dt)
    return jax.jacfwd(error)(jnp.zeros(noise.shape[0], noise.dtype))


def predict(model: Model[Mean], belief: Belief[Mean], dt: Float[Array, ""] | float = 1.0) -> Belief[Mean]:
    """The belief one time step later."""
    P = belief.covariance
    dt = jnp.asarray(dt, P.dtype)
    F = transition(model, belief.mean, dt)
    return Belief(model.predict(belief.mean, dt), F @ P @ F.T + model.process_noise(belief.mean, dt))


def update(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"],
    *,
    passes: int = 4,
    robust: Robust | None = None,
    noise_scale: Float[Array, " n"] | None = None,
) -> tuple[Belief[Mean], Diagnostics]:
    """The belief after the measurements of one frame.

    `items` is what `model.measure` takes, with a leading axis n; `mask` False leaves an item out. `passes`
    counts the linearisations (Gauss-Newton on the posterior, Bell & Cathey 1993): one is the plain EKF.
    With `robust`, the passes before the last bring the weights down; eight or nine are needed. `noise_scale` is the
    standard deviation of each item's noise over what the model says, where something more is known of it.
    """
    P, mean = belief.covariance, belief.mean
    dtype, d = P.dtype, P.shape[0]
    linearise, support = _measuring(model, d, items, mask)
    noise_scale, observed = replace_masked(mask, noise_scale, 1.0), replace_masked(mask, observed, 0.0)
    valid, prior = mask.astype(dtype), _Prior.of(P, support)
    considered = getattr(model, "considered", None)

    def correct(error: Array) -> Array:
        return error if considered is None else jnp.where(considered, 0.0, error)

    def iterate(k: Array, before: Array) -> _Pass:
        delta = correct(before)
        evidence = linearise(mean, delta, observed, mask, noise_scale)
        weights, used = valid, mask
        if robust is not None:
            distance = evidence.distance
            weights = valid * robust.weights(distance, k, passes)
            used = mask & (distance < robust.gate.astype(dtype))
            weights = jnp.where((k == passes - 1) & ~used, 0.0, weights)
        A, b = evidence.normal_equations(weights)
        at = delta[support]
        b = b + A @ at
        inverse = prior.inverse(A)
        optimal = prior.error(inverse, b)
        # nu' S^-1 nu without S: by the solution's own normal equations, free of cancellation.
        best = optimal[support]
        left = distance = evidence.distance_after(best - at)
        if considered is not None:
            distance = evidence.distance_after(correct(optimal)[support] - at)
        nis = jnp.sum(jnp.where(used, left, 0.0)) + best @ (b - A @ best)
        log_det = jnp.sum(jnp.where(used, evidence.log_det, 0.0))
        return _Pass(optimal, A, inverse, weights, used, distance, log_det, nis)

    # A loop, all of it: another linearisation in the program would double the time its gradient takes to compile.
    zero, matrix, each = (jnp.zeros(shape, dtype) for shape in ((), (len(support), len(support)), len(mask)))
    last = _Pass(jnp.zeros(d, dtype), matrix, _Inverse(matrix, zero), valid, mask, each, zero, zero)
    last = jax.lax.fori_loop(0, passes, lambda k, found: iterate(k, found.optimal), last)
    optimal, A, inverse, weights, used, distance, noise_log_det, nis = last
    covariance = prior.posterior(A, inverse)
    final = correct(optimal)
    if considered is not None:
        # The gain of all other components is the optimal one, and so is what they have in common with these.
        covariance = jnp.where(jnp.logical_and.outer(considered, considered), P, covariance)

    moved = model.retract(mean, final)
    # The error now lives at the new mean: carry the covariance there.
    reset = change_of_origin(model, mean, final, moved)
    posterior = Belief(moved, reset @ covariance @ reset.T)

    log_det = inverse.log_det + noise_log_det
    constant = observed.shape[1] * jnp.log(2 * jnp.pi).astype(dtype) * jnp.sum(used).astype(dtype)
    diagnostics = Diagnostics(
        log_likelihood=-(nis + log_det + constant) / 2,
        nis=nis,
        measured=jnp.sum(mask),
        used=jnp.sum(used),
        weights=weights,
        distance=distance,
    )
    return unless_overflown(belief, posterior, diagnostics)[:2]


def step(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "n m"],
    mask: Bool[Array, " n"],
    dt: Float[Array, ""] | float = 1.0,
    *,
    passes: int = 4,
    robust: Robust | None = None,
) -> tuple[Belief[Mean], Diagnostics]:
    """Predict to the next frame and update with it."""
    return update(model, predict(model, belief, dt), items, observed, mask, passes=passes, robust=robust)


def filter(
    model: Model[Mean],
    belief: Belief[Mean],
    items: PyTree[Array],
    observed: Float[Array, "t n m"],
    mask: Bool[Array, "t n"],
    dt: Float[Array, " t"] | None = None,
    *,
    passes: int = 4,
    robust: Robust | None = None,
    block: int = 1,
) -> tuple[Belief[Mean], Diagnostics]:
    """Beliefs and diagnostics of all frames, stacked along a leading axis t.

    `belief` stands before the first frame, which is predicted to. `items` are the same in every frame;
    `dt` is one per frame, 1 by default. A reverse gradient keeps a belief a frame; of a long sequence, with
    `block`, one in every `block` frames: `jaxtri.scan`.
    """
    if dt is None:
        dt = jnp.ones(observed.shape[0], belief.covariance.dtype)
    items = prepare(model, items, mask.any(axis=0))

    def body(carry: Belief, frame: tuple) -> tuple[Belief, tuple]:
        z, seen, elapsed = frame
        carry, diagnostics = step(model, carry, items, z, seen, elapsed, passes=passes, robust=robust)
        return carry, (carry, diagnostics)

    # Checkpointed: the reverse pass keeps one belief a frame, and recomputes the rest.
    return checkpointed(body, belief, (observed, mask, dt), block)[1]


def smooth(model: Dynamics[Mean], beliefs: Belief[Mean], dt: Float[Array, " t"] | None = None) -> Belief[Mean]:
    """Beliefs of all frames given all frames, earlier and later ones, from those of `filter` and its `dt`.

    Fixed-interval smoothing by Rauch, Tung & Striebel 1965 in the errors of the manifold; O(t d^3). Directions
    without uncertainty stay, and so do considered components, whose smoothed covariances are right besides:
    what a frame leaves open given the next has nothing in common with later noise, however that is weighted.
    """
    if dt is None:
        dt = jnp.ones(beliefs.covariance.shape[0], beliefs.covariance.dtype)

    @jax.checkpoint
    def body(later: Belief[Mean], frame: tuple[Belief[Mean], Array]) -> tuple[Belief[Mean], Belief[Mean]]:
        now, elapsed = frame
        F, Q = transition(model, now.mean, elapsed), model.process_noise(now.mean, elapsed)
        P, predicted = now.covariance, model.predict(now.mean, elapsed)
        G = regression(F @ P @ F.T + Q, F @ P)
        zero = jnp.zeros(len(P), P.dtype)
        onto = G @ jax.jacfwd(lambda x: model.local(predicted, model.retract(later.mean, x)))(zero)
        delta = G @ model.local(predicted, later.mean)
        mean = model.retract(now.mean, delta)
        left = jnp.eye(len(P), dtype=P.dtype) - G @ F
        covariance = left @ P @ left.T + G @ Q @ G.T + onto @ later.covariance @ onto.T
        reset = change_of_origin(model, now.mean, delta, mean)
        smoothed = Belief(mean, reset @ covariance @ reset.T)
        return smoothed, smoothed

    last = jax.tree.map(lambda x: x[-1], beliefs)
    earlier = jax.tree.map(lambda x: x[:-1], beliefs)
    _, found = jax.lax.scan(body, last, (earlier, dt[1:]), reverse=True)
    return jax.tree.map(lambda x, end: jnp.concatenate([x, end[None]]), found, last)
