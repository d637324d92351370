"""Places that are seen again, measured: tracks of a keyframe that were points of earlier ones, and the pose by them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxtri.compilation import capacity
from jaxtri.estimation.loops import Loops
from jaxtri.filters import ekf
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.motion import Twist
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.measuring import FARTHEST, MINORITY
from jaxtri.odometry.observing import normalise
from jaxtri.odometry.settings import Settings
from jaxtri.odometry.slots import slots
from jaxtri.odometry.stretches import Pieces, Segment
from jaxtri.vision.hypotheses import resection

MOST = 64  # loops that are counted; of more those with the most points
FEWEST = 8  # room for so many, so that few sizes are compiled


@dataclass
class Loop:
    """A place that is seen again.

    Attributes:
        frame: That sees it.
        place: Frame that it was seen in.
        points: How many of its points agree on one pose.
        keys: Keyframe of `frame`, of `place`, and one as far from that as the points were seen from.
        seen: (4, 4) pose of the first relative to the second, in scene units.
        length: From the second to the third, in scene units.
        covariance: (6, 6) of its error, a left perturbation (linear, angular).
    """

    frame: int
    place: int
    points: int
    keys: tuple[int, int, int]
    seen: np.ndarray
    length: float
    covariance: np.ndarray

    def said(self, weight: float) -> dict[str, object]:
        """As `run.json` has it, with what it counts."""
        return {"frame": self.frame, "place": self.place, "points": self.points, "weight": round(weight, 3)}


def find(
    settings: Settings,
    odometry: Odometry,
    segment: Segment,
    keys: np.ndarray,
    pieces: Pieces,
    poses: np.ndarray,
    points: tuple[np.ndarray, ...],
) -> list[Loop]:
    """The loops of a world, by poses (k, 4, 4) of its keyframes, and by its points.

    The `points` are those of the pieces: X (p, 4), spread (p, 4, 3) over sigma, and which of them (p,) are good.
    """
    assert odometry.start is not None
    found, fewest = list[Loop](), odometry.start.points
    frames = segment.frames[keys]
    for frame, returns in odometry.returns.items():
        if not {frame, returns.frame} <= set(frames.tolist()):
            continue
        i, j = (int(np.searchsorted(frames, f)) for f in (frame, returns.frame))
        camera = odometry.camera_at(odometry.poses[frame].time)
        u = np.asarray(normalise(camera, returns.pixels.astype(segment.u.dtype)))
        here = pieces.piece[pieces.key == j]
        at = slots(pieces.ids[here], returns.before)
        which, u = here[at[at >= 0]], u[at >= 0]
        good = points[2][which] & (points[0][which][:, 3] > FARTHEST)
        which, u = which[good], u[good]
        X = points[0][which].astype(np.float64)
        seen = resection(X[:, :3] / X[:, 3:], u.astype(np.float64), float(settings.epipolar_gate))
        if seen is None or seen[1].sum() < fewest:
            continue
        pad = capacity(len(which)) - len(which)
        arrays = (np.pad(x, ((0, pad), *((0, 0),) * (x.ndim - 1))) for x in (points[0][which], points[1][which], u))
        measured = _measured(settings, seen[0].astype(u.dtype), *arrays, np.arange(len(u) + pad) < len(u))
        T, covariance, used, nis = (np.asarray(x) for x in measured)
        if used < fewest or used < MINORITY * len(u) or not np.isfinite(covariance).all():
            continue
        third, length = _third(pieces, which, poses, j)
        covariance = covariance * max(float(nis) / (2 * used), 1.0)
        relative = T @ np.linalg.inv(poses[j])
        found.append(Loop(frame, returns.frame, int(used), (i, j, third), relative, length, covariance))
    best = sorted(found, key=lambda loop: -loop.points)[:MOST]
    return sorted(best, key=lambda loop: loop.frame)


def _third(pieces: Pieces, which: np.ndarray, poses: np.ndarray, j: int) -> tuple[int, float]:
    """The keyframe that is farthest from one, of those that see half as many of the points as any; and how far."""
    looks = np.bincount(pieces.key[np.isin(pieces.piece, which)], minlength=len(poses))
    looks[j] = 0
    others = np.flatnonzero(looks >= max(looks.max() / 2, 1))
    centre = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])
    length = np.linalg.norm(centre[others] - centre[j], axis=1)
    best = int(np.argmax(length))
    return int(others[best]), float(length[best])


@jax.jit
def _measured(
    settings: Settings,
    T: Float[Array, "4 4"],
    X: Float[Array, "n 4"],
    spread: Float[Array, "n 4 3"],
    u: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
) -> tuple[Array, Array, Array, Array]:
    """The pose by points whose errors are counted, from where it is about; its covariance, and how well they fit."""
    model = BasePairs(settings.sigma, jnp.zeros_like(settings.sigma), jnp.zeros_like(settings.sigma))
    none = jnp.zeros(6, u.dtype)
    far = 1 / jnp.where(mask, X[:, 3], jnp.inf).min()
    unknown = jnp.diag(jnp.concatenate([jnp.repeat(jnp.stack([far, jnp.ones_like(far)]), 3) ** 2, 1 + none]))
    belief = ekf.Belief(Twist(SE3.from_matrix(T), none), unknown)
    passes, robust = settings.passes, settings.robust
    belief, said = ekf.update(model, belief, BasePoint(X, spread), u, mask, passes=passes, robust=robust)
    return belief.mean.pose.as_matrix(), belief.covariance[:6, :6], said.used, said.nis


def together(loops: list[Loop], weights: np.ndarray, dtype: np.dtype) -> Loops:
    """As the batch has them."""
    count = max(FEWEST, 1 << (len(loops) - 1).bit_length())
    keys, weight = np.zeros((count, 3), np.int32), np.zeros(count)
    seen, root = np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(6), (count, 1, 1))
    for k, loop in enumerate(loops):
        unit = np.repeat([1 / loop.length, 1.0], 3)
        keys[k], weight[k], seen[k] = loop.keys, weights[k], loop.seen
        seen[k, :3, 3] /= loop.length
        root[k] = np.linalg.inv(np.linalg.cholesky(loop.covariance * np.outer(unit, unit)))
    T = SE3.from_matrix(jnp.asarray(seen, dtype))
    return Loops(jnp.asarray(keys), T, jnp.asarray(root, dtype), jnp.asarray(weight, dtype))
