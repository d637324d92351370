"""The points of a run as tracks come and go, each as it was last known."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxtri.compilation import capacity
from jaxtri.models.base_pairs import BasePoint
from jaxtri.models.depth import Bank
from jaxtri.odometry.measuring import FARTHEST, structure_model
from jaxtri.odometry.settings import Settings

_KNOWN = 3.0  # standard deviations by which the inverse depth of a known point is above zero: it is known to a third


class Points(NamedTuple):
    """Triangulated points.

    Attributes:
        ids: (n,) numbers of their tracks.
        xyz: (n, 3) in the world, scene units.
        covariance: (n, 3, 3) of each point's own error, scene units squared. The drift of the poses and of the scale,
            which all points share, is not in it.
    """

    ids: np.ndarray
    xyz: np.ndarray
    covariance: np.ndarray


def no_points() -> Points:
    """An empty set of points."""
    return Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


def keep(known: dict[int, tuple[np.ndarray, np.ndarray]], points: Points) -> None:
    """Put points among those that are known: one that is there already stays as it is known better."""
    for i, x, c in zip(*points, strict=True):
        if int(i) not in known or np.trace(c) < np.trace(known[int(i)][1]):
            known[int(i)] = (x, c)


def gathered(known: dict[int, tuple[np.ndarray, np.ndarray]], more: Points | None = None) -> Points:
    """Points that are known, and some more, by number."""
    if more is not None:
        known = known.copy()
        keep(known, more)
    if not known:
        return no_points()
    ids = np.array(sorted(known))
    return Points(ids, *(np.stack([known[i][k] for i in ids]) for k in (0, 1)))


@jax.jit
def world_points(bank: Bank | BasePoint, settings: Settings) -> tuple[jax.Array, jax.Array, jax.Array]:
    """World points (n, 3) of a bank, the covariance of each, and which of them are known well enough to be shown."""
    if isinstance(bank, BasePoint):
        points, covariance = bank.point, settings.sigma**2 * bank.spread @ bank.spread.swapaxes(1, 2)
    else:
        points, covariance = structure_model(settings).world(bank)

    def one(X: Array, C: Array) -> tuple[Array, Array]:
        w = jnp.where(jnp.abs(X[3]) > FARTHEST, X[3], FARTHEST)
        J = jnp.concatenate([jnp.eye(3, dtype=X.dtype), -(X[:3] / w)[:, None]], axis=1) / w
        return X[:3] / w, J @ C @ J.T

    return *jax.vmap(one)(points, covariance), points[:, 3] > _KNOWN * jnp.sqrt(covariance[:, 3, 3])


@dataclass
class Structure:
    """The points of tracks that have ended, kept as they were until they are asked for.

    Attributes:
        settings: Those of the run.
        kept: For each time that tracks ended, their points and the numbers of the tracks (n,).
    """

    settings: Settings
    kept: list[tuple[Bank | BasePoint, np.ndarray]] = field(default_factory=list)

    def of(self, bank: Bank | BasePoint, good: np.ndarray, ids: np.ndarray) -> Points:
        """The known points of the `good` slots."""
        xyz, covariance, known = (np.asarray(x) for x in world_points(bank, self.settings))
        good = good & known & np.isfinite(xyz).all(axis=1)
        return Points(ids[good], xyz[good], covariance[good])

    def end(self, bank: Bank | BasePoint, good: np.ndarray, ids: np.ndarray) -> None:
        """Keep the points of the `good` slots, whose tracks have ended."""
        if good.any():
            self.kept.append((jax.tree.map(lambda x: np.asarray(x)[good], bank), ids[good]))

    def ended(self) -> Points:
        """The points that were kept since the last call of this method."""
        if not self.kept:
            return no_points()
        banks, ids = zip(*self.kept, strict=True)
        self.kept = []
        # Filled up to one of a few lengths: each length is compiled once.
        count = sum(map(len, ids))
        spare = capacity(count) - count
        bank = jax.tree.map(lambda *x: np.concatenate([*x, np.repeat(x[0][:1], spare, axis=0)]), *banks)
        return self.of(bank, np.arange(count + spare) < count, np.concatenate([*ids, np.full(spare, -1)]))
