"""The two ways to choose base frames, behind one interface for the driver: keyframes, or one pair for all."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array

from jaxtri.estimation.two_view import TwoView
from jaxtri.geometry.pose import relative
from jaxtri.models.base_pairs import BasePoint
from jaxtri.odometry import single_pair, track_pairs
from jaxtri.odometry.settings import Base, Report, Settings, StartSettings, Status
from jaxtri.odometry.start import BasePair, Observations, find, step_tracks
from jaxtri.odometry.structure import Points, Structure

HISTORY = 40  # frames that an inherited pair may begin in

_segment_init = jax.jit(single_pair.init)
_segment_step = jax.jit(single_pair.step)
_consecutive = jax.jit(single_pair.consecutive)
_inherited = jax.jit(single_pair.inherited)
_second_report = jax.jit(single_pair.second_report)


@runtime_checkable
class Follower(Protocol):
    """A running filter, one frame at a time."""

    @property
    def depth(self) -> float:
        """Median depth of the scene."""
        ...

    keyframes: int
    begun: list[BasePair]  # base pairs after the first, where one serves all tracks

    def follow(self, frame: Observations, dt: float) -> Report:
        """The pose of the next frame."""
        ...

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        ...

    def present(self) -> Points:
        """The points of the tracks that are followed now."""
        ...


@dataclass
class TrackPairs:
    """Tracks measured from a window of keyframes: `jaxtri.track_pairs`."""

    settings: Settings
    state: track_pairs.State
    known: np.ndarray  # (n,) numbers of the tracks in the slots of the last frame, -1 where there was none
    structure: Structure
    keyframes: int = 2
    begun: list[BasePair] = field(default_factory=list)

    @classmethod
    def after(
        cls, settings: Settings, state: track_pairs.State, last: Observations, common: np.ndarray
    ) -> "TrackPairs":
        """Go on from a start whose second base frame is `last` and whose tracks are the `common` ones."""
        return cls(settings, state, np.where(common, last.ids, -1), Structure(settings))

    @property
    def depth(self) -> float:
        """Median depth of the scene."""
        return float(self.state.depth)

    def follow(self, frame: Observations, dt: float) -> Report:
        """The pose of the next frame."""
        fresh = frame.visible & (frame.ids != self.known)
        over = (self.known >= 0) & (fresh | ~frame.visible)
        self.structure.end(self._points(), over & self._good(), self.known)
        self.known = np.where(frame.visible, frame.ids, -1)
        self.state, report = step_tracks(
            *(self.settings, self.state, frame.u, frame.visible, fresh, dt),
            hold=np.False_,
            quality=frame.quality,
            late=frame.late,
        )
        self.keyframes += int(report.keyframe)
        return report

    def _good(self) -> np.ndarray:
        # What its looks do not agree on is not a point of the scene.
        return np.asarray(self.state.tracks.usable)

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        return self.structure.ended()

    def present(self) -> Points:
        """The points of the tracks that are followed now."""
        return self.structure.of(self._points(), self._good(), self.known)

    def _points(self) -> BasePoint:
        """With their errors over the assumed noise, whatever was found since."""
        base = self.state.tracks.base
        return base._replace(spread=np.asarray(base.spread) * float(self.state.noise))


@dataclass
class SinglePair:
    """One base pair for all tracks, restarted as its tracks run out: `jaxtri.single_pair`."""

    settings: Settings
    start: StartSettings
    base: Base
    state: single_pair.State
    ids: np.ndarray  # (n,) numbers of the pair's tracks, -1 where there is none
    size: int  # tracks that the pair began with
    history: list[tuple[Observations, SE3, Array]]  # the last frames, their poses and covariances
    structure: Structure
    keyframes: int = 2
    begun: list[BasePair] = field(default_factory=list)

    @classmethod
    def after(
        cls,
        settings: Settings,
        start: StartSettings,
        base: Base,
        frames: list[Observations],
        two_view: TwoView,
        world: SE3,
    ) -> "SinglePair":
        """Go on from a start on the first and last of `frames`; `world` is the pose of the first."""
        dtype, first, last = settings.sigma.dtype, frames[0], frames[-1]
        placement = single_pair.origin(dtype)._replace(pose=world)
        state, ids, size = _segment(settings, first, last, two_view, placement)
        history = [(first, world, jnp.zeros((6, 6), dtype))]
        return cls(settings, start, base, state, ids, size, history, Structure(settings))

    @property
    def depth(self) -> float:
        """Median depth of the scene at the start of the segment."""
        return float(self.state.depth)

    def _begin(
        self, first: Observations, second: Observations, two_view: TwoView, placement: single_pair.Placement
    ) -> None:
        """A new pair; all points of the segment that it replaces are kept."""
        self.structure.end(self.state.structure, np.asarray(self.state.inside), self.ids)
        self.state, self.ids, self.size = _segment(self.settings, first, second, two_view, placement)

    def follow(self, frame: Observations, dt: float) -> Report:
        """The pose of the next frame, after a restart where the tracks of the pair have run out."""
        left = np.asarray(self.state.inside) & frame.visible & (frame.ids == self.ids)
        short = left.sum() < max(self.start.restart * self.size, 2 * float(self.settings.minimum))
        if short and self.base is Base.PAPER:
            report = self._consecutive(frame, dt)
            if report is not None:
                return report
        report = self._advance(frame, dt)
        if short and self.base is Base.INHERIT and Status(int(report.status)).measured:
            self._inherit()
        return report

    def _advance(self, frame: Observations, dt: float) -> Report:
        fresh = frame.ids != self.ids
        over = np.asarray(self.state.inside) & (fresh | ~frame.visible)
        self.structure.end(self.state.structure, over, self.ids)
        self.state, report = _segment_step(
            self.settings, self.state, frame.u, frame.visible, fresh, dt, quality=frame.quality
        )
        self._remember(frame, report)
        return report

    def _consecutive(self, frame: Observations, dt: float) -> Report | None:
        """The paper's restart: two consecutive frames, `overlap` frames back, the scale from common points."""
        known = self.history[-self.start.overlap :]
        first, pose1, covariance1 = known[0]
        frames = [k[0] for k in known[1:]] + [frame]
        second = frames[0]
        found = find(self.settings, self.start, [first, second]).found
        if found is None:
            return None  # go on with the old pair as long as it lasts
        arrays = jnp.asarray(first.u), jnp.asarray(second.u)
        common = jnp.asarray(first.common(second) & (first.ids == self.ids))
        pair = single_pair.Pair(*arrays, common, pose1, covariance1)
        view, placement, count = _consecutive(self.settings, self.state, pair, found.pose)
        if count < 3:
            return None
        self._begin(first, second, view, placement)
        self.begun.append(BasePair(first.index, second.index, frame.index - 1, found.pose, found.inside))
        self.keyframes += 2
        report = _second_report(self.state)
        self.history = known[:1]
        self._remember(second, report)
        for later in frames[1:]:
            report = self._advance(later, dt)
        return report

    def _remember(self, frame: Observations, report: Report) -> None:
        self.history = [*self.history[1 - HISTORY :], (frame, report.pose, report.covariance)]

    def _inherit(self) -> None:
        """A new pair from two frames already tracked: the present one and the best of those before it."""
        *earlier, (now, pose, _) = self.history
        best, choice = 0.0, None
        for frame, other, covariance in earlier:
            common = frame.common(now)
            if common.sum() < self.start.points:
                continue
            motion = np.asarray(relative(other, pose).as_matrix())
            angle = _parallax(frame.u[common], now.u[common], motion[:3, :3])
            # Information on depth: the angle, up to where more of it no longer helps, by the root of the count.
            score = min(angle, 3 * float(self.settings.fixed_parallax)) * np.sqrt(common.sum())
            if score > best:
                best, choice = score, (frame, other, covariance)
        if choice is None:
            return
        frame, other, covariance = choice
        arrays = jnp.asarray(frame.u), jnp.asarray(now.u), jnp.asarray(frame.common(now))
        refined, placement = _inherited(self.settings, self.state, single_pair.Pair(*arrays, other, covariance))
        if not bool(refined.converged):
            return
        self._begin(frame, now, refined, placement)
        self.begun.append(BasePair(frame.index, now.index, now.index, refined, frame.common(now)))
        self.keyframes += 1

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        return self.structure.ended()

    def present(self) -> Points:
        """The points of the pair's tracks that are followed now."""
        return self.structure.of(self.state.structure, np.asarray(self.state.inside), self.ids)


def _segment(
    settings: Settings,
    first: Observations,
    second: Observations,
    two_view: TwoView,
    placement: single_pair.Placement,
) -> tuple[single_pair.State, np.ndarray, int]:
    """The state of a segment at its second base frame, the numbers of its tracks, and how many they are."""
    mask = first.common(second)
    arrays = jnp.asarray(first.u), jnp.asarray(second.u), jnp.asarray(mask)
    state = _segment_init(settings, *arrays, two_view, placement, float(second.index - first.index))
    return state, np.where(mask, second.ids, -1), int(np.asarray(state.inside).sum())


def _parallax(a: np.ndarray, b: np.ndarray, R: np.ndarray) -> float:
    x = np.c_[a, np.ones(len(a))] @ R.T
    y = np.c_[b, np.ones(len(b))]
    return float(np.median(np.arctan2(np.linalg.norm(np.cross(x, y), axis=1), (x * y).sum(axis=1))))
