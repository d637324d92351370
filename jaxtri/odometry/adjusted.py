"""A world whose keyframes and points have been adjusted together, and what follows for the frames between.

A feature that is followed drifts slowly, so that what it errs by in a frame between two keyframes lies between what it
errs by in these two, and that is known.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float
from tqdm import tqdm

from jaxtri.compilation import capacity
from jaxtri.estimation import batch
from jaxtri.estimation.batch import Estimate, Known
from jaxtri.estimation.layers import Batch, Noise
from jaxtri.filters import ekf
from jaxtri.geometry.pose import adjoint, exp_pose, local, multiply, relative
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.motion import Twist
from jaxtri.odometry import loops
from jaxtri.odometry.adjustment import Adjustment
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.intrinsics import GUESSED, Search
from jaxtri.odometry.measuring import doubts
from jaxtri.odometry.poses import FramePose
from jaxtri.odometry.settings import Settings, Status
from jaxtri.odometry.stretches import Segment
from jaxtri.odometry.structure import Points, world_points

TOGETHER = 64  # frames that are measured by one call
MOST = 50  # steps; a dozen are usual
WEIGHED, SETTLED = 6, 0.05  # times, at most, that loops are weighed by how well they go with all; a change that ends it
TINY = 1e-12  # a weight that is none


@dataclass
class Adjusted:
    """A world whose keyframes and points have been adjusted."""

    settings: Settings
    segment: Segment
    keys: np.ndarray
    begun: Adjustment
    best: Estimate
    poses: SE3
    covariance: np.ndarray  # (k, 6, 6), of as many places as `poses` has
    X: np.ndarray  # (p, 4) homogeneous points
    spread: np.ndarray  # (p, 4, 3) their own errors, over sigma
    agreed: np.ndarray  # (p,) points that at least two looks agree on
    residual: np.ndarray  # (o, 2) of the looks, over sigma
    distance: np.ndarray  # (o,) of what is new in them, squared, over the noise that is taken for theirs
    joined: bool  # what was lost and found again is known to be one
    statistics: dict[str, object]

    @classmethod
    def of(
        cls,
        settings: Settings,
        over: float,
        odometry: Odometry,
        segment: Segment,
        keys: np.ndarray,
        count_loops: bool,
        progress: bool,
    ) -> "Adjusted | None":
        """Those of a world, whose settings have a noise of `over` what was assumed; None if nothing finite came."""
        begun = Adjustment.of(settings, segment, keys)
        pieces, problem, noise = begun.pieces, begun.problem, begun.noise
        steps, found, weights = 0, list[loops.Loop](), np.zeros(0)
        with tqdm(total=MOST, unit="step", desc="refine", disable=None if progress else True, leave=False) as bar:
            now = _descend(problem, noise, begun.estimate, bar)
            steps += int(now.steps)
            if count_loops and odometry.returns:
                known = batch.known(problem, noise, now.poses, now.points)
                T = np.asarray(_matrices(now.poses), np.float64)[: len(keys)]
                found = loops.find(settings, odometry, segment, keys, pieces, T, _points(begun, now, known)[:3])
            weights = np.ones(len(found))
            for _ in range(WEIGHED if found else 0):
                counted = loops.together(found, weights, segment.u.dtype)
                problem = problem._replace(loops=counted)
                now = _descend(problem, noise, Estimate.of(now.poses, now.points), bar)
                steps += int(now.steps)
                errors = np.asarray(counted.errors(now.poses))[: len(found)]
                before, weights = weights, 1 / (1 + (errors**2).sum(axis=1) / (3 * float(noise.scale))) ** 2
                if np.abs(weights - before).max() < SETTLED:
                    break
        known = batch.known(problem, noise, now.poses, now.points)
        covariance, response = (np.asarray(x) for x in known[:2])
        if not (np.isfinite(covariance).all() and np.isfinite(np.asarray(now.poses.wxyz_xyz)).all()):
            return None
        X, spread, agreed, distance = _points(begun, now, known)
        scale, agree = float(noise.scale), distance < float(noise.scale)
        residual = pieces.looks([np.asarray(k.residual) for k in known.points], (2,))
        free = 1 - (3 * agreed.sum() + 6 * len(keys)) / (2 * max(int(agree.sum()), 1))
        inflation = _inflation(distance, scale, free)
        said = {
            "keyframes": len(keys),
            "tracks": len(pieces.ids),
            "observations": len(pieces.key),
            "steps": steps,
            "converged": bool(now.converged),
            "noise_over_assumed": float(f"{over * np.sqrt(inflation):.3g}"),
            "loops": [loop.said(float(w)) for loop, w in zip(found, weights, strict=True)],
        }
        inflation = max(inflation, 1.0)
        owed = float(settings.calibration) ** 2 * response @ response.swapaxes(1, 2)
        begins = np.searchsorted(segment.frames[keys], segment.frames[segment.begins[segment.begins > 0]])
        over_it = [[loop.keys[0] >= k > max(loop.keys[1:]) for loop in found] for k in begins]
        return cls(
            settings,
            segment,
            keys,
            begun,
            now,
            now.poses,
            covariance * inflation + owed,
            X,
            spread * np.sqrt(inflation),
            agreed,
            residual,
            distance / inflation,
            all(map(any, over_it)),
            said,
        )

    def zoom(self, odometry: Odometry, progress: bool) -> ZoomCurve | None:
        """How the focal length changes on the way; None where it does not."""
        seen = self.segment, self.keys, self.begun
        return Search(odometry, *seen, odometry.camera, GUESSED, progress).zoom(self.best)

    def points(self, moved: np.ndarray) -> Points:
        """The points that at least two looks agree on, in a world that has been moved."""
        count = len(self.X)
        pad = np.zeros(capacity(count) - count, int)  # each length is compiled once
        items = BasePoint(*(jnp.asarray(np.concatenate([x, x[pad]])) for x in (self.X, self.spread)))
        xyz, covariance, known = (np.asarray(x)[:count] for x in world_points(items, self.settings))
        good = self.agreed & known & np.isfinite(xyz).all(axis=1)
        R, t = moved[:3, :3], moved[:3, 3]
        # A pose becomes T moved, so a point of the world its inverse of it.
        return Points(self.begun.pieces.ids[good], (xyz[good] - t) @ R, R.T @ covariance[good] @ R)

    def frames(self, before: list[FramePose]) -> list[FramePose]:
        """The poses of all frames, `before` what they were."""
        found, count, scale = list(before), len(self.keys), float(self.begun.noise.scale)

        def put(at: np.ndarray, T: np.ndarray, covariance: np.ndarray, *numbers: np.ndarray) -> None:
            for k, pose, C, used, nis, measured in zip(at, T, covariance, *(x.tolist() for x in numbers), strict=True):
                found[k] = _judged(before[k], pose, C, used, nis, measured)

        key, agree = self.begun.pieces.key, self.distance < scale
        distance = _over_found(self.distance, agree)
        used, measured = (np.bincount(x, minlength=count) for x in (key[agree], key))
        nis = np.bincount(key[agree], weights=distance[agree], minlength=count)
        put(self.keys, np.asarray(_matrices(self.poses))[:count], self.covariance[:count], used, nis, measured)
        between = np.setdiff1d(np.arange(len(before)), self.keys)
        if not len(between):
            return found
        groups = (between[at : at + TOGETHER] for at in range(0, len(between), TOGETHER))
        T, own, owed, distance, mask = map(np.concatenate, zip(*(self._between(g) for g in groups), strict=True))
        # The noise of what is new between two keyframes is another one, and is found from what these frames say.
        inflation = max(_inflation(distance[mask], scale, 1 - 3 * len(between) / max(mask.sum(), 1)), 1.0)
        agree = mask & (distance < scale * inflation)
        nis = np.where(agree, _over_found(distance, agree), 0.0).sum(axis=1)
        put(between, T, inflation * own + owed, agree.sum(axis=1), nis, mask.sum(axis=1))
        return found

    def _between(self, frames: np.ndarray) -> list[np.ndarray]:
        """Frames between keyframes: poses, covariances given the keyframes and by these, distances of the points.

        The last are squared, in standard deviations, and which points were measured stands beside them.
        """
        settings = self.settings
        before = np.searchsorted(self.keys, frames) - 1
        t0, t1, t = (self.segment.times[x] for x in (self.keys[before], self.keys[before + 1], frames))
        share = (t - t0) / (t1 - t0)
        which, kept, variance = self._kept(frames, before, share)
        observed = self.segment.u[frames] - float(self.begun.noise.sigma) * kept
        # Between two known poses: so far the path is bent by an acceleration as large as the filter takes it to be.
        bend = ((t - t0) * (t1 - t) / 2)[:, None]
        sd = bend * np.repeat(
            [float(settings.acceleration) * self.begun.depth, float(settings.angular_acceleration)], 3
        )
        # Looked for where the filter saw it from the nearer keyframe: that path knows of a jump, the straight one not.
        near = before + (share >= 0.5)
        carried = self.segment.T[frames] @ np.linalg.inv(self.segment.T[self.keys[near]])
        arguments = (before, share, near, carried, sd, self.X[which], observed, which >= 0, np.sqrt(variance))
        rest = np.zeros(TOGETHER - len(frames), int)
        padded = [jnp.asarray(np.concatenate([x, x[rest]])) for x in arguments]
        said = _measured(settings, self.begun.depth, self.poses, jnp.asarray(self.covariance), *padded)
        return [*(np.asarray(x)[: len(frames)] for x in said), which >= 0]

    def _kept(
        self, frames: np.ndarray, before: np.ndarray, share: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The piece (t, n) in each slot, -1 for none; what it errs by in a frame, and the variance of that, over sigma.

        An autoregression between two of its values, or beside one: a bridge. A look that is an outlier is none.
        """
        agree = self.distance < float(self.begun.noise.scale)
        ids, seen, phi = self.segment.ids, self.segment.seen[frames], float(self.begun.noise.correlation)
        place = np.full((len(self.keys), seen.shape[1]), -1)
        place[self.begun.pieces.key, self.begun.pieces.slot] = np.arange(len(self.begun.pieces.key))

        def at(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            look = place[index]
            there = seen & (ids[frames] == ids[self.keys[index]]) & (look >= 0) & agree[look]
            return np.where(there, self.begun.pieces.piece[look], -1), self.residual[look]

        (left, r0), (right, r1) = at(before), at(before + 1)
        which = np.where(left >= 0, left, right)
        a = np.where(left >= 0, phi ** share[:, None], 0.0)
        b = np.where((right >= 0) & (right == which), phi ** (1 - share[:, None]), 0.0)
        whole = 1 - (a * b) ** 2
        kept = (a * (1 - b**2) / whole)[..., None] * r0 + (b * (1 - a**2) / whole)[..., None] * r1
        return which, kept, (1 - a**2) * (1 - b**2) / whole


def _descend(problem: Batch, noise: Noise, now: Estimate, bar: tqdm) -> Estimate:
    """The least cost that steps lead to from an estimate."""
    while not bool(now.done) and int(now.steps) < MOST:
        now = batch.step(problem, noise, now)
        bar.set_postfix_str(f"cost {float(now.cost):.6g}", refresh=False)
        bar.update()
    return now


def _points(begun: Adjustment, now: Estimate, known: Known) -> tuple[np.ndarray, ...]:
    """Of the pieces: points (p, 4), their own errors (p, 4, 3) over sigma, which of them at least two looks agree on.

    And of the looks the squared distance (o,), in standard deviations, of what is new in them.
    """
    pieces, scale = begun.pieces, float(begun.noise.scale)
    X = pieces.each([np.asarray(p.X) for p in now.points], (4,))
    spread = pieces.each([np.asarray(k.spread) for k in known.points], (4, 3))
    weights = pieces.looks([np.asarray(k.weights) for k in known.points], ())
    distance = scale * (1 / np.sqrt(np.maximum(weights, TINY)) - 1)
    agreed = np.bincount(pieces.piece[distance < scale], minlength=len(pieces.ids)) > 1
    return X, spread, agreed, distance


def _inflation(distance: np.ndarray, scale: float, free: float) -> float:
    """By how much the variance of an estimate is above what the assumed noise makes it.

    That of an estimate by a robust cost is E[psi^2] / E[psi']^2 over the information of plain squares, psi the slope of
    the cost; the normal equations have E[w] in the place of both. `distance` are the squares of the residuals over what
    was assumed, each of two components, `scale` is that of the weights. `free` is the share of the residuals that the
    unknowns have not taken. Source: Huber 1981, section 6.3.

    It only ever raises what was assumed: an error that neighbours share goes into the poses, and no residual shows it.
    """
    if not len(distance):
        return 1.0
    root = 1 / (1 + distance / scale)
    weights = root**2
    squared, slope, mean = weights**2 * distance / 2, weights * (2 * root - 1), weights.mean()
    return float(squared.mean() * mean / max(slope.mean(), mean / 10) ** 2 / max(free, 0.1))


def _over_found(distance: np.ndarray, agree: np.ndarray) -> np.ndarray:
    """Squared distances over the noise that those which agree have, where that is more than the one assumed."""
    return 2 * distance / max(float(distance[agree].mean()) if agree.any() else 2.0, 2.0)


_matrices = jax.jit(SE3.as_matrix)


@jax.jit
def _measured(
    settings: Settings,
    depth: Float[Array, ""],
    poses: SE3,
    covariances: Float[Array, "k 6 6"],
    *frames: Array,
) -> tuple[Array, ...]:
    """Frames between keyframes: poses as matrices, covariances given these and by them, distances of the points."""
    model = BasePairs(settings.sigma, settings.acceleration * depth, settings.angular_acceleration)

    def one(frame: tuple[Array, ...]) -> tuple[Array, ...]:
        before, share, index, carried, sd, X, observed, mask, scale = frame
        a, b = (jax.tree.map(lambda x, i=i: x[i], poses) for i in (before, before + 1))
        mean = multiply(exp_pose(share * local(a, b)), a)
        still = jnp.ones(6, sd.dtype)
        belief = ekf.Belief(Twist(mean, jnp.zeros(6, sd.dtype)), jnp.diag(jnp.concatenate([sd**2, still])))
        items = BasePoint(X, jnp.zeros((*X.shape, 0), X.dtype))
        near = jax.tree.map(lambda x: x[index], poses)
        begin = jnp.pad(local(mean, multiply(SE3.from_matrix(carried), near)), (0, 6))
        passes, robust = settings.passes, settings.robust
        belief, said = ekf.update(
            model, belief, items, observed, mask, passes=passes, robust=robust, noise_scale=scale, begin=begin
        )
        pose = belief.mean.pose
        along = adjoint(relative(near, pose))
        owed = along @ covariances[index] @ along.T
        return pose.as_matrix(), belief.covariance[:6, :6], owed, said.distance

    return jax.lax.map(one, frames)


def _judged(
    before: FramePose, T: np.ndarray, covariance: np.ndarray, used: int, nis: float, measured: int
) -> FramePose:
    """A frame as it is known now."""
    T, covariance = np.asarray(T, np.float64), np.asarray(covariance, np.float64)
    if not (np.isfinite(T).all() and np.isfinite(covariance).all()):
        return before
    new = replace(before, T_camera_world=T, covariance=covariance, used=used, nis=nis, measured=measured)
    if before.status in (Status.TRACKING, Status.UNCERTAIN):
        found = doubts(new.nis, new.used, new.measured, np.radians(new.rotation_sd_deg))
        new.status = Status.UNCERTAIN if any(found) or before.found is not None else Status.TRACKING
    return new
