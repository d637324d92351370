"""Fit what a filter was told - noises, priors, intrinsics - to what it saw, by the gradient of its run.

A loss is any scalar of a model and data: the negative log-likelihood of the innovations, the pose error against
ground truth, the reprojection error. A parameter is any leaf of the model, which is any pytree.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

from jaxtri.compilation import Stable
from jaxtri.errors import InputError
from jaxtri.filters.diagnostics import Diagnostics
from jaxtri.filters.masks import stand_in
from jaxtri.geometry.trifocal import project
from jaxtri.trajectory import nees

DIRECTIONS = 16  # most directions along which the slope at a start is taken: each costs a run of the filter
STEP = 1e-4  # of these differences: a ten-thousandth of a noise, where its logarithm is fitted

M = TypeVar("M")
D = TypeVar("D")


@dataclass(frozen=True)
class Parameter:
    """A leaf to fit, scalar or array.

    Attributes:
        where: Picks the leaf from the model.
        log: Fit log(value - floor), for what is positive, instead of the value. On, since noises are what is fitted
            mostly.
        floor: Smallest value, with `log`. A noise that the data do not bound from below runs to zero: give it a floor
            above zero, or a prior.
        prior_sd: Standard deviation of a Gaussian prior about the value at the start, of the logarithm with `log`; it
            weighs as one observation of the loss. None for no prior.
    """

    where: Callable[[Any], Array]
    log: bool = True
    floor: float = 0.0
    prior_sd: float | None = None

    def free(self, value: Array) -> Array:
        """The number that is fitted, from the leaf."""
        return jnp.log(value - self.floor) if self.log else value

    def value(self, free: Array) -> Array:
        """The leaf, from the number that is fitted."""
        return self.floor + jnp.exp(free) if self.log else free


@dataclass(frozen=True)
class Fit(Generic[M]):
    """What a fit found.

    Attributes:
        model: The fitted model.
        converged: Whether the best start ended at a minimum, with a finite loss.
        loss_before: Loss of the model that was given.
        loss_after: Loss of the fitted model.
        steps: Steps of the solver, all starts together.
        changes: Value of each parameter before and after, by its name.
    """

    model: M
    converged: bool
    loss_before: float
    loss_after: float
    steps: int
    changes: dict[str, tuple[np.ndarray, np.ndarray]]

    def __str__(self) -> str:
        end = "converged" if self.converged else "not converged"
        lines = [f"loss {self.loss_before:.6g} -> {self.loss_after:.6g}, {end} after {self.steps} steps"]
        for name, (before, after) in self.changes.items():
            with np.printoptions(precision=4):
                lines.append(f"{name}: {before} -> {after}")
        return "\n".join(lines)


def fit(
    model: M,
    data: D,
    parameters: Mapping[str, Parameter],
    loss: Callable[[M, D], Float[Array, ""]],
    solver: optx.AbstractMinimiser | None = None,
    *,
    starts: int = 1,
    spread: float = 1.0,
    seed: int = 0,
    max_steps: int = 64,
    first_step: float = 1.0,
    forward: bool | None = None,
    progress: bool = True,
) -> Fit[M]:
    """The model whose `parameters` minimise `loss(model, data)`, every other leaf as it is.

    The solver is BFGS by default. The first start is the model itself, further ones are drawn about it with the
    standard deviation `spread` (of the logarithm, where that is fitted). The gradient is taken in forward mode
    for a single number and in reverse for more, or as `forward` says. Far from the best the slope of a likelihood
    is steep: the loss is scaled down where the first step along it would be longer than `first_step`. Host only.

    Raises `InputError` where a parameter cannot be fitted as it stands or the loss at the start is not finite.
    """
    parameters = _parameters(parameters)
    _check(parameters, loss, starts)
    leaves = _leaves(model, parameters)
    first = {name: p.free(leaves[name]) for name, p in parameters.items()}
    objective = _Objective(model, first, jnp.asarray(-1), jnp.asarray(1.0), Stable(loss), tuple(parameters.items()))
    before = float(_evaluate(objective, first, data))
    if not math.isfinite(before):
        raise InputError(f"the loss at the start is {before}: begin with larger noises, or look for NaN in the data")
    count = sum(x.size for x in leaves.values())
    options = {"autodiff_mode": "fwd" if (count == 1 if forward is None else forward) else "bwd"}
    solver = optx.BFGS(rtol=1e-6, atol=1e-6) if solver is None else solver
    found, best, steps, key = None, math.inf, 0, jax.random.key(seed)

    def reached(at: dict[str, Array]) -> float:
        value = float(_evaluate(objective, at, data))
        return math.inf if math.isnan(value) else value

    with _bar(starts * max_steps, progress) as bar:
        for k in range(starts):
            at = _drawn(first, spread, jax.random.fold_in(key, k)) if k else first
            scale, left, value = 0.0, max_steps, reached(at) if k else before
            while scale < 1 and left > 0:  # again from where the slope is less steep
                scale = min(1.0, max(first_step / _slope(reached, at, value), 10 * scale))
                watched = eqx.tree_at(lambda o: (o.bar, o.scale), objective, (bar, jnp.asarray(scale)))
                solution = optx.minimise(watched, solver, at, data, options, max_steps=max_steps, throw=False)
                at, taken = solution.value, int(solution.stats["num_steps"])
                left, steps = left - taken, steps + taken
                value = reached(at)
                if found is None or value <= best:
                    found, best = solution, value
    assert found is not None
    fitted = objective.put(found.value)
    changes = {n: (np.asarray(leaves[n]), np.asarray(p.where(fitted))) for n, p in parameters.items()}
    converged = bool(found.result == optx.RESULTS.successful) and math.isfinite(best)
    return Fit(fitted, converged, before, best, steps, changes)


def _parameters(given: Any) -> dict[str, Parameter]:
    """By name, each with a key that a notebook's cell, run again, finds the compiled program by."""
    example = 'as {"sigma": tuning.Parameter(lambda model: model.sigma)}'
    if not isinstance(given, Mapping):
        raise InputError(f"parameters are a {type(given).__name__}; give them by name, {example}")
    for name, parameter in given.items():
        if not isinstance(parameter, Parameter):
            raise InputError(f"parameters[{name!r}] is a {type(parameter).__name__}; give a Parameter, {example}")
    return {name: replace(p, where=Stable(p.where)) for name, p in given.items()}


def _check(parameters: Mapping[str, Parameter], loss: object, starts: int) -> None:
    if not parameters or starts < 1:
        raise InputError(f"{len(parameters)} parameters and {starts} starts: a fit wants at least one of each")
    if not callable(loss):
        raise InputError(f"loss is a {type(loss).__name__}; give a function of the model and the data")


def _leaves(model: Any, parameters: Mapping[str, Parameter]) -> dict[str, Array]:
    """The leaves to fit, by name; raises `InputError` where one cannot be fitted as it stands."""
    leaves = {name: jnp.asarray(p.where(model)) for name, p in parameters.items()}
    for name, p in parameters.items():
        if p.log and not bool(jnp.all(leaves[name] > p.floor)):
            raise InputError(f"{name} is {leaves[name]}: to be fitted by its logarithm it must be above {p.floor:g}")
    return leaves


def _drawn(first: Mapping[str, Array], spread: float, key: Array) -> dict[str, Array]:
    """Another start about the first."""
    keys = dict(zip(first, jax.random.split(key, len(first)), strict=True))
    return {n: x + spread * jax.random.normal(keys[n], x.shape, x.dtype) for n, x in first.items()}


class _Objective(eqx.Module):
    """The loss as a function of the free numbers; a pytree, so that a second fit of its kind is not compiled again."""

    model: Any
    first: dict[str, Array]
    bar: Int[Array, ""]  # of `_BARS`
    scale: Float[Array, ""]  # of the loss
    loss: Stable = eqx.field(static=True)
    parameters: tuple[tuple[str, Parameter], ...] = eqx.field(static=True)

    def put(self, free: Mapping[str, Array]) -> Any:
        """The model with the parameters in their places."""
        wheres = [p.where for _, p in self.parameters]
        values = [p.value(free[name]).astype(jnp.asarray(p.where(self.model)).dtype) for name, p in self.parameters]
        return eqx.tree_at(lambda m: [w(m) for w in wheres], self.model, values)

    def __call__(self, free: Mapping[str, Array], data: Any) -> Float[Array, ""]:
        """The loss, with what the priors say."""
        value = self.loss(self.put(free), data)
        for name, p in self.parameters:
            if p.prior_sd is not None:
                value = value + jnp.sum(jnp.square((free[name] - self.first[name]) / p.prior_sd)) / 2
        jax.debug.callback(_show, self.bar, value)
        return value * self.scale.astype(value.dtype)


@eqx.filter_jit
def _evaluate(objective: _Objective, free: Mapping[str, Array], data: Any) -> Float[Array, ""]:
    return objective(free, data)


def _slope(value: Callable[[dict[str, Array]], float], at: dict[str, Array], there: float) -> float:
    """Length of the gradient, by differences along a few directions: a gradient would be compiled once more."""
    flat, unravel = ravel_pytree(at)
    directions = np.eye(flat.size)
    if flat.size > DIRECTIONS:
        directions = np.linalg.qr(np.random.default_rng(0).standard_normal((flat.size, DIRECTIONS)))[0].T
    slopes = [(value(unravel(flat + STEP * jnp.asarray(d, flat.dtype))) - there) / STEP for d in directions]
    length = float(np.linalg.norm(slopes)) * math.sqrt(flat.size / len(directions))
    return length if math.isfinite(length) and length > 0 else 1.0


_BARS: dict[int, tqdm] = {}


@contextmanager
def _bar(total: int, progress: bool) -> Iterator[Int[Array, ""]]:
    # By number: a compiled function cannot hold the bar itself, or it would be compiled for every bar.
    number = max(_BARS, default=0) + 1
    with tqdm(total=total, desc="fit", leave=False, disable=None if progress else True) as bar:
        _BARS[number] = bar
        try:
            yield jnp.asarray(number)
        finally:
            jax.effects_barrier()  # the last updates come before the bar closes
            del _BARS[number]


def _show(number: Array, value: Array) -> None:
    bar = _BARS.get(int(number))
    if bar is not None:
        bar.update()
        bar.set_postfix_str(f"loss {float(value):.6g}", refresh=False)


def negative_log_likelihood(
    diagnostics: Diagnostics, components: int = 2, outlier: Float[Array, ""] | float = 0.0
) -> Float[Array, ""]:
    """Negative log-likelihood of all innovations of a run, per component of a measurement.

    Infinite where an update was refused. For iterated and robust updates it is Laplace's approximation: see
    `Diagnostics`. Each point that the robust gate leaves out counts with `outlier`, the logarithm of a density, lest a
    fit gain by leaving out what it explains badly; zero is one outlier evenly over an image of one normalised unit by
    one. For a run over recorded video use `jaxtri.replay.negative_log_likelihood`.
    """
    count = jnp.maximum(jnp.sum(diagnostics.measured), 1)
    outside = jnp.sum(diagnostics.measured - diagnostics.used) * outlier
    return -(jnp.sum(diagnostics.log_likelihood) + outside) / (components * count)


def nis_per_component(diagnostics: Diagnostics, components: int = 2) -> Float[Array, ""]:
    """Normalised innovation squared of a whole run over its degrees of freedom: 1 is right."""
    return jnp.sum(diagnostics.nis) / (components * jnp.maximum(jnp.sum(diagnostics.used), 1)).astype(
        diagnostics.nis.dtype
    )


def nees_loss(errors: Float[Array, "*batch d"], covariance: Float[Array, "*batch d d"]) -> Float[Array, ""]:
    """Squared logarithm of the mean normalised error squared over its expectation d: zero is right."""
    return jnp.square(jnp.log(jnp.mean(nees(errors, covariance)) / errors.shape[-1]))


def reprojection_loss(
    points: Float[Array, "n 3"],
    poses: SE3,
    observed: Float[Array, "t n 2"],
    mask: Bool[Array, "t n"],
) -> Float[Array, ""]:
    """Mean square of the reprojection errors, normalised image units, of world points in the `poses` (t,)."""

    world = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)

    def one(pose: SE3, u: Array, seen: Array) -> Array:
        X, u = stand_in(seen, (world, u))
        R, T = pose.rotation().as_matrix(), pose.translation()
        error = jax.vmap(lambda x: project(x, R, T))(X) - u
        return jnp.sum(jnp.where(seen[:, None], error, 0.0) ** 2)

    total = jnp.sum(jax.vmap(one)(poses, observed, mask))
    return total / jnp.maximum(2 * jnp.sum(mask), 1).astype(total.dtype)
