"""Measurements that are a linear map and a division, and what all items say of the map, in a few moments.

An item of coordinates c (q,) is measured at the image of M c, M (3, q) the map of the state: the trifocal tensor, or a
camera matrix. The items are constant while the map moves, so that all that they say of it are sums of products
c c', each weighted by six numbers a frame: three thin matrix products, whatever the number of parameters of the state.
Equal to the sum over each item's own Jacobian, to rounding.
"""

from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

Mean = TypeVar("Mean")


@runtime_checkable
class Projective(Protocol[Mean]):
    """What a model says beside `jaxtri.filters.model.Model` to be run by moments; it measures two components."""

    sigma: Float[Array, ""]  # of a component of a measurement

    @property
    def support(self) -> np.ndarray:
        """Components of the error that the map depends on."""
        ...

    def retract(self, mean: Mean, delta: Float[Array, " d"]) -> Mean:
        """The state moved by an error."""
        ...

    def matrix(self, mean: Mean) -> Float[Array, "3 q"]:
        """The map of the state; it and the coordinates are of order one, so that 1e-12 is nothing."""
        ...

    def coordinates(self, item: Any) -> Float[Array, " q"]:
        """Of one item."""
        ...

    def spread(self, item: Any) -> Float[Array, "q p"]:
        """Derivative of the coordinates with respect to p errors of the item, of the standard deviation sigma each.

        p may be zero: an item without errors.
        """
        ...


class Moments(eqx.Module):
    """Items in the form in which they enter the sums; made once, for all frames that see them."""

    coordinates: Float[Array, "q n"]
    products: Float[Array, "n r"]  # the r = q (q + 1) / 2 of the coordinates, pair by pair
    spread: Float[Array, "q pn"]


def prepare(model: Projective[Mean], items: PyTree[Array]) -> Moments:
    """Of items with a leading axis n."""
    c = jax.vmap(model.coordinates)(items)
    n, q = c.shape
    spread = jnp.moveaxis(jax.vmap(model.spread)(items), 0, -1)
    j, k = np.triu_indices(q)
    return Moments(c.T, c[:, j] * c[:, k], spread.reshape(q, spread.shape[1] * n))


class Evidence(eqx.Module):
    """What a frame's measurements say at one state: `jaxtri.ekf.Evidence`."""

    items: Moments
    map: Float[Array, "3 q"]
    slope: Float[Array, "3 q s"]  # derivative of the map with respect to the error, the s components that it depends on
    image: Float[Array, "2 n"]
    depth: Float[Array, " n"]  # third component before the division
    residual: Float[Array, "2 n"]
    weight: Float[Array, "3 n"]  # W of each, its inverse noise, zero where masked: xx, xy, yy
    log_det: Float[Array, " n"]  # of its noise

    @property
    def distance(self) -> Float[Array, " n"]:
        """Squared Mahalanobis distance of the residual of each item."""
        return self._squared(self.residual)

    def distance_after(self, step: Float[Array, " s"]) -> Float[Array, " n"]:
        """The same after a step of the error, by the linearisation."""
        dX = (self.slope @ step) @ self.items.coordinates
        return self._squared(self.residual - (dX[:2] - self.image * dX[2]) / self.depth)

    def _squared(self, r: Float[Array, "2 n"]) -> Float[Array, " n"]:
        xx, xy, yy = self.weight
        return xx * r[0] ** 2 + 2 * xy * r[0] * r[1] + yy * r[1] ** 2

    def normal_equations(self, weights: Float[Array, " n"]) -> tuple[Float[Array, "s s"], Float[Array, " s"]]:
        """A = sum w H' W H and sum w H' W r."""
        x, y = self.image
        weighted, (r, s) = self._weighted(weights), self.residual
        xx, xy, yy = weighted
        # B = [I, -image] / depth takes a change of M c to one of the image: B' W r, and below B' W B.
        a, b = xx * r + xy * s, xy * r + yy * s
        pull = jnp.stack([a, b, -(x * a + y * b)]) @ self.items.coordinates.T
        sums = self._information(weighted) @ self.items.products
        q = self.slope.shape[1]
        block, entry = _symmetric(3), _symmetric(q)
        flat = block[:, None, :, None] * sums.shape[1] + entry[None, :, None, :]
        K = sums.ravel()[flat.reshape(3 * q, 3 * q)]
        D = self.slope.reshape(3 * q, -1)
        return D.T @ (K @ D), pull.ravel() @ D

    def coupling(self, weights: Float[Array, " n"], levers: Float[Array, "q e n"]) -> Float[Array, "s e n"]:
        """w H' W L of each item, L the derivative of its image by e errors; `levers` are those of its coordinates."""
        q, e, n = levers.shape
        six = self._information(self._weighted(weights))
        moved = (self.map @ levers.reshape(q, e * n)).reshape(3, e, n)
        turned = (jnp.moveaxis(self.slope, 1, -1).reshape(-1, q) @ self.items.coordinates).reshape(3, -1, n)
        return jnp.einsum("asn,abn,ben->sen", turned, six[_symmetric(3)], moved)

    def _weighted(self, weights: Float[Array, " n"]) -> Float[Array, "3 n"]:
        return self.weight * (weights / self.depth)

    def _information(self, weighted: Float[Array, "3 n"]) -> Float[Array, "6 n"]:
        """B' W B of each item, with its weight: the upper triangle of a symmetric matrix."""
        x, y = self.image
        xx, xy, yy = weighted / self.depth
        xz, yz = xx * x + xy * y, xy * x + yy * y
        return jnp.stack([xx, xy, -xz, yy, -yz, x * xz + y * yz])


def _symmetric(n: int) -> np.ndarray:
    """Where each entry of a symmetric matrix stands among those of its upper triangle."""
    where = np.zeros((n, n), int)
    where[np.triu_indices(n)] = np.arange(n * (n + 1) // 2)
    return where + np.triu(where, 1).T


def embed(x: Float[Array, "*k s"], support: np.ndarray, d: int) -> Float[Array, "*k d"]:
    """Its last axis spread to those of the `support` among d, with zeros between."""
    return x @ np.eye(d, dtype=x.dtype)[support]


def linearise(
    model: Projective[Mean],
    prior: Mean,
    delta: Float[Array, " d"],
    items: Moments,
    observed: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    scale: Float[Array, " n"] | None,
) -> Evidence:
    """At `retract(prior, delta)`; derivatives with respect to the model's `support` of the error of the prior."""
    support = model.support

    def at(error: Array) -> tuple[Array, Array]:
        M = model.matrix(model.retract(prior, delta + embed(error, support, len(delta))))
        return M, M

    # Behind a barrier: fused into what is done for every item its sines would be computed for every item.
    slope, M = jax.lax.optimization_barrier(jax.jacfwd(at, has_aux=True)(jnp.zeros(len(support), delta.dtype)))
    n = len(observed)
    X = M @ items.coordinates
    small = jnp.abs(X[2]) < 1e-12
    depth = jnp.where(small, jnp.where(X[2] < 0, -1e-12, 1e-12), X[2])
    image = X[:2] / depth
    variance = jnp.square(model.sigma if scale is None else model.sigma * scale)
    dX = (M @ items.spread).reshape(3, items.spread.shape[1] // n, n)
    J = (dX[:2] - image[:, None] * dX[2]) / depth
    xx, xy, yy = 1 + jnp.sum(J[0] ** 2, axis=0), jnp.sum(J[0] * J[1], axis=0), 1 + jnp.sum(J[1] ** 2, axis=0)
    schur = yy - xy * xy / xx
    det = xx * schur
    weight = jnp.where(mask, jnp.stack([yy, -xy, xx]) / (det * variance), 0.0)
    log_det = jnp.where(mask, jnp.log(det) + 2 * jnp.log(variance), 0.0)
    return Evidence(items, M, slope, image, depth, jnp.where(mask, observed.T - image, 0.0), weight, log_det)
