"""Maximum-likelihood pose of two views, with its covariance: the initial belief of every filter here."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SO3
from jaxtyping import Array, Bool, Float

from jaxtri.checks import checked
from jaxtri.geometry.epipolar import essential, safe_norm, sampson

AGREEING = 3.0  # sigmas of Sampson distance within which a pair counts in `rms`: others are taken for outliers
FEWEST = 5  # pairs for the five unknowns of a relative pose, unless a prior holds what the pairs leave open


class TwoView(eqx.Module):
    """Relative pose X2 = R X1 + T of two views, and how well it is known.

    Attributes:
        translation: (3,) T. Its length is the gauge, in whatever unit it was given.
        rotation: R.
        covariance: (6, 6) of the errors (T, R): a sum in T, `exp(delta) R` in R. It has no part along T.
        rms: Root mean square of the Sampson distances of the pairs that agree, over sigma: 1 is right.
        converged: Whether the estimate can be used: the refinement ended, at finite numbers, with enough pairs.
    """

    translation: Float[Array, "3"]
    rotation: SO3
    covariance: Float[Array, "6 6"]
    rms: Float[Array, ""]
    converged: Bool[Array, ""]


class _InOneDtype(optx.AbstractSearch):
    """A search whose state has the dtype of the unknowns.

    optimistix 0.1 begins a trust region with a step of JAX's default float, strongly typed: where that is double, a
    problem in single precision ends in a ValueError of lineax.
    """

    search: optx.AbstractSearch

    def init(self, y: Any, f_info_struct: Any) -> Any:
        """The search's state."""
        state = self.search.init(y, f_info_struct)
        dtype = jnp.result_type(*jax.tree.leaves(y))
        return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x, state)

    def step(self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: Any) -> Any:
        """The search's step."""
        return self.search.step(first_step, y, y_eval, f_info, f_eval_info, state)


def scaled(two_view: TwoView, length: Float[Array, ""] | float) -> TwoView:
    """The same relative pose with its translation multiplied by `length`."""
    C = two_view.covariance
    s = jnp.concatenate([jnp.full(3, length, C.dtype), jnp.ones(3, C.dtype)])
    return replace(two_view, translation=two_view.translation * length, covariance=C * jnp.outer(s, s))


def tangent_basis(n: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Orthonormal basis of the plane perpendicular to the unit vector n (Duff et al. 2017)."""
    sign = jnp.where(n[2] < 0, -1.0, 1.0).astype(n.dtype)
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return jnp.stack(
        [
            jnp.stack([1 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]]),
            jnp.stack([b, sign + n[1] ** 2 * a, -n[1]]),
        ],
        axis=1,
    )


@checked
def refine(
    translation: Float[Array, "3"],
    rotation: SO3,
    u1: Float[Array, "n 2"],
    u2: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""] | float,
    *,
    prior: Float[Array, "6 6"] | None = None,
    huber: float = 2.0,
    max_steps: int = 64,
) -> TwoView:
    """Pose that minimises the robust Sampson distances of the pairs, with |T| as given.

    `u1`, `u2` are normalised points with the noise `sigma` (noise_px / focal length); masked pairs count nothing.
    `prior` is the covariance of the given pose, errors (T, R), where the estimate is to be combined with what was known
    (its part along T counts nothing). Distances beyond `huber` sigmas count linearly. The Sampson distance is, to first
    order, the residual left when every point's structure is eliminated (Hartley & Zisserman 2004, 11.4.3).
    """
    dtype = translation.dtype
    sigma = jnp.asarray(sigma, dtype)
    length = safe_norm(translation)
    basis = tangent_basis(translation / length)
    valid = mask.astype(dtype)
    u1, u2 = (jnp.where(mask[:, None], u, jnp.zeros((), dtype)) for u in (u1, u2))
    root = None if prior is None else _root_of_information(prior, basis, length)

    def pose(x: Float[Array, "5"]) -> tuple[Array, SO3]:
        T = translation / length + basis @ x[:2]
        return T / safe_norm(T) * length, SO3.exp(x[2:]) @ rotation

    def distances(x: Float[Array, "5"]) -> Array:
        T, R = pose(x)
        E = essential(R.as_matrix(), T / length)
        return jax.vmap(lambda a, b: sampson(E, a, b))(u1, u2) / sigma * valid

    def residuals(x: Float[Array, "5"], _: None) -> Array:
        r = _huberised(distances(x), huber)
        return r if root is None else jnp.concatenate([r, root @ x])

    x, successful = _least_squares(residuals, jnp.zeros(5, dtype), max_steps)
    J = jax.jacfwd(lambda y: residuals(y, None))(x)
    inside = _inverse(J.T @ J)
    T, R = pose(x)
    onto = tangent_basis(T / length)
    J_T = jax.jacfwd(lambda y: pose(y)[0])(x)
    J_R = jax.jacfwd(lambda y: (pose(y)[1] @ R.inverse()).log())(x)
    lift = jnp.concatenate([onto @ (onto.T @ J_T), J_R])
    d = distances(x)
    inlier = jnp.abs(d) < AGREEING
    rms = jnp.sqrt(jnp.sum(jnp.where(inlier, d**2, 0)) / jnp.maximum(jnp.sum(valid * inlier), 1))
    covariance = lift @ ((inside + inside.T) / 2) @ lift.T
    known = jnp.all(jnp.isfinite(covariance)) & jnp.all(jnp.diagonal(inside) > 0)
    enough = (jnp.sum(mask) >= FEWEST) | (prior is not None)
    ok = successful & jnp.all(jnp.isfinite(x)) & known & enough
    return TwoView(T, R, covariance, rms, ok)


def _root_of_information(
    prior: Float[Array, "6 6"], basis: Float[Array, "3 2"], length: Float[Array, ""]
) -> Float[Array, "5 5"]:
    """What whitens the five unknowns: the inverse of a root of their covariance, that of the pose across T."""
    lift = jax.scipy.linalg.block_diag(basis.T / length, jnp.eye(3, dtype=prior.dtype))
    known = lift @ prior @ lift.T
    s = jnp.sqrt(jnp.diagonal(known))
    scaled = jnp.linalg.cholesky(known / jnp.outer(s, s))
    return jax.scipy.linalg.solve_triangular(scaled, jnp.diag(1 / s), lower=True)


def _huberised(d: Float[Array, " n"], huber: float) -> Float[Array, " n"]:
    """Root of twice the Huber loss, so that least squares minimises it."""
    large = jnp.abs(d) > huber
    safe = jnp.where(large, jnp.abs(d), huber)
    return jnp.where(large, jnp.sign(d) * jnp.sqrt(2 * huber * safe - huber**2), d)


def _least_squares(
    residuals: Callable[[Array, None], Array], first: Float[Array, " d"], max_steps: int
) -> tuple[Float[Array, " d"], Bool[Array, ""]]:
    """The minimum, with its derivatives, and whether it was reached."""
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
    solver = eqx.tree_at(lambda s: s.search, solver, _InOneDtype(solver.search))
    solution = optx.least_squares(residuals, solver, first, max_steps=max_steps, throw=False)
    # One Newton step from where it ended, which is not differentiated, has the derivatives of the minimum, and what
    # the tolerance left open does not spread in differences of the result.
    x = jax.lax.stop_gradient(solution.value)
    slope = jax.grad(lambda y: jnp.sum(jnp.square(residuals(y, None))) / 2)
    step = jnp.linalg.solve(jax.lax.stop_gradient(jax.jacfwd(slope)(x)), slope(x))
    return x - jnp.where(jnp.all(jnp.isfinite(step)), step, 0), solution.result == optx.RESULTS.successful


def _inverse(A: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Of a normal matrix, scaled to a unit diagonal: its rows have different units."""
    s = 1 / jnp.sqrt(jnp.where(jnp.diagonal(A) > 0, jnp.diagonal(A), 1))
    return jnp.outer(s, s) * jnp.linalg.solve(A * jnp.outer(s, s), jnp.eye(len(A), dtype=A.dtype))


def sensitivity(
    two_view: TwoView,
    u1: Float[Array, "n 2"],
    u2: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""] | float,
) -> Float[Array, "n 6 4"]:
    """What errors of the pairs do to an estimate: derivative of the error (T, R) with respect to those of (u1, u2).

    An error is truth minus estimate, or truth minus observation. `mask` and `sigma` are those of `refine`. Masked pairs
    have zero.
    """
    T, R = two_view.translation, two_view.rotation.as_matrix()

    def distance(error: Float[Array, "6"], pair: Float[Array, "4"]) -> Array:
        turned = R + jnp.cross(error[3:], R.T).T  # exp(error) R, to first order
        return sampson(essential(turned, T + error[:3]), pair[:2], pair[2:])

    pairs = jnp.concatenate([u1, u2], axis=-1)
    pairs = jnp.where(mask[:, None], pairs, pairs[jnp.argmax(mask)])
    of_pose, of_pair = jax.vmap(jax.grad(distance, argnums=(0, 1)), (None, 0))(jnp.zeros(6, T.dtype), pairs)
    weight = mask.astype(T.dtype) / jnp.square(jnp.asarray(sigma, T.dtype))
    return -jnp.einsum("n,ij,nj,nk->nik", weight, two_view.covariance, of_pose, of_pair)
