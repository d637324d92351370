"""A stretch of a run as a problem of bundle adjustment: its keyframes, its points, and where to begin."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from jaxtri.estimation.batch import Estimate
from jaxtri.estimation.bundle import Looks, PointPrior, Points, Views, looks, seen_from
from jaxtri.estimation.layers import Batch, Layer, Noise, part_of
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.measuring import median
from jaxtri.odometry.settings import Settings
from jaxtri.odometry.stretches import Pieces, Segment, keyframes, room
from jaxtri.odometry.window import FAREST, NEAREST, VAGUE

FEWEST = 3  # keyframes that there must be: two are what a start has made of them


def stretch(
    odometry: Odometry, frames: np.ndarray, *, moving: bool = False
) -> tuple[Segment, np.ndarray, Settings, float]:
    """Frames of a run, their keyframes, the settings with the noise that was found, and that over the one assumed."""
    assert odometry.settings is not None
    segment = Segment.of(odometry, frames, moving=moving)
    noise = float(np.median([odometry.poses[k].noise for k in frames]))
    # Robust weights widen with it, other than in the filter: this is the noise of all, not of a few blurred frames.
    settings = replace(odometry.settings, sigma=odometry.settings.sigma * noise)
    return segment, keyframes(settings, segment), settings, noise


@dataclass
class Adjustment:
    """What is to be adjusted.

    Attributes:
        pieces: The tracks, and where they went.
        problem: All that was seen, in the order of the pieces.
        noise: What is assumed of it.
        depth: Median depth of the scene.
        estimate: Where to begin: the poses as they were followed, and points by the first and last look at them.
    """

    pieces: Pieces
    problem: Batch
    noise: Noise
    depth: float
    estimate: Estimate

    @classmethod
    def of(cls, settings: Settings, segment: Segment, keys: np.ndarray) -> "Adjustment":
        """Of the keyframes of a stretch. The unit of length is the way to the one that is farthest from the first."""
        pieces = Pieces.of(segment, keys)
        dtype, k = segment.u.dtype, room(len(keys))
        centre = -np.einsum("kji,kj->ki", segment.T[keys, :3, :3], segment.T[keys, :3, 3])
        farthest = int(np.argmax(np.linalg.norm(centre - centre[0], axis=1)))
        T = np.concatenate([segment.T[keys], np.broadcast_to(np.eye(4), (k - len(keys), 4, 4))]).astype(dtype)
        poses = SE3.from_matrix(jnp.asarray(T))
        layers, points, depth = _begun(settings, jax.tree.map(jnp.asarray, pieces.layers), poses)
        problem = Batch(layers, jnp.arange(k) < len(keys), jnp.asarray(farthest))
        noise = Noise(settings.sigma, settings.robust.scale.astype(dtype), settings.correlation)
        return cls(pieces, problem, noise, float(depth), Estimate.of(poses, points))


@jax.jit
def _begun(
    settings: Settings, layers: list[tuple[Array, ...]], poses: SE3
) -> tuple[tuple[Layer, ...], tuple[Points, ...], Float[Array, ""]]:
    """The layers, the points by the first and last look at them, and the median depth of the scene."""
    found = []
    for observed, mask, begin, _ in layers:

        def one(part: tuple[Array, ...]) -> Looks:
            observed, mask, begin = part
            return looks(part_of(poses, begin, len(mask)), Views(observed, mask))

        found.append(jax.lax.map(one, (observed, mask, begin)))
    rho, angle = (jnp.concatenate([getattr(f, name).ravel() for f in found]) for name in ("inverse_depth", "angle"))
    wide = (angle > settings.usable_parallax) & (rho > 0)
    depth = median(1 / jnp.where(wide, rho, 1.0), wide)

    def start(first: Looks, layer: tuple[Array, ...]) -> tuple[Layer, Points]:
        rho = jnp.clip(first.inverse_depth, FAREST / depth, NEAREST / depth)
        prior = PointPrior(jnp.full_like(rho, 1 / depth), jnp.full_like(rho, VAGUE / depth))
        observed, mask, begin, chunks = layer
        return Layer(observed, mask, begin, chunks, prior), jax.vmap(seen_from)(first.R, first.T, first.u, rho)

    begun, points = zip(*map(start, found, layers), strict=True)
    return begun, points, depth
