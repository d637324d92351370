"""A whole run once more, from all that was seen: keyframes and points at once, then the frames between them.

Keyframes are frames between which the tracks have moved by `Settings.keyframe_flow`. Their poses and all points seen
from them are brought to maximum likelihood (`jaxtri.estimation.batch`), from what the recursive filter made of them.
A frame between two of them is then measured from the points as they are. A feature that is followed drifts slowly, so
that what it errs by in such a frame lies between what it errs by in the two keyframes, and that is known.
"""

import warnings
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float
from tqdm import tqdm

from jaxtri.compilation import capacity
from jaxtri.errors import InputError, InputWarning
from jaxtri.estimation import batch
from jaxtri.estimation.batch import Estimate
from jaxtri.filters import ekf
from jaxtri.geometry.pose import adjoint, exp_pose, local, multiply, relative
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.motion import Twist
from jaxtri.odometry.adjustment import FEWEST, Adjustment, stretch
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.intrinsics import GUESSED, Search
from jaxtri.odometry.measuring import doubts
from jaxtri.odometry.poses import FramePose, trajectory
from jaxtri.odometry.settings import Settings, Status
from jaxtri.odometry.stretches import Segment, segments
from jaxtri.odometry.structure import Points, world_points
from jaxtri.trajectory import Trajectory

TOGETHER = 64  # frames that are measured by one call
MOST = 50  # steps; a dozen are usual
TINY = 1e-12  # a weight that is none


@dataclass
class Refinement:
    """What all that was seen says of a run.

    Attributes:
        poses: One `FramePose` a frame; its `nis` is by the noise that was found, where that is more than the one
            assumed. A frame that the camera was not followed in is as it was.
        points: The scene; covariances of each point's own error, the poses given.
        keyframes: Numbers of the frames that were adjusted together with the points.
        statistics: Figures, as `run.json` has them.
    """

    poses: list[FramePose]
    points: Points
    keyframes: list[int]
    statistics: dict[str, object]

    def trajectory(self) -> Trajectory:
        """Camera poses, camera to world, one a frame."""
        return trajectory(self.poses, "none was refined")


def refine(odometry: Odometry, *, progress: bool = False) -> Refinement:
    """Bundle adjustment of a run: `Odometry(..., record=True)`, or `run.odometry` of `track(..., record=True)`.

    Where the camera was lost, each part is refined by itself. Its first pose stays, and so does its scale: the distance
    from there to the keyframe that is farthest from it. Covariances are with respect to these two, by the noise that is
    found where that is more than the one assumed. What the camera's calibration may be off by (`Settings.calibration`)
    is in them too; it is not estimated, since it looks too much like what features that drift do. That it changes on
    the way is another thing: where the camera is found to zoom an `InputWarning` says so, and frames are uncertain from
    there on. Raises `InputError` where no tracks were kept, `InitialisationError` where there is no pose.
    """
    if not odometry.record:
        raise InputError("nothing was recorded: ask for it by record=True")
    odometry.trajectory()  # takes in what is queued, and raises where there is none
    poses, points, chosen, parts = list(odometry.poses), [], [], []
    moved = np.eye(4)  # of the world, by what was refined before
    at = 0
    for first, end in segments(odometry):
        poses[at:first] = [_in(pose, moved) for pose in poses[at:first]]
        segment, keys, settings, noise = stretch(odometry, first, end)
        last = poses[end - 1].T_camera_world
        found = _Adjusted.of(settings, noise, segment, keys, progress) if len(keys) >= FEWEST else None
        if found is None:
            parts.append({"frames": [first, end - 1], "refined": False})
        else:
            poses[first:end] = found.frames(settings, poses[first:end])
            zoom = found.zoom(odometry, first, end, progress) if odometry.zoom is None else None
            if zoom is not None:
                poses[first:end] = _zoomed(zoom, poses[first:end], first)
            points.append(found.points(settings, moved))
            chosen += [first + int(k) for k in keys]
            said = None if zoom is None else [round(float(r), 4) for r in zoom.ratio[[0, -1]]]
            parts.append({"frames": [first, end - 1], "refined": True, "zoom": said} | found.statistics)
        poses[first:end] = [_in(pose, moved) for pose in poses[first:end]]
        new = poses[end - 1].T_camera_world
        assert last is not None
        assert new is not None
        moved, at = np.linalg.inv(last) @ new, end
    poses[at:] = [_in(pose, moved) for pose in poses[at:]]
    together = _best(Points(*(np.concatenate(x) for x in zip(*points, strict=True)))) if points else odometry.points()
    return Refinement(poses, together, chosen, {"parts": parts, "keyframes": len(chosen)})


def _in(pose: FramePose, moved: np.ndarray) -> FramePose:
    """The pose in a world that has been moved."""
    T = pose.T_camera_world
    return pose if T is None else replace(pose, T_camera_world=T @ moved)


def _best(points: Points) -> Points:
    """Each track once, as it is known best: where it was cut it has several points."""
    order = np.argsort(np.trace(points.covariance, axis1=1, axis2=2), kind="stable")
    _, which = np.unique(points.ids[order], return_index=True)
    return Points(*(x[order[which]] for x in points))


def _zoomed(zoom: ZoomCurve, poses: list[FramePose], first: int) -> list[FramePose]:
    """Poses, from frame `first` on, by a camera that is found to zoom."""
    times = np.array([p.time for p in poses])
    log = zoom.log(times)
    begun = int(np.argmax(np.abs(log) > np.interp(times, zoom.times_s, zoom.sd)))
    most = float(np.exp(log[np.argmax(np.abs(log))]))
    warnings.warn(
        f"the camera zooms from frame {first + begun} on, to {most:.2f} times the focal length of frame {first}, but "
        "is taken to have one, so that the path is wrong from there on: let it be followed, by --refine-camera beside "
        "--camera or --fov (track_uncalibrated)",
        InputWarning,
        stacklevel=3,
    )
    found = list(poses)
    for k in range(begun, len(poses)):
        status = Status.UNCERTAIN if poses[k].status is Status.TRACKING else poses[k].status
        found[k] = replace(poses[k], zoom=float(np.exp(log[k])), status=status)
    return found


@dataclass
class _Adjusted:
    """A stretch whose keyframes and points have been adjusted."""

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
    statistics: dict[str, object]

    @classmethod
    def of(
        cls, settings: Settings, over: float, segment: Segment, keys: np.ndarray, progress: bool
    ) -> "_Adjusted | None":
        """Those of a stretch, whose settings have a noise of `over` what was assumed; None if nothing finite came."""
        begun = Adjustment.of(settings, segment, keys)
        pieces, problem, noise = begun.pieces, begun.problem, begun.noise
        now, costs = begun.estimate, []
        bar = tqdm(total=MOST, unit="step", desc="refine", disable=None if progress else True, leave=False)
        while not bool(now.done) and len(costs) < MOST:
            now = batch.step(problem, noise, now)
            costs.append(float(now.cost))
            bar.set_postfix_str(f"cost {costs[-1]:.6g}", refresh=False)
            bar.update()
        bar.close()
        known = batch.known(problem, noise, now.poses, now.points)
        covariance, response = (np.asarray(x) for x in known[:2])
        if not (np.isfinite(covariance).all() and np.isfinite(np.asarray(now.poses.wxyz_xyz)).all()):
            return None
        X = pieces.each([np.asarray(p.X) for p in now.points], (4,))
        spread, residual, weights = ([np.asarray(x) for x in y] for y in zip(*known.points, strict=True))
        scale = float(noise.scale)
        distance = scale * (1 / np.sqrt(np.maximum(pieces.looks(weights, ()), TINY)) - 1)
        agree = distance < scale
        agreed = np.bincount(pieces.piece[agree], minlength=len(pieces.ids)) > 1
        free = 1 - (3 * agreed.sum() + 6 * len(keys)) / (2 * max(int(agree.sum()), 1))
        inflation = _inflation(distance, scale, free)
        said = {
            "keyframes": len(keys),
            "tracks": len(pieces.ids),
            "observations": len(pieces.key),
            "steps": len(costs),
            "converged": bool(now.converged),
            "noise_over_assumed": float(f"{over * np.sqrt(inflation):.3g}"),
        }
        inflation = max(inflation, 1.0)
        spread = pieces.each(spread, (4, 3)) * np.sqrt(inflation)
        owed = float(settings.calibration) ** 2 * response @ response.swapaxes(1, 2)
        poses = now.poses, covariance * inflation + owed
        looks = pieces.looks(residual, (2,)), distance / inflation
        return cls(segment, keys, begun, now, *poses, X, spread, agreed, *looks, said)

    def zoom(self, odometry: Odometry, first: int, end: int, progress: bool) -> ZoomCurve | None:
        """How the focal length changes over the stretch; None where it does not."""
        seen = (first, end), self.segment, self.keys, self.begun
        return Search(odometry, *seen, odometry.camera, GUESSED, progress).zoom(self.best)

    def points(self, settings: Settings, moved: np.ndarray) -> Points:
        """The points that at least two looks agree on, in a world that has been moved."""
        count = len(self.X)
        pad = np.zeros(capacity(count) - count, int)  # each length is compiled once
        items = BasePoint(*(jnp.asarray(np.concatenate([x, x[pad]])) for x in (self.X, self.spread)))
        xyz, covariance, known = (np.asarray(x)[:count] for x in world_points(items, settings))
        good = self.agreed & known & np.isfinite(xyz).all(axis=1)
        R, t = moved[:3, :3], moved[:3, 3]
        # A pose becomes T moved, so a point of the world its inverse of it.
        return Points(self.begun.pieces.ids[good], (xyz[good] - t) @ R, R.T @ covariance[good] @ R)

    def frames(self, settings: Settings, before: list[FramePose]) -> list[FramePose]:
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
        T, own, owed, distance, mask = map(
            np.concatenate, zip(*(self._between(settings, g) for g in groups), strict=True)
        )
        # The noise of what is new between two keyframes is another one, and is found from what these frames say.
        inflation = max(_inflation(distance[mask], scale, 1 - 3 * len(between) / max(mask.sum(), 1)), 1.0)
        agree = mask & (distance < scale * inflation)
        nis = np.where(agree, _over_found(distance, agree), 0.0).sum(axis=1)
        put(between, T, inflation * own + owed, agree.sum(axis=1), nis, mask.sum(axis=1))
        return found

    def _between(self, settings: Settings, frames: np.ndarray) -> list[np.ndarray]:
        """Frames between keyframes: poses, covariances given the keyframes and by these, distances of the points.

        The last are squared, in standard deviations, and which points were measured stands beside them.
        """
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
        new.status = Status.UNCERTAIN if any(found) else Status.TRACKING
    return new
