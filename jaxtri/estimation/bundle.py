"""Poses and points from all observations of them: bundle adjustment, the points eliminated.

A point is homogeneous, so that it may lie at infinity; its error has three components, in the axes of a camera that
sees it: two of its image there and its inverse depth, which are as Gaussian as a point's errors get. Noise is that of
an image point, `sigma`, robust by the weights of Geman and McClure. A feature that is followed from frame to frame
keeps much of its error: with a correlation it is that of the view before, times this, and something new (an
autoregression of first order), and what is new is weighted.
Source: Triggs et al. 2000, sections 6 and 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxtri.estimation.precision import Precision, before, block_diagonal
from jaxtri.filters.linalg import linearised
from jaxtri.geometry.epipolar import inverse_depth, parallax, safe_divide
from jaxtri.geometry.pose import matrix, retract

INFINITE = 1e-9  # depth, over that of the point's own coordinates, below which nothing is seen


class Views(NamedTuple):
    """What is seen from k poses of n points.

    Attributes:
        observed: (2, k, n) normalised image points.
        mask: (k, n) which of them are seen.
        correlation: Of a point's noise with that in the pose before, from 0 to below 1; None: there is none.
    """

    observed: Float[Array, "2 k n"]
    mask: Bool[Array, "k n"]
    correlation: Float[Array, ""] | None = None


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


class Looks(NamedTuple):
    """The first and the last look at each point, and what these two make of it.

    Attributes:
        R: (n, 3, 3) of the pose of the first one, world to camera.
        T: (n, 3) the same.
        u: (2, n) image there, normalised.
        inverse_depth: (n,) there, by both looks; meaningless where there is but one.
        angle: (n,) between their rays, radians; zero where there is but one.
    """

    R: Float[Array, "n 3 3"]
    T: Float[Array, "n 3"]
    u: Float[Array, "2 n"]
    inverse_depth: Float[Array, " n"]
    angle: Float[Array, " n"]


def looks(poses: SE3, views: Views) -> Looks:
    """Of all points."""
    k, n = views.mask.shape
    first, last = jnp.argmax(views.mask, axis=0), k - 1 - jnp.argmax(views.mask[::-1], axis=0)
    R, T, column = jax.vmap(lambda p: matrix(p.rotation()))(poses), poses.translation(), jnp.arange(n)
    u1, u2 = views.observed[:, first, column], views.observed[:, last, column]

    def two(u1: Array, u2: Array, R1: Array, T1: Array, R2: Array, T2: Array) -> tuple[Array, Array]:
        between = R2 @ R1.T
        shift = T2 - between @ T1
        return inverse_depth(u1, u2, between, shift, shift), parallax(u1, u2, between)

    rho, angle = jax.vmap(two)(u1.T, u2.T, R[first], T[first], R[last], T[last])
    return Looks(R[first], T[first], u1, rho, jnp.where(first < last, angle, 0.0))


class Linearised(NamedTuple):
    """All observations at one estimate: residuals and Jacobians, over sigma.

    Attributes:
        residual: (k, 2, n) of the images; zero where nothing is seen, and so are the others.
        pose: (k, 6, 2, n) derivative of the images with respect to the left perturbations of the poses.
        point: (k, 3, 2, n) with respect to the errors of the points.
        kept: (k, n) how much of a residual is that of the view before: zero in a track's first view. None: nothing.
        weights: (k, n) of what is new in them.
        cost: Robust cost of all of them.
    """

    residual: Float[Array, "k 2 n"]
    pose: Float[Array, "k 6 2 n"]
    point: Float[Array, "k 3 2 n"]
    kept: Float[Array, "k n"] | None
    weights: Float[Array, "k n"]
    cost: Float[Array, ""]


def _camera(pose: SE3) -> Float[Array, "3 4"]:
    return jnp.concatenate([matrix(pose.rotation()), pose.translation()[:, None]], axis=1)


class _Seen(NamedTuple):
    """Residuals over sigma, of what is seen in front of its camera, and what they cost."""

    residual: Float[Array, "k 2 n"]
    image: Float[Array, "k 2 n"]
    over: Float[Array, "k n"]  # one over depth and sigma
    kept: Float[Array, "k n"] | None
    root: Float[Array, "k n"]  # of the weights
    cost: Float[Array, ""]


def _seen(Z: Float[Array, "k 3 n"], views: Views, sigma: Float[Array, ""], scale: Float[Array, ""]) -> _Seen:
    """Of points at Z in the cameras."""
    seen = views.mask & (Z[:, 2] > INFINITE)
    depth = jnp.where(seen, Z[:, 2], 1.0)
    image = jnp.where(seen[:, None], Z[:, :2] / depth[:, None], 0.0)
    residual = jnp.where(seen[:, None], jnp.moveaxis(views.observed, 0, 1) - image, 0.0) / sigma
    if views.correlation is None:
        kept, distance = None, jnp.sum(residual**2, axis=1)
    else:
        kept = jnp.where(seen & before(seen), views.correlation, 0.0)
        distance = jnp.sum((residual - kept[:, None] * before(residual)) ** 2, axis=1) / (1 - kept**2)
    root = jnp.where(seen, 1 / (1 + distance / scale), 0.0)
    # What is seen, and would lie behind the camera, costs as much as any outlier.
    costs = jnp.where(views.mask, jnp.where(seen, distance * root, scale), 0.0)
    return _Seen(residual, image, jnp.where(seen, 1 / (depth * sigma), 0.0), kept, root, jnp.sum(costs))


def cost(
    poses: SE3, points: Points, views: Views, sigma: Float[Array, ""], scale: Float[Array, ""]
) -> Float[Array, ""]:
    """Robust cost of all observations: squares, as far as they are inside `scale`."""
    k, n = views.mask.shape
    Z = (jax.vmap(_camera)(poses).reshape(3 * k, 4) @ points.X).reshape(k, 3, n)
    return _seen(Z, views, sigma, scale).cost


def linearise(poses: SE3, points: Points, views: Views, sigma: Float[Array, ""], scale: Float[Array, ""]) -> Linearised:
    """Of all observations; `scale` is that of the robust weights: at this squared distance one counts a quarter."""

    def at(pose: SE3) -> tuple[Array, Array]:
        return linearised(lambda error: _camera(retract(pose, error)), jnp.zeros(6, sigma.dtype))

    k, n = views.mask.shape
    # Between barriers: what is fused into its readers is worked out again for each of them.
    M, slope = jax.lax.optimization_barrier(jax.vmap(at)(poses))  # (k, 3, 4), (k, 3, 4, 6)
    Z = (M.reshape(3 * k, 4) @ points.X).reshape(k, 3, n)
    dZ_pose = (jnp.moveaxis(slope, 3, 1).reshape(18 * k, 4) @ points.X).reshape(k, 6, 3, n)
    dZ_point = (M.reshape(3 * k, 4) @ points.basis.reshape(4, 3 * n)).reshape(k, 3, 3, n).swapaxes(1, 2)
    found = _seen(Z, views, sigma, scale)
    image, over = found.image[:, None], found.over[:, None, None]
    pose = (dZ_pose[:, :, :2] - image * dZ_pose[:, :, 2:]) * over
    point = (dZ_point[:, :, :2] - image * dZ_point[:, :, 2:]) * over
    return jax.lax.optimization_barrier(Linearised(found.residual, pose, point, found.kept, found.root**2, found.cost))


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


def reduce(
    said: Linearised,
    points: Points,
    prior: PointPrior,
    mask: Bool[Array, "k n"] | None = None,
    *,
    damping: Float[Array, ""] | float = 0.0,
) -> Reduced:
    """The points eliminated (Schur's complement), of what is new in the observations in `mask`.

    The diagonal of what is said of each point is raised by the share `damping`.
    """
    pose, point = said.pose, said.point
    k, _, _, n = pose.shape
    precision = Precision.of(said.weights if mask is None else jnp.where(mask, said.weights, 0.0), said.kept)
    heavy, left = jax.lax.optimization_barrier((precision @ point, precision @ said.residual))
    root, offset = _points(point, heavy, left, points, prior, damping)
    # The root first, on the points' side: a third of the sums.
    rooted = jax.lax.optimization_barrier(jnp.einsum("tsn,ksan->ktan", root, heavy))
    cross = jnp.sum(pose[:, :, None] * rooted[:, None], axis=3).reshape(6 * k, 3, n)
    direct = jnp.einsum("kem,km->ke", pose.reshape(k, 6, 2 * n), left.reshape(k, 2 * n)).reshape(6 * k)
    flat = cross.reshape(6 * k, 3 * n)
    information = precision.of_poses(pose) - flat @ flat.T
    return Reduced(information, direct - flat @ offset.reshape(-1), root, cross, offset)


def _points(
    point: Float[Array, "k 3 2 n"],
    heavy: Float[Array, "k 3 2 n"],
    left: Float[Array, "k 2 n"],
    points: Points,
    prior: PointPrior,
    damping: Float[Array, ""] | float,
) -> tuple[Float[Array, "3 3 n"], Float[Array, "3 n"]]:
    """The root and the offset of a `Reduced`; `heavy` and `left` are the derivatives and residuals times precision."""
    known = prior.sd**-2
    V = jnp.sum(heavy[:, :, None] * point[:, None], axis=(0, 3)).at[2, 2].add(known)
    V = V * (1 + damping * jnp.eye(3, dtype=V.dtype))[..., None]
    # A point that nothing sees: any root will do.
    V = V + jnp.where(V[0, 0] > 0, 0.0, 1.0) * jnp.eye(3, dtype=V.dtype)[..., None]
    b = jnp.sum(point * left[:, None], axis=(0, 2)).at[2].add(known * (prior.mean - points.inverse_depth))
    root, b = jax.lax.optimization_barrier((_inverse_root(V), b))
    return root, jnp.sum(root * b, axis=1)


def points_given(
    said: Linearised,
    points: Points,
    prior: PointPrior,
    step: Float[Array, "k 6"],
    damping: Float[Array, ""] | float = 0.0,
) -> Float[Array, "3 n"]:
    """The errors of the points that are best once those of the poses are given, as `Reduced.points` has them."""
    precision = Precision.of(said.weights, said.kept)
    moved = said.residual - jnp.einsum("kean,ke->kan", said.pose, step)
    root, offset = _points(said.point, precision @ said.point, precision @ moved, points, prior, damping)
    return jnp.einsum("tsn,tn->sn", root, offset)


def calibration_pull(
    said: Linearised,
    reduced: Reduced,
    observed: Float[Array, "2 k n"],
    sigma: Float[Array, ""],
    mask: Bool[Array, "k n"] | None = None,
) -> Float[Array, "s 3"]:
    """What errors of the camera's calibration pull the poses by, whatever the points: it is considered, not estimated.

    Errors of the focal length, as a share of it, and of the principal point, as shares of the focal length: these move
    the image points. (To first order in the lens's distortion, too.) Of the observations in `mask`.
    Source: Schmidt 1966; Bierman 1977, chapter VIII.
    """
    k, _, n = said.residual.shape
    # Derivative of the normalised image points, and so of the residuals: of (pixel - centre) / focal length.
    centre = jnp.broadcast_to(jnp.eye(2, dtype=sigma.dtype)[None, :, :, None], (k, 2, 2, n))
    common = -jnp.concatenate([jnp.moveaxis(observed, 0, 1)[:, None], centre], axis=1) / sigma
    weights = said.weights if mask is None else jnp.where(mask, said.weights, 0.0)
    common = jnp.where((weights > 0)[:, None, None], common, 0.0)
    heavy = Precision.of(weights, said.kept) @ common
    direct = jnp.einsum("kean,kpan->kep", said.pose, heavy).reshape(6 * k, 3)
    own = jnp.einsum("ksan,kpan->psn", said.point, heavy)
    return direct - jnp.einsum("etn,ptn->ep", reduced.cross, jnp.einsum("tsn,psn->ptn", reduced.root, own))


def without_length(between: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Projection on the errors of a pose that leave the length of its base line, `between`, as it is.

    In camera axes: exp(x) of a pose lengthens its base line by its part along it.
    """
    along = safe_divide(jnp.outer(between, between), between @ between)
    return jnp.eye(6, dtype=between.dtype) - jnp.pad(along, (0, 3))


def projected(left: Float[Array, "k 6 6"], A: Float[Array, "s s"], right: Float[Array, "k 6 6"]) -> Float[Array, "s s"]:
    """A matrix of k poses by k, projected pose by pose from both sides."""
    k = len(left)
    return jnp.einsum("kab,kblc,lcd->kald", left, A.reshape(k, 6, k, 6), right).reshape(6 * k, 6 * k)


def held(
    free: Float[Array, "k 6 6"], information: Float[Array, "s s"], pull: Float[Array, "s *q"]
) -> tuple[Float[Array, "s s"], Float[Array, "s *q"]]:
    """Normal equations whose solution has no other errors than those that are `free`: projections, pose by pose."""
    k = len(free)
    size = jnp.trace(information.reshape(k, 6, k, 6).diagonal(axis1=0, axis2=2)) / 6
    # What is not free gets information of its own: as much as the rest of its pose, so that all stay of one scale.
    rest = (jnp.eye(6, dtype=pull.dtype) - free) * jnp.where(size > 0, size, 1.0)[:, None, None]
    pull = jnp.einsum("kab,kb...->ka...", free, pull.reshape(k, 6, *pull.shape[1:])).reshape(pull.shape)
    return projected(free, information, free) + block_diagonal(rest), pull


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
