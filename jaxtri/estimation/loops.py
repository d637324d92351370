"""Places seen again, as factors between keyframes that are far apart in the sequence.

What is seen of a place on coming back fixes the pose of the camera relative to two keyframes of then, whose base line
is the unit of length: so a factor says nothing of the scale at which either was followed. It concerns three poses,
wherever they stand, and the normal equations of the others stay block tridiagonal: with few such factors these are
solved as a change of low rank. Source: Woodbury 1950.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from jaxtri.estimation.tridiagonal import Factors, Tridiagonal
from jaxtri.geometry.epipolar import safe_divide, safe_norm
from jaxtri.geometry.pose import compose, local, relative, retract


class Loops(NamedTuple):
    """Poses relative to pairs of keyframes.

    Attributes:
        keys: (l, 3) keyframe that sees a place again, and the two that it was seen from.
        seen: (l,) pose of the first camera relative to the second; the way to the third is the unit of length.
        root: (l, 6, 6) R with R' R the information of its error, a left perturbation (linear, angular).
        weights: (l,) zero of those that count nothing.
    """

    keys: Int[Array, "l 3"]
    seen: SE3
    root: Float[Array, "l 6 6"]
    weights: Float[Array, " l"]

    def errors(self, poses: SE3) -> Float[Array, "l 6"]:
        """Of poses (k,), in standard deviations."""
        return jax.vmap(_error)(self._three(poses), self.seen, self.root)

    def cost(self, poses: SE3) -> Float[Array, ""]:
        """Weighted squares of the errors."""
        return jnp.sum(self.weights[:, None] * self.errors(poses) ** 2)

    def linearised(self, poses: SE3, free: Float[Array, "k 6 6"]) -> tuple[Array, Array]:
        """Errors (l, 6), and their derivatives (l, 3, 6, 6) by errors of the poses that are `free`; both weighted."""

        def one(three: SE3, seen: SE3, root: Array) -> tuple[Array, Array]:
            def moved(x: Array) -> Array:
                return _error(jax.vmap(retract)(three, x), seen, root)

            none = jnp.zeros((3, 6), root.dtype)
            return moved(none), jnp.moveaxis(jax.jacfwd(moved)(none), 0, 1)

        errors, by = jax.vmap(one)(self._three(poses), self.seen, self.root)
        weight = jnp.sqrt(self.weights)
        return weight[:, None] * errors, jnp.einsum("l,lpea,lpab->lpeb", weight, by, free[self.keys])

    def _three(self, poses: SE3) -> SE3:
        return jax.tree.map(lambda x: x[self.keys], poses)


def _error(three: SE3, seen: SE3, root: Array) -> Float[Array, "6"]:
    now, one, two = (jax.tree.map(lambda x, i=i: x[i], three) for i in range(3))
    between = relative(one, now)
    length = safe_norm(relative(one, two).translation())
    found = compose(between.rotation(), safe_divide(between.translation(), length))
    return root @ local(seen, found)


class Closed(NamedTuple):
    """Normal equations with loops, factorised.

    Attributes:
        factors: Of what is block tridiagonal.
        rows: (18 l, k, 6) derivatives of the errors of the loops by the poses, one pose a row.
        across: (18 l, k, 6) of these, solved for.
        small: (18 l, 18 l) what is left to be solved.
    """

    factors: Factors
    rows: Float[Array, "r k 6"]
    across: Float[Array, "r k 6"]
    small: Float[Array, "r r"]

    @classmethod
    def of(
        cls, loops: Loops, poses: SE3, free: Float[Array, "k 6 6"], equations: Tridiagonal, damping: Float[Array, ""]
    ) -> "Closed":
        """Of `equations` that hold what each loop says of each of its poses alone (`with_own`)."""
        factors = Factors.of(equations, damping)
        _, by = loops.linearised(poses, free)
        count, k, dtype = len(by), len(free), by.dtype
        place = jnp.arange(3)[:, None], jnp.arange(count)[None], slice(None), loops.keys.T
        rows = jnp.zeros((3, count, 6, k, 6), dtype).at[place].set(by.swapaxes(0, 1)).reshape(18 * count, k, 6)
        across = jax.vmap(factors.solve)(rows.reshape(18 * count, *equations.pull.shape)).reshape(rows.shape)
        # By these rows the three poses of a loop have (J - I) x I with each other, J of ones; here its inverse.
        between = jnp.kron(jnp.full((3, 3), 0.5, dtype) - jnp.eye(3, dtype=dtype), jnp.eye(6 * count, dtype=dtype))
        return cls(factors, rows, across, between + jnp.einsum("rka,qka->rq", rows, across))

    def solve(self, right: Float[Array, "m s"]) -> Float[Array, "m s"]:
        """The solution."""
        alone = self.factors.solve(right)
        seen = jnp.einsum("rka,ka->r", self.rows, alone.reshape(self.rows.shape[1:]))
        change = jnp.einsum("rka,r->ka", self.across, jnp.linalg.solve(self.small, seen))
        return alone - change.reshape(right.shape)

    def covariances(self) -> Float[Array, "k 6 6"]:
        """Those of single poses."""
        alone = pose_blocks(self.factors)
        gain = jnp.linalg.solve(self.small, self.across.reshape(len(self.small), -1)).reshape(self.across.shape)
        change = jnp.einsum("rka,rkb->kab", self.across, gain)
        return alone - (change + change.swapaxes(1, 2)) / 2


def pose_blocks(factors: Factors) -> Float[Array, "k 6 6"]:
    """The covariances of single poses."""
    b = factors.scales.shape[1] // 6
    blocks = factors.covariances().reshape(-1, b, 6, b, 6)[:, jnp.arange(b), :, jnp.arange(b)]
    return blocks.swapaxes(0, 1).reshape(-1, 6, 6)


def with_own(loops: Loops, poses: SE3, free: Float[Array, "k 6 6"], equations: Tridiagonal) -> Tridiagonal:
    """The equations, with what each loop says of each of its poses alone, and its pull."""
    errors, by = loops.linearised(poses, free)
    m, s = equations.pull.shape
    own = jnp.einsum("lpea,lpeb->lpab", by, by)
    pull = jnp.zeros((len(free), 6), by.dtype).at[loops.keys].add(-jnp.einsum("lpea,le->lpa", by, errors))
    b = s // 6
    at = loops.keys // b, loops.keys % b
    blocks = jnp.zeros((m, b, 6, b, 6), by.dtype).at[at[0], at[1], :, at[1]].add(own)
    return equations._replace(
        diagonal=equations.diagonal + blocks.reshape(m, s, s), pull=equations.pull + pull.reshape(m, s)
    )
