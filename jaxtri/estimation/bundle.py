"""Poses and points from all observations of them: bundle adjustment, the points eliminated.

A point is homogeneous, so that it may lie at infinity; its error has three components, in the axes of a camera that
sees it: two of its image there and its inverse depth, which are as Gaussian as a point's errors get. Noise is that of
an image point, `sigma`, robust by the weights of Geman and McClure.
Source: Triggs et al. 2000, sections 6 and 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxtri.filters.linalg import linearised
from jaxtri.geometry.pose import matrix, retract

INFINITE = 1e-9  # depth, over that of the point's own coordinates, below which nothing is seen


class Views(NamedTuple):
    """What is seen from k poses of n points.

    Attributes:
        observed: (2, k, n) normalised image points.
        mask: (k, n) which of them are seen.
    """

    observed: Float[Array, "2 k n"]
    mask: Bool[Array, "k n"]


class Points(NamedTuple):
    """Homogeneous points of the world, and the directions of their errors.

    Attributes:
        X: (4, n) scene units.
        basis: (4, 3, n) derivative with respect to the three components of the error.
    """

    X: Float[Array, "4 n"]
    basis: Float[Array, "4 3 n"]

    @property
    def inverse_depth(self) -> Float[Array, " n"]:
        """Inverse depth in the camera whose axes the error is in, 1 / scene units."""
        return self.X[3]

    def moved(self, error: Float[Array, "3 n"]) -> "Points":
        """The points moved by their errors."""
        return self._replace(X=self.X + jnp.einsum("qsn,sn->qn", self.basis, error))


def seen_from(
    R: Float[Array, "n 3 3"], T: Float[Array, "n 3"], u: Float[Array, "2 n"], rho: Float[Array, " n"]
) -> Points:
    """The points at the image points u and the inverse depths rho of poses R, T (world to camera)."""
    Rt = jnp.moveaxis(R, 0, -1).swapaxes(0, 1)  # (world, camera, n)
    centre = -jnp.einsum("wcn,nc->wn", Rt, T)
    ray = Rt[:, 0] * u[0] + Rt[:, 1] * u[1] + Rt[:, 2]
    zero, one = jnp.zeros_like(rho), jnp.ones_like(rho)
    X = jnp.concatenate([ray + centre * rho, rho[None]])
    basis = jnp.stack(
        [
            jnp.concatenate([Rt[:, 0], zero[None]]),
            jnp.concatenate([Rt[:, 1], zero[None]]),
            jnp.concatenate([centre, one[None]]),
        ],
        axis=1,
    )
    return Points(X, basis)


class Linearised(NamedTuple):
    """All observations at one estimate: residuals and Jacobians, over sigma and weighted.

    Attributes:
        residual: (k, 2, n) of the images.
        pose: (k, 6, 2, n) their derivative with respect to the left perturbations of the poses.
        point: (k, 3, 2, n) with respect to the errors of the points.
        weights: (k, n).
        cost: Robust cost of all of them.
    """

    residual: Float[Array, "k 2 n"]
    pose: Float[Array, "k 6 2 n"]
    point: Float[Array, "k 3 2 n"]
    weights: Float[Array, "k n"]
    cost: Float[Array, ""]


def linearise(poses: SE3, points: Points, views: Views, sigma: Float[Array, ""], scale: Float[Array, ""]) -> Linearised:
    """Of all observations; `scale` is that of the robust weights: at this squared distance one counts a quarter."""

    def at(pose: SE3) -> tuple[Array, Array]:
        def camera(error: Array) -> Array:
            moved = retract(pose, error)
            return jnp.concatenate([matrix(moved.rotation()), moved.translation()[:, None]], axis=1)

        return linearised(camera, jnp.zeros(6, sigma.dtype))

    k, n = views.mask.shape
    # Between barriers: what is fused into its readers is worked out again for each of them.
    M, slope = jax.lax.optimization_barrier(jax.vmap(at)(poses))  # (k, 3, 4), (k, 3, 4, 6)
    Z = (M.reshape(3 * k, 4) @ points.X).reshape(k, 3, n)
    dZ_pose = (jnp.moveaxis(slope, 3, 1).reshape(18 * k, 4) @ points.X).reshape(k, 6, 3, n)
    dZ_point = (M.reshape(3 * k, 4) @ points.basis.reshape(4, 3 * n)).reshape(k, 3, 3, n).swapaxes(1, 2)
    seen = views.mask & (Z[:, 2] > INFINITE)
    depth = jnp.where(seen, Z[:, 2], 1.0)
    image = jnp.where(seen[:, None], Z[:, :2] / depth[:, None], 0.0)
    residual = jnp.where(seen[:, None], jnp.moveaxis(views.observed, 0, 1) - image, 0.0) / sigma
    distance = jnp.sum(residual**2, axis=1)
    root = jnp.where(seen, 1 / (1 + distance / scale), 0.0)
    over = (root / depth / sigma)[:, None, None]
    pose = (dZ_pose[:, :, :2] - image[:, None] * dZ_pose[:, :, 2:]) * over
    point = (dZ_point[:, :, :2] - image[:, None] * dZ_point[:, :, 2:]) * over
    # What is seen, and would lie behind the camera, costs as much as any outlier.
    costs = jnp.where(views.mask, jnp.where(seen, distance * root, scale), 0.0)
    return jax.lax.optimization_barrier(Linearised(residual * root[:, None], pose, point, root**2, jnp.sum(costs)))


class Reduced(NamedTuple):
    """The normal equations of the poses, and what gives the points back.

    Attributes:
        information: (6k, 6k) what the observations say of the poses, whatever the points.
        pull: (6k,) its right side.
        root: (3, 3, n) W with W V W' = I, V the information on a point given the poses; lower triangular.
        cross: (6k, 3, n) W times the information that a point shares with the poses.
        offset: (3, n) W times the right side of a point.
    """

    information: Float[Array, "s s"]
    pull: Float[Array, " s"]
    root: Float[Array, "3 3 n"]
    cross: Float[Array, "s 3 n"]
    offset: Float[Array, "3 n"]

    def points(self, step: Float[Array, " s"]) -> Float[Array, "3 n"]:
        """The errors of the points that are best once those of the poses are given."""
        left = self.offset - jnp.tensordot(step, self.cross, 1)
        return jnp.einsum("tsn,tn->sn", self.root, left)


class PointPrior(NamedTuple):
    """What is known of the inverse depths beforehand: about `mean`, give or take `sd` (n,)."""

    mean: Float[Array, " n"]
    sd: Float[Array, " n"]


def reduce(said: Linearised, points: Points, prior: PointPrior, mask: Bool[Array, "k n"] | None = None) -> Reduced:
    """The points eliminated (Schur's complement), of the observations in `mask`."""
    residual, pose, point = said.residual, said.pose, said.point
    if mask is not None:
        residual = jnp.where(mask[:, None], residual, 0.0)
        pose, point = (jnp.where(mask[:, None, None], x, 0.0) for x in (pose, point))
    k, _, _, n = pose.shape
    known = prior.sd**-2
    V = jnp.sum(point[:, :, None] * point[:, None], axis=(0, 3)).at[2, 2].add(known)
    # A point that nothing sees: any root will do.
    V = V + jnp.where(V[0, 0] > 0, 0.0, 1.0) * jnp.eye(3, dtype=V.dtype)[..., None]
    b = jnp.sum(point * residual[:, None], axis=(0, 2)).at[2].add(known * (prior.mean - points.inverse_depth))
    root, b = jax.lax.optimization_barrier((_inverse_root(V), b))
    offset = jnp.sum(root * b, axis=1)
    # The root first, on the points' side: a third of the sums.
    rooted = jax.lax.optimization_barrier(jnp.einsum("tsn,ksan->ktan", root, point))
    cross = jnp.sum(pose[:, :, None] * rooted[:, None], axis=3).reshape(6 * k, 3, n)
    flat, each = cross.reshape(6 * k, 3 * n), pose.reshape(k, 6, 2 * n)
    U = jnp.einsum("kem,kfm->kef", each, each)
    direct = jnp.einsum("kem,km->ke", each, residual.reshape(k, 2 * n)).reshape(6 * k)
    return Reduced(block_diagonal(U) - flat @ flat.T, direct - flat @ offset.reshape(-1), root, cross, offset)


def block_diagonal(each: Float[Array, "k e e"]) -> Float[Array, "s s"]:
    """The matrix that has these blocks on its diagonal."""
    k, e, _ = each.shape
    return (each[:, :, None] * jnp.eye(k, dtype=each.dtype)[:, None, :, None]).reshape(k * e, k * e)


def _inverse_root(V: Float[Array, "3 3 n"]) -> Float[Array, "3 3 n"]:
    """Lower triangular W with W V W' = I: written out, batched LAPACK calls on tiny blocks are slow."""
    a = jnp.sqrt(V[0, 0])
    b, c = V[1, 0] / a, V[2, 0] / a
    d = jnp.sqrt(_positive(V[1, 1] - b * b, V[1, 1]))
    e = (V[2, 1] - b * c) / d
    f = jnp.sqrt(_positive(V[2, 2] - c * c - e * e, V[2, 2]))
    zero = jnp.zeros_like(a)
    rows = [1 / a, zero, zero, -b / (a * d), 1 / d, zero, (b * e / d - c) / (a * f), -e / (d * f), 1 / f]
    return jnp.stack(rows).reshape(3, 3, -1)


def _positive(x: Array, of: Array) -> Array:
    """A pivot that rounding cannot take below what the entry it came from is exact to."""
    return jnp.maximum(x, of * 4 * float(jnp.finfo(x.dtype).eps))


def solver(
    information: Float[Array, "s s"], damping: Float[Array, ""] | float = 0.0
) -> Callable[[Float[Array, "s *k"]], Float[Array, "s *k"]]:
    """Solves with a positive matrix whose diagonal is raised by the share `damping` of it, and by rounding."""
    diagonal = jnp.diagonal(information)
    s = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    ridge = damping + len(s) * float(jnp.finfo(s.dtype).eps)
    factor = jnp.linalg.cholesky(information / jnp.outer(s, s) + ridge * jnp.eye(len(s), dtype=s.dtype))

    def solve(b: Array) -> Array:
        wide = s.reshape(-1, *(1,) * (b.ndim - 1))
        return jax.scipy.linalg.cho_solve((factor, True), b / wide) / wide

    return solve
