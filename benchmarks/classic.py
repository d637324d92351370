"""Two plain methods on given feature tracks: PnP, and PnP with bundle adjustment of the last ten keyframes.

OpenCV and NumPy alone: what they are for is to say what the tracks hold, whatever the filters make of it. Both start
from the same two frames as the run whose tracks they are given. A landmark is triangulated once its first and its
newest ray are far enough apart; PnP leaves it there, the window moves it.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from jaxtri.geometry.camera import Camera
from jaxtri.odometry.replay import Recording
from jaxtri.trajectory import Trajectory

PARALLAX = np.radians(1.0)
KEYFRAMES, FLOW, STEPS = 10, 0.026 * 640, 10  # flow since the last keyframe, in pixels of 640
FEWEST = 6


class Tracks(NamedTuple):
    """Normalised image points (t, m, 2) of m tracks, NaN where one is not seen, and pixels to one unit."""

    points: np.ndarray
    focal: float

    @classmethod
    def of(cls, recording: Recording, camera: Camera) -> "Tracks":
        """One column a track."""
        u, ids, visible = (np.asarray(x) for x in (recording.normalised(camera), recording.ids, recording.visible))
        names, column = np.unique(ids[visible], return_inverse=True)
        points = np.full((len(u), len(names), 2), np.nan)
        points[np.nonzero(visible)[0], column] = u[visible]
        return cls(points, float(np.sqrt(camera.fx * camera.fy)))

    def seen(self, frame: int) -> np.ndarray:
        """The tracks in a frame."""
        return np.isfinite(self.points[frame, :, 0])


@dataclass
class Classic:
    """Poses (t, 4, 4), world to camera, frame by frame.

    Attributes:
        tracks: What is seen.
        second: The frame that the start is made of, beside the first one.
        window: Whether the last keyframes are adjusted.
    """

    tracks: Tracks
    second: int
    window: bool = False
    poses: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        t, m, _ = self.tracks.points.shape
        self.poses: np.ndarray = np.tile(np.eye(4), (t, 1, 1))
        self.X = np.full((m, 3), np.nan)
        self.first = np.argmax(np.isfinite(self.tracks.points[..., 0]), axis=0)
        self._start(self.second)
        self.keyframes = [0, self.second]
        for k in [*range(1, self.second), *range(self.second + 1, t)]:
            self._locate(k)
            if k > self.second:
                self._extend(k)
                if self._due(k):
                    self.keyframes.append(k)
                    if self.window:
                        self._adjust(self.keyframes[-KEYFRAMES:])

    def trajectory(self, times: np.ndarray) -> Trajectory:
        """Camera to world."""
        return Trajectory(times, np.linalg.inv(self.poses))

    def _start(self, b: int) -> None:
        both = np.flatnonzero(self.tracks.seen(0) & self.tracks.seen(b))
        one, two = self.tracks.points[0, both], self.tracks.points[b, both]
        E, mask = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, 0.9999, 1.5 / self.tracks.focal)
        _, R, T, mask, _ = cv2.recoverPose(E, one, two, np.eye(3), distanceThresh=1e6, mask=mask)
        self.poses[b, :3, :3], self.poses[b, :3, 3] = R, T[:, 0]
        self._triangulate(both[mask[:, 0] > 0], b)

    def _triangulate(self, which: np.ndarray, now: int) -> None:
        """From the first look and that of now; what lies behind a camera or far from its images stays unknown."""
        A = self.poses[self.first[which]]
        B = np.broadcast_to(self.poses[now], A.shape)
        u = self.tracks.points[self.first[which], which]
        v = self.tracks.points[now, which]
        rows = [x[:, i, None] * P[:, 2] - P[:, i] for x, P in ((u, A), (v, B)) for i in (0, 1)]
        X = np.linalg.svd(np.stack(rows, axis=1))[2][:, -1]
        with np.errstate(all="ignore"):
            X = X[:, :3] / X[:, 3:]
            good = np.ones(len(which), bool)
            for x, P in ((u, A), (v, B)):
                Y = np.einsum("nij,nj->ni", P[:, :3, :3], X) + P[:, :3, 3]
                good &= (Y[:, 2] > 0) & (np.linalg.norm(Y[:, :2] / Y[:, 2:] - x, axis=1) < 2 / self.tracks.focal)
        self.X[which[good]] = X[good]

    def _locate(self, k: int) -> None:
        """PnP with RANSAC, then least squares over what agrees."""
        self.poses[k] = self.poses[k - 1]
        known = np.flatnonzero(self.tracks.seen(k) & np.isfinite(self.X[:, 0]))
        if len(known) < FEWEST:
            return
        X, u = np.ascontiguousarray(self.X[known]), np.ascontiguousarray(self.tracks.points[k, known])
        r, t = cv2.Rodrigues(self.poses[k, :3, :3])[0], self.poses[k, :3, 3:].copy()
        cv2.setRNGSeed(0)
        ok, r, t, inside = cv2.solvePnPRansac(
            X, u, np.eye(3), None, r, t, True, 300, 3 / self.tracks.focal, 0.999, flags=cv2.SOLVEPNP_ITERATIVE
        )
        if not ok or inside is None or len(inside) < FEWEST:
            return
        agree = np.asarray(inside, int)[:, 0]
        r, t = cv2.solvePnPRefineLM(X[agree], u[agree], np.eye(3), None, r, t)
        self.poses[k, :3, :3], self.poses[k, :3, 3] = cv2.Rodrigues(r)[0], t[:, 0]

    def _extend(self, k: int) -> None:
        """New landmarks."""
        new = np.flatnonzero(self.tracks.seen(k) & np.isnan(self.X[:, 0]) & (self.first < k))
        if not len(new):
            return
        since = self.first[new]
        rays = []
        for x, R in (
            (self.tracks.points[since, new], self.poses[since, :3, :3]),
            (self.tracks.points[k, new], self.poses[[k] * len(new), :3, :3]),
        ):
            ray = np.einsum("nji,nj->ni", R, np.column_stack([x, np.ones(len(x))]))
            rays.append(ray / np.linalg.norm(ray, axis=1)[:, None])
        wide = np.linalg.norm(np.cross(*rays), axis=1) > np.sin(PARALLAX)
        self._triangulate(new[wide], k)

    def _due(self, k: int) -> bool:
        last = self.keyframes[-1]
        both = self.tracks.seen(last) & self.tracks.seen(k)
        if both.sum() < 0.3 * self.tracks.seen(k).sum():
            return True
        flow = np.linalg.norm(self.tracks.points[k, both] - self.tracks.points[last, both], axis=1)
        return bool(np.median(flow) * self.tracks.focal > FLOW)

    def _adjust(self, frames: list[int]) -> None:
        """Bundle adjustment: Levenberg and Marquardt's steps, Huber's weights, the first two poses held."""
        seen = np.array([self.tracks.seen(k) for k in frames])
        seen &= np.isfinite(self.X[:, 0]) & (seen.sum(axis=0) >= 2)
        column = np.flatnonzero(seen.any(axis=0))
        at, which = np.nonzero(seen[:, column])
        u = self.tracks.points[np.array(frames)[at], column[which]]
        poses, X, damping = self.poses[frames], self.X[column], 1e-4
        cost = _residuals(poses, X, at, which, u, self.tracks.focal)[0]
        for _ in range(STEPS):
            moved = _step(poses, X, at, which, u, self.tracks.focal, damping)
            new = _residuals(*moved, at, which, u, self.tracks.focal)[0]
            if new < cost:
                (poses, X), damping, done = moved, damping / 10, cost - new < 1e-5 * cost
                cost = new
                if done:
                    break
            else:
                damping *= 10
        self.poses[frames], self.X[column] = poses, X


def _residuals(poses, X, at, which, u, focal):
    """Huber's cost, the residuals in pixels, the points in the cameras, and the weights."""
    Y = np.einsum("nij,nj->ni", poses[at, :3, :3], X[which]) + poses[at, :3, 3]
    Y[:, 2] = np.maximum(Y[:, 2], 1e-6)
    r = (u - Y[:, :2] / Y[:, 2:]) * focal
    size = np.linalg.norm(r, axis=1)
    weight = np.where(size > 1, 1 / np.maximum(size, 1), 1.0)
    return np.sum(np.where(size > 1, 2 * size - 1, size**2)), r, Y, weight


def _step(poses, X, at, which, u, focal, damping):
    """Poses and points a step further, the points eliminated."""
    _, r, Y, weight = _residuals(poses, X, at, which, u, focal)
    k, m = len(poses), len(X)
    z, zero = Y[:, 2], np.zeros(len(Y))
    image = np.stack([1 / z, zero, -Y[:, 0] / z**2, zero, 1 / z, -Y[:, 1] / z**2], axis=1).reshape(-1, 2, 3) * focal
    skew = np.stack([zero, Y[:, 2], -Y[:, 1], -Y[:, 2], zero, Y[:, 0], Y[:, 1], -Y[:, 0], zero], axis=1)
    A = np.concatenate([image, image @ skew.reshape(-1, 3, 3)], axis=2)  # left perturbation (linear, angular)
    B = image @ poses[at, :3, :3]
    U, V, W = np.zeros((k, 6, 6)), np.zeros((m, 3, 3)), np.zeros((k, m, 6, 3))
    a, b = np.zeros((k, 6)), np.zeros((m, 3))
    np.add.at(U, at, np.einsum("n,nri,nrj->nij", weight, A, A))
    np.add.at(V, which, np.einsum("n,nri,nrj->nij", weight, B, B))
    W[at, which] = np.einsum("n,nri,nrj->nij", weight, A, B)
    np.add.at(a, at, np.einsum("n,nri,nr->ni", weight, A, r))
    np.add.at(b, which, np.einsum("n,nri,nr->ni", weight, B, r))
    for block in (U, V):
        size = block.shape[-1]
        block[:, range(size), range(size)] *= 1 + damping
    V[:, range(3), range(3)] += 1e-9
    inverse = np.linalg.inv(V)
    left = np.einsum("kmij,mjl->kmil", W, inverse)
    flat, across = (x.transpose(0, 2, 1, 3).reshape(6 * k, 3 * m) for x in (left, W))
    S = -flat @ across.T
    for i in range(k):
        S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += U[i]
    x = np.zeros(6 * k)
    x[12:] = np.linalg.solve(S[12:, 12:], (a.reshape(-1) - flat @ b.reshape(-1))[12:])
    points = np.einsum("mij,mj->mi", inverse, b - np.einsum("kmij,ki->mj", W, x.reshape(k, 6)))
    new = poses.copy()
    for i in range(2, k):
        R = cv2.Rodrigues(x[6 * i + 3 : 6 * i + 6])[0]
        new[i, :3, :3], new[i, :3, 3] = R @ poses[i, :3, :3], R @ poses[i, :3, 3] + x[6 * i : 6 * i + 3]
    return new, X + points
