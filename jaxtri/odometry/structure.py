"""The points of a run as tracks come and go, each as it was last known."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxtri.compilation import capacity
from jaxtri.models.depth import Bank
from jaxtri.odometry.measuring import structure_model
from jaxtri.odometry.settings import Settings

_KNOWN = 3.0  # standard deviations by which an inverse depth is above zero: the depth is known to a third


class Points(NamedTuple):
    """Triangulated points: `ids` (n,) of their tracks, `xyz` (n, 3) in the world, `covariance` (n, 3, 3)."""

    ids: np.ndarray
    xyz: np.ndarray
    covariance: np.ndarray


def no_points() -> Points:
    """An empty set of points."""
    return Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@jax.jit
def _world_points(bank: Bank, settings: Settings) -> tuple[jax.Array, jax.Array, jax.Array]:
    """World points of a bank, the covariance of each, and which are known."""
    points, covariance = structure_model(settings).world(bank)

    def one(X: Array, C: Array) -> tuple[Array, Array]:
        w = jnp.where(jnp.abs(X[3]) > 1e-9, X[3], 1e-9)
        J = jnp.concatenate([jnp.eye(3, dtype=X.dtype), -(X[:3] / w)[:, None]], axis=1) / w
        return X[:3] / w, J @ C @ J.T

    return *jax.vmap(one)(points, covariance), points[:, 3] > _KNOWN * jnp.sqrt(covariance[:, 3, 3])


@dataclass
class Structure:
    """The points of a bank whose tracks have ended, kept as they were until they are asked for."""

    settings: Settings
    kept: list[tuple[Bank, np.ndarray]] = field(default_factory=list)  # points and the numbers of their tracks

    def of(self, bank: Bank, good: np.ndarray, ids: np.ndarray) -> Points:
        """The known points of the `good` slots."""
        xyz, covariance, known = (np.asarray(x) for x in _world_points(bank, self.settings))
        good = good & known & np.isfinite(xyz).all(axis=1)
        return Points(ids[good], xyz[good], covariance[good])

    def end(self, bank: Bank, good: np.ndarray, ids: np.ndarray) -> None:
        """Keep the points of the `good` slots, whose tracks have ended."""
        if good.any():
            self.kept.append((jax.tree.map(lambda x: np.asarray(x)[good], bank), ids[good]))

    def ended(self) -> Points:
        """The points that were kept since the last call."""
        if not self.kept:
            return no_points()
        banks, ids = zip(*self.kept, strict=True)
        self.kept = []
        # Filled up to one of a few lengths, each of which compiles once.
        count = sum(map(len, ids))
        spare = capacity(count) - count
        bank = jax.tree.map(lambda *x: np.concatenate([*x, np.repeat(x[0][:1], spare, axis=0)]), *banks)
        return self.of(bank, np.arange(count + spare) < count, np.concatenate([*ids, np.full(spare, -1)]))
