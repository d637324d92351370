"""All keyframes of a sequence, and all points seen from them, at once: bundle adjustment of any length.

Keyframes stand in blocks. A chunk of tracks are those that begin in one block and are followed to the end of the next:
so what a chunk says concerns two blocks in a row, the normal equations of the poses are block tridiagonal, and time and
memory grow with the length of the sequence alone. Most tracks are short, and in a large block they would be mostly
empty places: so there are several layers of chunks, of smaller and larger blocks, and each track is in the first that
holds it. In the last one tracks are cut; a place that is seen again is a factor of its own (`jaxtri.estimation.loops`).
Chunks of a layer are all of one size and are worked out one after the other, as many as there are: so sequences of
different length share what is compiled.
Source: Triggs et al. 2000, sections 6 and 7.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.estimation.bundle import (
    Linearised,
    Points,
    Reduced,
    calibration_pull,
    held,
    points_given,
    projected,
    reduce,
    without_length,
)
from jaxtri.estimation.layers import Batch, Chunk, Layer, Noise
from jaxtri.estimation.loops import Closed, pose_blocks, with_own
from jaxtri.estimation.tridiagonal import Factors, Tridiagonal
from jaxtri.geometry.epipolar import safe_divide, safe_norm
from jaxtri.geometry.pose import compose, multiply, relative, retract

DAMPING, BETTER, WORSE = 1e-3, 0.1, 10.0  # of the equations of a step: at first, and after a step that is taken or not
TOLERANCE = 0.05  # standard deviations
MOST = 200  # steps of conjugate gradients; some ten are usual
LEAST, HOPELESS = 1e-9, 1e6  # damping: no less; from here on no step can lower the cost


class Estimate(NamedTuple):
    """Poses and points, on their way to the least robust cost.

    Attributes:
        poses: (k,) world to camera.
        points: Of each layer: (c, 4, n) and (c, 4, 3, n).
        cost: Robust squares of what is new in all observations.
        damping: Of the next step.
        steps: How many were tried.
        converged: Whether the last one moved the poses by less than the tolerance.
    """

    poses: SE3
    points: tuple[Points, ...]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]

    @classmethod
    def of(cls, poses: SE3, points: tuple[Points, ...]) -> "Estimate":
        """Where to begin."""
        dtype = points[0].X.dtype
        none, damping = jnp.asarray(0, jnp.int32), jnp.asarray(DAMPING, dtype)
        return cls(poses, points, jnp.asarray(jnp.inf, dtype), damping, none, jnp.asarray(False))

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether another step would change nothing, or none can lower the cost."""
        return self.converged | (self.damping > HOPELESS)


def step(batch: Batch, noise: Noise, now: Estimate, tolerance: Float[Array, ""] | float = TOLERANCE) -> Estimate:
    """One step of Levenberg and Marquardt's, taken if it lowers the cost.

    The `tolerance` is that of the length of the poses' step, over what they are known to, in the mean of squares of
    their components; and that is judged by the noise that is found, not by the one assumed.
    """
    return _stepped(batch, noise, now, *normal_equations(batch, noise, now.poses, now.points, now.damping), tolerance)


@jax.jit
def _stepped(
    batch: Batch,
    noise: Noise,
    now: Estimate,
    before: Float[Array, ""],
    equations: Tridiagonal,
    tolerance: Float[Array, ""] | float,
) -> Estimate:
    x = _factorised(batch, now.poses, equations, now.damping).solve(equations.pull)
    each = x.reshape(-1, 6)
    poses = moved_poses(batch, now.poses, each)

    def moved(chunk: Chunk, points: Points) -> tuple[Points, Array]:
        said = chunk.said(noise, now.poses, points)
        points = points.moved(points_given(said, points, chunk.prior, chunk.of(each), now.damping))
        return points, chunk.cost(noise, poses, points)

    points, after = zip(*batch.mapped(moved, now.points), strict=True)
    after = _sum(after) + _owed(batch, poses)
    better = after <= before
    taken, left = (poses, points, after), (now.poses, now.points, before)
    poses, points, least = jax.tree.map(lambda a, b: jnp.where(better, a, b), taken, left)
    damping = jnp.maximum(now.damping * jnp.where(better, BETTER, WORSE), LEAST)
    looks = sum(jnp.sum(layer.mask) for layer in batch.layers)
    length = jnp.sum(x * equations.pull) / (6 * jnp.sum(batch.present)) / (before / (2 * looks))
    converged = better & (length < tolerance**2)
    return Estimate(poses, points, least, damping, now.steps + 1, converged)


def optimum(
    batch: Batch,
    noise: Noise,
    poses: SE3,
    points: tuple[Points, ...],
    *,
    tolerance: Float[Array, ""] | float = TOLERANCE,
    most: int = 50,
) -> Estimate:
    """The least cost that is reached from `poses` and `points` in `most` steps. Its derivatives are in `implicit`."""

    def going(now: Estimate) -> Array:
        return ~now.done & (now.steps < most)

    return jax.lax.while_loop(going, lambda now: step(batch, noise, now, tolerance), Estimate.of(poses, points))


class Known(NamedTuple):
    """What is known at an estimate.

    Attributes:
        covariance: (k, 6, 6) of the poses' errors, left perturbations (linear, angular), scene units and radians.
            The calibration is taken to be exact in it.
        calibration: (k, 6, 3) what errors of the calibration do to the poses; see `bundle.calibration_pull`.
        points: Of each layer, what is known of its points.
    """

    covariance: Float[Array, "k 6 6"]
    calibration: Float[Array, "k 6 3"]
    points: "tuple[KnownPoints, ...]"


class KnownPoints(NamedTuple):
    """What is known of the points of a layer.

    Attributes:
        spread: (c, 4, 3, n) three errors of standard deviation sigma of each point, as `jaxtri.BasePoint` has them:
            its own, the poses given.
        residual: (c, 2 b, 2, n) of the image points, over sigma; zero where nothing is seen.
        weights: (c, 2 b, n) robust weights of what is new in them.
    """

    spread: Float[Array, "c 4 3 n"]
    residual: Float[Array, "c v 2 n"]
    weights: Float[Array, "c v n"]


def known(batch: Batch, noise: Noise, poses: SE3, points: tuple[Points, ...]) -> Known:
    """The covariances at an estimate."""
    _, equations = normal_equations(batch, noise, poses, points, jnp.zeros((), noise.sigma.dtype))
    return _known(batch, noise, poses, points, equations)


@jax.jit
def _known(batch: Batch, noise: Noise, poses: SE3, points: tuple[Points, ...], equations: Tridiagonal) -> Known:
    def one(chunk: Chunk, points: Points) -> tuple[KnownPoints, Array]:
        said = chunk.said(noise, poses, points)
        reduced = reduce(said, points, chunk.prior)
        spread = jnp.einsum("qsn,tsn->qtn", points.basis, reduced.root) / noise.sigma
        pull = calibration_pull(said, reduced, chunk.observed, noise.sigma).reshape(len(chunk.mask), 6, -1)
        return KnownPoints(spread, said.residual, said.weights), pull

    of_points, pulls = zip(*batch.mapped(one, points), strict=True)
    border = jnp.zeros((len(batch.present), *pulls[0].shape[2:]), noise.sigma.dtype)
    for layer, pull in zip(batch.layers, pulls, strict=True):
        border = border.at[layer.begin[:, None] + jnp.arange(pull.shape[1])].add(pull)
    factors = _factorised(batch, poses, equations, jnp.zeros((), noise.sigma.dtype))
    free = free_errors(batch, poses)
    each = pose_blocks(factors) if isinstance(factors, Factors) else factors.covariances()
    border = jnp.einsum("kab,kbp->kap", free, border)
    pulled = jax.vmap(factors.solve, in_axes=-1, out_axes=-1)(border.reshape(*equations.pull.shape, -1))
    return Known(free @ each @ free, pulled.reshape(border.shape), of_points)


def implicit(batch: Batch, noise: Noise, found: Estimate, *, tolerance: float = 1e-9) -> tuple[SE3, tuple[Points, ...]]:
    """Poses and points of an optimum, with their derivatives: with respect to the image points and the noise.

    By the implicit function theorem: one step of Newton's, by the whole curvature of the robust cost, from where the
    steps without it have ended; what these left open it removes. Its equations are solved by conjugate gradients,
    preconditioned by those of Gauss and Newton. All chunks are kept in memory.
    """
    still = jax.lax.stop_gradient
    poses, points = still(found.poses), still(found.points)
    free = free_errors(batch, poses)

    def only(x: Array) -> Array:
        return jnp.einsum("kab,kb->ka", free, x)

    def slope(errors: tuple, batch: Batch, noise: Noise) -> tuple:
        def objective(errors: tuple) -> Array:
            moved = moved_poses(batch, poses, only(errors[0]))
            new = tuple(jax.vmap(Points.moved)(p, e) for p, e in zip(points, errors[1], strict=True))

            # Those behind the last one too: a loop of as many as there are has no reverse derivative.
            def of_layer(layer: Layer, points: Points) -> Array:
                @jax.checkpoint
                def one(part: tuple[Array, Points]) -> Array:
                    index, points = part
                    return jnp.where(index < layer.chunks, layer.chunk(index).cost(noise, moved, points), 0.0)

                return jax.lax.map(one, (jnp.arange(len(layer.mask)), points))

            return (_sum(map(of_layer, batch.layers, new)) + _owed(batch, moved)) / 2

        return jax.grad(objective)(errors)

    dtype = noise.sigma.dtype
    zero = jnp.zeros((len(batch.present), 6), dtype), tuple(jnp.zeros_like(p.X[:, :3]) for p in points)
    at = still(batch), still(noise)

    def curvature(direction: tuple) -> tuple:
        along = jax.jvp(lambda e: slope(e, *at), (zero,), (direction,))[1]
        return along[0] + direction[0] - only(direction[0]), along[1]

    right = slope(zero, batch, noise)
    # In the coordinates that make those of Gauss and Newton the identity. As one vector, and compiled by itself: `cg`
    # does not take the tracers of a forward derivative otherwise.
    root = _root(*at, poses, points)
    back = jax.vjp(root, zero)[1]
    flat, tree = ravel_pytree(back(right)[0])

    @jax.jit
    def solve(right: Array) -> Array:
        def whitened(x: Array) -> Array:
            return ravel_pytree(back(curvature(root(tree(x))))[0])[0]

        return jax.scipy.sparse.linalg.cg(whitened, right, tol=tolerance, maxiter=MOST)[0]

    newton = root(tree(solve(flat)))
    new = tuple(jax.vmap(Points.moved)(p, -e) for p, e in zip(points, newton[1], strict=True))
    return moved_poses(batch, poses, -only(newton[0])), new


def _root(batch: Batch, noise: Noise, poses: SE3, points: tuple[Points, ...]) -> Callable[[tuple], tuple]:
    """S with S' H S = I, H the matrix of Gauss and Newton for poses and points."""

    def one(chunk: Chunk, points: Points) -> tuple[Array, Array]:
        reduced = reduce(chunk.said(noise, poses, points), points, chunk.prior)
        return reduced.root, reduced.cross

    none = jnp.zeros((), noise.sigma.dtype)
    _, equations = normal_equations(batch, noise, poses, points, none)
    factors = Factors.of(equations, none)
    reduced = batch.mapped(one, points)

    def root(white: tuple) -> tuple:
        x = factors.up(white[0].reshape(equations.pull.shape)).reshape(white[0].shape)
        new = []
        for layer, (root, cross), w in zip(batch.layers, reduced, white[1], strict=True):
            here = jax.vmap(lambda c, layer=layer: layer.chunk(c).of(x))(jnp.arange(len(w)))
            own = w - jnp.einsum("cetn,ce->ctn", cross, here.reshape(len(w), -1))
            new.append(jnp.einsum("ctsn,ctn->csn", root, own))
        return x, tuple(new)

    return root


def _sum(each: Iterable[Array]) -> Float[Array, ""]:
    return jnp.sum(jnp.concatenate(list(each)))


@jax.jit  # for eager callers: compiled once, for steps and for covariances
def normal_equations(
    batch: Batch, noise: Noise, poses: SE3, points: tuple[Points, ...], damping: Float[Array, ""]
) -> tuple[Float[Array, ""], Tridiagonal]:
    """The cost, and what all chunks say of the poses, in the blocks of the last layer, with the gauge held."""
    cost, equations, _ = assembled(batch, noise, poses, points, damping, lambda *_: ())
    if batch.loops is None:
        return cost, equations
    return cost + _owed(batch, poses), with_own(batch.loops, poses, free_errors(batch, poses), equations)


def _owed(batch: Batch, poses: SE3) -> Float[Array, ""] | float:
    """To the loops."""
    return 0.0 if batch.loops is None else batch.loops.cost(poses)


def _factorised(batch: Batch, poses: SE3, equations: Tridiagonal, damping: Float[Array, ""]) -> Factors | Closed:
    if batch.loops is None:
        return Factors.of(equations, damping)
    return Closed.of(batch.loops, poses, free_errors(batch, poses), equations, damping)


def assembled(
    batch: Batch,
    noise: Noise,
    poses: SE3,
    points: tuple[Points, ...],
    damping: Float[Array, ""],
    more: Callable[[Chunk, Linearised, Reduced], Any],
) -> tuple[Float[Array, ""], Tridiagonal, list]:
    """`normal_equations`, and `more` of what each chunk says, layer by layer; zeros behind the last chunk."""
    size, dtype = batch.layers[-1].size, noise.sigma.dtype
    m, s = len(batch.present) // size, 6 * size
    # Of each block what it has with itself, the upper half, and with the next.
    total = jnp.zeros((), dtype), jnp.zeros((m, s, 2 * s), dtype), jnp.zeros(m * s, dtype)

    def plus(rows: Array, more: Array, begin: Array) -> Array:
        at = begin // size, 6 * (begin % size), 6 * (begin % size)
        old = jax.lax.dynamic_slice(rows, at, (1, *more.shape))
        return jax.lax.dynamic_update_slice(rows, old + more, at)

    each = []
    for layer, of_layer in zip(batch.layers, points, strict=True):

        def linear(index: Array | int, layer: Layer = layer, of_layer: Points = of_layer) -> tuple[Array, tuple]:
            chunk, points = layer.chunk(index), jax.tree.map(lambda x: x[index], of_layer)
            said = chunk.said(noise, poses, points)
            return said.cost + chunk.owed(points), (chunk, said, reduce(said, points, chunk.prior, damping=damping))

        def add(index: Array, found: tuple, layer: Layer = layer, linear: Callable = linear) -> tuple:
            cost, (chunk, said, reduced) = linear(index)
            (before, rows, pull), others = found
            others = jax.tree.map(lambda x, y: x.at[index].set(y), others, more(chunk, said, reduced))
            b, half = layer.size, 6 * layer.size
            rows = plus(rows, reduced.information[:half], chunk.begin)
            rows = plus(rows, reduced.information[half:, half:], chunk.begin + b)
            at = 6 * chunk.begin
            there = jax.lax.dynamic_slice_in_dim(pull, at, 2 * half)
            pull = jax.lax.dynamic_update_slice_in_dim(pull, there + reduced.pull, at, 0)
            return (before + cost, rows, pull), others

        shapes = jax.eval_shape(lambda index, linear=linear: more(*linear(index)[1]), 0)
        empty = jax.tree.map(lambda x, layer=layer: jnp.zeros((len(layer.mask), *x.shape), x.dtype), shapes)
        total, found = jax.lax.fori_loop(0, layer.chunks, add, (total, empty))
        each.append(found)
    before, rows, pull = total
    own, above = jnp.triu(rows[:, :, :s]), rows[:-1, :, s:]
    free = free_errors(batch, poses).reshape(m, size, 6, 6)
    diagonal, pull = jax.vmap(held)(free, own + jnp.triu(own, 1).swapaxes(1, 2), pull.reshape(m, s))
    return before, Tridiagonal(diagonal, jax.vmap(projected)(free[:-1], above, free[1:]), pull), each


def moved_poses(batch: Batch, poses: SE3, x: Float[Array, "k 6"]) -> SE3:
    """The poses moved by errors that are free: what is given stays so, and not only to first order."""
    moved = jax.vmap(retract)(poses, x)

    def between(poses: SE3) -> SE3:
        first, far = (jax.tree.map(lambda x, i=i: x[i], poses) for i in (0, batch.farthest))
        return relative(first, far)

    before, after = between(poses).translation(), between(moved)
    length = safe_divide(safe_norm(before), safe_norm(after.translation()))
    first = jax.tree.map(lambda x: x[0], moved)
    far = multiply(compose(after.rotation(), after.translation() * length), first)
    return jax.tree.map(lambda x, y: x.at[batch.farthest].set(y), moved, far)


def free_errors(batch: Batch, poses: SE3) -> Float[Array, "k 6 6"]:
    """Projections on what the gauge leaves of the poses' errors; empty places have none."""
    k = len(batch.present)
    first = jax.tree.map(lambda x: x[0], poses)

    def one(index: Array, present: Array, pose: SE3) -> Array:
        far = without_length(relative(first, pose).translation())
        free = jnp.where(index == batch.farthest, far, jnp.eye(6, dtype=far.dtype))
        return jnp.where(present & (index > 0), free, 0.0)

    return jax.vmap(one)(jnp.arange(k), batch.present, poses)
