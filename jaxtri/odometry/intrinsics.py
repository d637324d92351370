"""The search for intrinsics at which keyframes, points and all that was seen fit best; and for a zoom on the way."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxtri.estimation import batch, calibration
from jaxtri.estimation.batch import Estimate
from jaxtri.estimation.calibration import Told
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.odometry.adjustment import Adjustment
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.observing import normalise
from jaxtri.odometry.stretches import Segment

# What is known beforehand: of the focal length, as a share of it, where it is a guess of what most cameras have (24 to
# 110 degrees are within one standard deviation of 60); of the principal point, as a share of the width; of k1 and k2.
GUESSED, CENTRE, LENS = 0.5, 0.02, (0.2, 0.1)
# Changes at most: of the focal length alone; of that and a zoom; and of all that is free.
FOCAL, ALONE, TOGETHER = 3, 8, 12
STEPS, FIRST = 4, 20  # of the poses and points after each change, and before the first, at most
ENOUGH = 0.01  # share of the cost: a step that takes less away is the last one
LARGEST = (0.25, 0.02, 0.02, 0.1, 0.05)  # change of each at once: so far is the slope still good
SETTLED = 0.1  # standard deviations, with UNMODELLED, below which a change is the last one
TIMES, CELLS = 10, 3  # parts of the sequence, and of each side of the picture, that may err each in its own way
# A focal length that changes is known at so many keyframes at most beside the first. Its logarithm walks: twice as long
# in four seconds of 25 frames is two standard deviations. A change at once is a tenth at most.
KNOTS, WALK, LARGEST_ZOOM = 16, 0.035, 0.1
# The least that is said of the focal length's standard deviation, as a share of it. Real video is not what the model
# says (rolling shutter, a lens of more coefficients, features that drift together), and no scatter of the tracks shows
# that: on the six sequences of `benchmarks/real_sequences.py` it is 1.5 % and more that the estimates are off by.
UNMODELLED = 0.015
# A zoom is looked for where it would take away such a share of the cost, which no other intrinsics would. It is one
# where it takes away BETTER of what they leave, and the focal length changes by so many standard deviations. On ten
# clips without one these shares are .004 and .022 at most, on one with a zoom of 1.6 they are .028 and .14 at least.
SUSPECTED, BETTER, CERTAIN = 0.01, 0.05, 3.0


class Found(NamedTuple):
    """What a search has come to.

    Attributes:
        change: (p,) of the camera that it began with, as `jaxtri.estimation.calibration.changed` takes it.
        sd: (p,) its standard deviations.
        zoom: How the focal length changes on the way; None where it does not.
    """

    change: np.ndarray
    sd: np.ndarray
    zoom: ZoomCurve | None


@dataclass
class Search:
    """Changes of the intrinsics and of all that was seen by them, in turns.

    Attributes:
        camera: That of the odometry, with a lens; what is found is a change of it.
        known: (p,) standard deviations of the intrinsics beforehand.
    """

    odometry: Odometry
    segment: Segment
    keys: np.ndarray
    begun: Adjustment
    guess: Camera  # that is likeliest beforehand
    prior: float  # standard deviation of its focal length, as a share of it
    progress: bool = False

    def __post_init__(self) -> None:
        self.camera = camera = calibration.with_lens(self.odometry.camera)
        self.about = np.asarray(calibration.difference(camera, calibration.with_lens(self.guess)))
        centre = CENTRE * (camera.width or 2 * float(camera.cx)) / float(camera.fx)
        self.known = np.array([self.prior, centre, centre, *LENS])[: len(self.about)]
        self._now, self._adjusted, self._steps = self.begun.estimate, False, FIRST
        self._x = np.zeros(self._p + len(self._at) - 1)
        if self.odometry.zoom is not None:
            log = self.odometry.zoom.log(self._times)
            self._x[0], self._x[self._p :] = log[0], log[1:] - log[0]

    def run(self) -> Found:
        """All intrinsics, and a zoom where there is one."""
        place = np.arange(len(self._x))
        focal, intrinsics, knots = place < 1, place < self._p, place >= self._p
        with tqdm(unit="step", desc="calibrate", disable=None if self.progress else True, leave=False) as bar:

            def without() -> Found:
                told = self._descend(intrinsics, TOGETHER, bar)
                return Found(self._x[: self._p].copy(), self._sd(told, intrinsics)[: self._p], None)

            # The focal length first: far from it a lens is found that explains what is wrong with it, and stays.
            self._descend(focal, FOCAL, bar)
            found, cost = None, math.inf  # a zoom that is followed already need not be shown again
            if self.odometry.zoom is None:
                begun = self._now, self._adjusted, self._x.copy()
                found, cost = without(), float(self._now.cost)
                if not self._suspected(intrinsics):
                    return found
                # From before the other intrinsics have explained it.
                self._now, self._adjusted, self._x = begun
            self._descend(focal | knots, ALONE, bar)
            found = self._zoom(self._descend(place >= 0, TOGETHER, bar), cost) or found
            if found is not None:
                return found
            self._x[0], self._x[knots], self._adjusted = self._x[0] + self._mean(), 0.0, False
            return without()

    def zoom(self, poses: Estimate) -> ZoomCurve | None:
        """How the focal length changes on the way, over that in the first keyframe; None where it does not.

        Of a camera that is as it should be otherwise, from its poses and points at their best.
        """
        self._now, self._adjusted, self._steps = poses, True, STEPS
        if len(self._at) < 2 or not self._suspected(np.arange(len(self._x)) < self._p):
            return None
        found = self.run().zoom
        return None if found is None else replace(found, ratio=found.ratio / found.ratio[0])

    @property
    def _p(self) -> int:
        return len(self.about)

    @cached_property
    def _at(self) -> np.ndarray:
        """Keyframes that the focal length is known at, their places among all."""
        count = min(len(self.keys), KNOTS + 1)
        return np.unique(np.round(np.linspace(0, len(self.keys) - 1, count)).astype(int))

    @cached_property
    def _times(self) -> np.ndarray:
        """Their times, seconds."""
        return np.array([self.odometry.poses[k].time for k in self.segment.frames[self.keys[self._at]]])

    @cached_property
    def _share(self) -> np.ndarray:
        """(k, m) what the knots but the first say of each keyframe; linear in time."""
        times, share = self.segment.times[self.keys], np.zeros((len(self.begun.problem.present), len(self._at) - 1))
        for column, knot in enumerate(np.eye(len(self._at))[1:]):
            share[: len(times), column] = np.interp(times, times[self._at], knot)
        return share

    @cached_property
    def _prior(self) -> np.ndarray:
        """Information of what is known beforehand: of each intrinsic, and of the steps of a walk."""
        p, m = self._p, len(self._at) - 1
        step = np.diff(np.eye(m + 1), axis=0)[:, 1:]
        step /= WALK * np.sqrt(np.diff(self.segment.times[self.keys[self._at]]))[:, None]
        prior = np.zeros((p + m, p + m))
        prior[:p, :p], prior[p:, p:] = np.diag(self.known**-2), step.T @ step
        return prior

    def _descend(self, free: np.ndarray, most: int, bar: tqdm) -> Told:
        """Change what is free until that settles; what is told at the end."""
        p, largest = self._p, np.full(len(self._x), LARGEST_ZOOM)
        largest[:p] = LARGEST[:p]
        number = 0
        while True:
            problem, told, information, pull = self._told(bool(free[p:].any()))
            free, number = free[: len(pull)], number + 1
            step = np.zeros_like(pull)
            step[free] = np.linalg.solve(information[np.ix_(free, free)], pull[free])
            if not np.isfinite(step).all():
                return told
            sd = np.sqrt(np.maximum(np.diag(np.linalg.inv(information)), 0))
            settled = (np.abs(step) < SETTLED * np.hypot(sd, UNMODELLED)).all()
            step = np.clip(step, -largest[: len(step)], largest[: len(step)])
            self._x[: len(step)] += step
            moved = batch.moved_poses(problem, self._now.poses, told.response @ jnp.asarray(step))
            cost, self._adjusted = self._now.cost, False
            self._now = Estimate.of(moved, self._now.points)._replace(cost=cost)  # a little more than it is now
            bar.update()
            if settled or number == most:
                return told

    def _told(self, knots: bool) -> tuple[batch.Batch, Told, np.ndarray, np.ndarray]:
        """All that was seen as the camera would see it, and what it tells, with what was known beforehand."""
        camera = calibration.changed(self.camera, jnp.asarray(self._x[: self._p]))
        problem, noise = self._seen(camera), self.begun.noise
        # Of the same pixels: what the odometry has by its mean focal length is taken by this one's.
        mean = camera.focal * math.exp(self._mean())
        noise = noise._replace(sigma=noise.sigma * self.odometry.camera.focal / mean)
        if not self._adjusted:
            self._now = Estimate.of(self._now.poses, self._now.points)
            for _ in range(self._steps):
                before, self._now = float(self._now.cost), batch.step(problem, noise, self._now)
                if bool(self._now.done) or before - float(self._now.cost) < ENOUGH * before < math.inf:
                    break
            self._adjusted, self._steps = True, STEPS
        size, share = len(self._x) if knots else self._p, None
        if knots:  # of as many always: what is compiled for them serves for fewer
            share = jnp.asarray(np.pad(self._share, ((0, 0), (0, KNOTS - self._share.shape[1]))))
        told = calibration.told(problem, noise, self._now.poses, self._now.points, camera, share).first(size)
        prior, x = self._prior[:size, :size], self._x[:size].copy()
        x[: self._p] -= self.about
        return problem, told, np.asarray(told.information) + prior, np.asarray(told.pull) - prior @ x

    def _suspected(self, free: np.ndarray) -> bool:
        """Whether a zoom would take away a share of the cost that is worth looking at, and what is free would not."""
        _, _, information, pull = self._told(True)

        def gain(free: np.ndarray) -> float:
            return float(pull[free] @ np.linalg.solve(information[np.ix_(free, free)], pull[free]))

        knots = np.arange(len(free)) >= self._p
        return gain(free | knots) - gain(free) > SUSPECTED * float(self._now.cost)

    def _zoom(self, told: Told, without: float) -> Found | None:
        """What the descent has ended at, whose cost was so much without; None where it is no zoom."""
        sd, log = self._sd(told, np.ones(len(self._x), bool)), np.r_[0.0, self._x[self._p :]]
        log_sd = np.hypot(np.r_[0.0, sd[self._p :]], UNMODELLED)
        better = float(self._now.cost) < (1 - BETTER) * without
        if not (better and np.abs(log / np.hypot(log_sd, UNMODELLED)).max() > CERTAIN):  # nor where it is NaN
            return None
        change, mean = self._x[: self._p].copy(), self._mean()
        change[0] += mean
        return Found(change, sd[: self._p], ZoomCurve(self._times, np.exp(log - mean), log_sd))

    def _mean(self) -> float:
        """Logarithm of the mean focal length, over all frames, over the first: it is the camera's own."""
        times = np.array([self.odometry.poses[k].time for k in self.segment.frames])
        return float(np.interp(times, self._times, np.r_[0.0, self._x[self._p :]]).mean())

    def _seen(self, camera: Camera) -> batch.Batch:
        """All that was seen, as the camera and its zoom see it; what they have no ray for is left out."""
        zoom, none = np.exp(np.r_[0.0, self._x[self._p :]]), np.zeros(len(self._at))
        curve = ZoomCurve(self._times, zoom, none)
        dtype, layers = self.segment.u.dtype, []
        u, tracks = np.zeros((len(self.keys), *self.segment.u.shape[1:]), dtype), self.odometry.tracks
        for k, frame in enumerate(self.segment.frames[self.keys]):
            seen_by = curve.camera(camera, self.odometry.poses[frame].time)
            u[k] = np.asarray(normalise(seen_by, tracks[frame].pixels.astype(dtype)))
        pieces = self.begun.pieces
        for layer, observed, (_, mask, *_) in zip(
            self.begun.problem.layers, pieces.observed(u), pieces.layers, strict=True
        ):
            mask = mask & np.isfinite(observed).all(axis=1)
            layers.append(layer._replace(observed=jnp.asarray(np.nan_to_num(observed)), mask=jnp.asarray(mask)))
        return self.begun.problem._replace(layers=tuple(layers))

    def _sd(self, told: Told, free: np.ndarray) -> np.ndarray:
        """Standard deviations by what was assumed, and by how groups of tracks disagree: the larger of them."""
        size, scores = len(told.pull), [np.asarray(s) for s in told.scores]
        inverse, free = np.zeros((size, size)), free[:size]
        information = np.asarray(told.information) + self._prior[:size, :size]
        inverse[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
        pieces = self.begun.pieces
        score = pieces.each(scores, (size,))
        count = np.bincount(pieces.piece)
        tracks = self.odometry.tracks
        at = tracks[self.segment.frames[0]].pixels  # the size of the picture, where it is not known
        camera = self.camera
        extent = np.array([camera.width or at[:, 0].max(), camera.height or at[:, 1].max()])
        frames = self.segment.frames[self.keys[pieces.key]]
        pixels = np.array([tracks[f].pixels[s] for f, s in zip(frames, pieces.slot, strict=True)])
        mean = np.stack([np.bincount(pieces.piece, pixels[:, i] / extent[i]) / count for i in (0, 1)])
        column, row = (mean * CELLS).astype(int).clip(0, CELLS - 1)
        middle = np.bincount(pieces.piece, pieces.key) / count
        found = [np.diag(inverse)]
        for group in (pieces.ids, (middle * TIMES / len(self.keys)).astype(int), row * CELLS + column):
            group = np.unique(group, return_inverse=True)[1]
            groups = group.max() + 1
            together = np.stack([np.bincount(group, s) for s in score.T])
            found.append(np.diag(inverse @ (together @ together.T * groups / max(groups - 1, 1)) @ inverse))
        return np.sqrt(np.maximum(np.max(found, axis=0), 0))
