"""Tracks of a sequence in chunks of one size, several layers of them: what `jaxtri.estimation.batch` works on."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.estimation.bundle import Linearised, PointPrior, Points, Views, cost, linearise
from jaxtri.estimation.loops import Loops


class Noise(NamedTuple):
    """What is assumed of the image points.

    Attributes:
        sigma: Standard deviation in normalised image units.
        scale: Of the robust weights: what is new in a point counts a quarter at this squared distance, over sigma.
        correlation: Of a track's noise in one keyframe with that in the next.
    """

    sigma: Float[Array, ""]
    scale: Float[Array, ""]
    correlation: Float[Array, ""]


class Layer(NamedTuple):
    """Chunks of tracks: room for c of them, n tracks each, a chunk from 2 b keyframes.

    Attributes:
        observed: (c, 2, 2 b, n) normalised image points.
        mask: (c, 2 b, n) which of them are seen.
        begin: (c,) keyframe that a chunk begins with, a multiple of b.
        chunks: How many there are; those behind them are empty.
        prior: Of the inverse depths, (c, n) each.
    """

    observed: Float[Array, "c 2 v n"]
    mask: Bool[Array, "c v n"]
    begin: Int[Array, " c"]
    chunks: Int[Array, ""]
    prior: PointPrior

    @property
    def size(self) -> int:
        """Keyframes in a block."""
        return self.mask.shape[1] // 2

    def chunk(self, index: Int[Array, ""] | int) -> "Chunk":
        """One of them."""
        return Chunk(*(jax.tree.map(lambda x: x[index], each) for each in (*self[:3], self.prior)))


class Chunk(NamedTuple):
    """A chunk of a `Layer`: its fields without the first axis."""

    observed: Float[Array, "2 v n"]
    mask: Bool[Array, "v n"]
    begin: Int[Array, ""]
    prior: PointPrior

    def of(self, each: Any) -> Any:
        """What it needs of something of every keyframe."""
        return part_of(each, self.begin, len(self.mask))

    def views(self, noise: Noise) -> Views:
        """What is seen in it."""
        return Views(self.observed, self.mask, noise.correlation)

    def said(self, noise: Noise, poses: SE3, points: Points) -> Linearised:
        """By the observations."""
        return linearise(self.of(poses), points, self.views(noise), *noise[:2])

    def cost(self, noise: Noise, poses: SE3, points: Points) -> Float[Array, ""]:
        """Of the observations and the prior."""
        return cost(self.of(poses), points, self.views(noise), *noise[:2]) + self.owed(points)

    def owed(self, points: Points) -> Float[Array, ""]:
        """To the prior."""
        return jnp.sum(((self.prior.mean - points.inverse_depth) / self.prior.sd) ** 2)


def part_of(each: Any, begin: Int[Array, ""], count: int) -> Any:
    """Of something of every keyframe, that of so many from one on."""
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, begin, count), each)


class Batch(NamedTuple):
    """What is seen from k keyframes.

    Attributes:
        layers: Blocks of each are several of the one before; k is at least two of the last ones.
        present: (k,) places that a keyframe stands in; the first one does, and its pose is given.
        farthest: Keyframe whose distance from the first is given: the unit of length.
        loops: Places that are seen again, where there are any.
    """

    layers: tuple[Layer, ...]
    present: Bool[Array, " k"]
    farthest: Int[Array, ""]
    loops: Loops | None = None

    def mapped(self, function: Callable[[Chunk, Points], Any], points: tuple[Points, ...]) -> list:
        """What a function gives of each chunk and its points, layer by layer; zeros behind the last chunk."""

        def of_layer(layer: Layer, points: Points) -> Any:
            def one(index: Array | int) -> Any:
                return function(layer.chunk(index), jax.tree.map(lambda x: x[index], points))

            def put(index: Array, found: Any) -> Any:
                return jax.tree.map(lambda x, y: x.at[index].set(y), found, one(index))

            room = len(layer.mask)
            empty = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), jax.eval_shape(one, 0))
            return jax.lax.fori_loop(0, layer.chunks, put, empty)

        return [of_layer(layer, p) for layer, p in zip(self.layers, points, strict=True)]
