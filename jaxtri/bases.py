"""The two ways to choose base frames, behind one interface for the driver: per track, or one pair for all."""

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array

from jaxtri import segments, tracker
from jaxtri.compilation import capacity
from jaxtri.estimation.two_view import TwoView
from jaxtri.geometry.pose import compose, relative, shear
from jaxtri.models.depth import Bank
from jaxtri.tracker import Report, Settings, Status
from jaxtri.vision.initialise import Hypothesis, hypotheses


class Base(Enum):
    """Which two base frames a track is measured from."""

    TRACKS = "tracks"  # a pair per track, drawn from keyframes
    INHERIT = "inherit"  # one pair for all; a restart takes two frames already tracked
    PAPER = "paper"  # one pair for all; a restart takes two consecutive frames and matches the scale


@dataclass(frozen=True)
class StartSettings:
    """When a base pair is good enough; see `jaxtri.vision.initialise`."""

    flow: float = 0.035  # median flow between the two frames, as a share of the image width
    parallax_deg: float = 1.0  # median angle between the two rays of a point
    points: int = 20  # fewest tracks that agree on the motion
    common: float = 0.15  # share of the tracks that must survive; below it a later first frame is taken
    restart: float = 0.35  # share of a pair's tracks below which a segment ends (inherit, paper)
    overlap: int = 1  # frames that two segments share (paper)
    lag: int = 16  # frames that come while a start is worked out beside them; its poses are known after as many
    eight_point: bool = False  # the 8-point algorithm with RANSAC, as in the paper

    @classmethod
    def of(cls, base: Base, **changes: Any) -> "StartSettings":
        """The defaults of a kind of base; the paper's starts from the first two frames that move at all."""
        if base is Base.PAPER:
            changes = {"flow": 0.003, "parallax_deg": 0.1, "eight_point": True} | changes
        return cls(**changes)


@dataclass(frozen=True)
class Frame:
    """The tracks of one frame, normalised, in slots."""

    index: int
    time: float
    u: np.ndarray  # (n, 2)
    visible: np.ndarray  # (n,)
    fresh: np.ndarray  # (n,)
    ids: np.ndarray  # (n,)
    quality: np.ndarray  # (n, 2) forward-backward error in pixels, smaller eigenvalue of the patch

    def common(self, other: "Frame") -> np.ndarray:
        """Slots that hold the same track in both frames."""
        return self.visible & other.visible & (self.ids == other.ids)


_init = jax.jit(tracker.init)
_step = jax.jit(tracker.step)
_segment_init = jax.jit(segments.init)
_segment_step = jax.jit(segments.step)
_consecutive = jax.jit(segments.consecutive)
_inherited = jax.jit(segments.inherited)
_second_report = jax.jit(segments.second_report)


class Start(NamedTuple):
    """A base pair, or the reason why there is none yet."""

    found: Hypothesis | None
    reason: str


class Restart(NamedTuple):
    """A base pair: its frames, the last one that the pair before it measured, and what its pose comes from."""

    first: int
    second: int
    last: int
    found: TwoView
    inside: np.ndarray  # (n,)


def find(settings: Settings, start: StartSettings, frames: list[Frame]) -> Start:
    """Relative pose of the first and the last of `frames`, or why it has to wait.

    Of the hypotheses that explain the pair about equally well (before a plane there are two) the frames
    between decide, by how well the transfer reaches them.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    if common.sum() < start.points:
        return Start(None, f"only {int(common.sum())} tracks are common to two frames, {start.points} are needed")
    threshold = float(settings.epipolar_gate)
    found = hypotheses(first.u, last.u, common, settings.sigma, threshold, eight_point=start.eight_point)
    if not found:
        return Start(None, "no essential matrix fits the tracks")
    between = [frames[int(k)] for k in np.linspace(0, len(frames) - 1, 5).round()[1:-1] if 0 < k < len(frames) - 1]
    rivals = [h for h in found if h.cost < 1.5 * found[0].cost + 50]
    if between and len(rivals) > 1:
        rivals.sort(key=lambda h: h.cost + _transfer_cost(settings, h, first, last, between))
    best = rivals[0]
    if best.inside.sum() < max(start.points, 0.4 * common.sum()):
        return Start(None, f"only {int(best.inside.sum())} of {int(common.sum())} tracks agree on one motion")
    if not best.parallax_deg >= start.parallax_deg:
        return Start(None, f"the parallax is {best.parallax_deg:.2f} degrees, {start.parallax_deg:g} are needed")
    return Start(best, "")


def _transfer_cost(settings: Settings, h: Hypothesis, first: Frame, last: Frame, between: list[Frame]) -> float:
    """Truncated squared distances of the points transferred to the frames between the pair."""
    pose = compose(h.pose.rotation, h.pose.translation)
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(h.inside)
    state = _init(settings, *arrays, pose, jnp.zeros((6, 6), settings.sigma.dtype), world=_identity(settings))
    cost, before = 0.0, first.index
    for frame in between:
        visible = first.common(frame) & h.inside
        state, report = hold(settings, state, frame, visible, float(frame.index - before))
        distance = np.where(np.asarray(report.diagnostics.distance) < 16, report.diagnostics.distance, 16.0)
        measured = visible & np.asarray(state.tracks.usable)
        cost += float(distance[measured].sum()) + 16.0 * float((visible & ~measured).sum())
        before = frame.index
    return cost


def _identity(settings: Settings) -> SE3:
    return jax.tree.map(lambda x: x.astype(settings.sigma.dtype), SE3.identity())


def fill(
    settings: Settings, frames: list[Frame], two_view: TwoView, world: SE3, dt: list[float]
) -> tuple[tracker.State, list[tuple[Frame, Report]]]:
    """Set up the tracker on the first and last of `frames`, whose relative pose is given, and run it over them.

    Reports of all frames but the first, whose pose is `world`.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    pose = compose(two_view.rotation, two_view.translation)
    J = shear(two_view.translation)
    covariance = J @ two_view.covariance @ J.T
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(common)
    state = _init(settings, *arrays, pose, covariance, world=world)
    reports = []
    for frame, elapsed in zip(frames[1:], dt, strict=True):
        state, report = hold(settings, state, frame, first.common(frame) & common, elapsed)
        reports.append((frame, report))
    return state, reports


def hold(
    settings: Settings, state: tracker.State, frame: Frame, visible: np.ndarray, dt: float
) -> tuple[tracker.State, Report]:
    """One frame measured with the tracks as they are: none begins, no keyframe is made."""
    nothing = np.zeros(len(visible), bool)
    return _step(settings, state, frame.u, visible, nothing, dt, hold=np.True_, quality=frame.quality)


@jax.jit
def _world_points(bank: Bank, settings: Settings) -> tuple[jax.Array, jax.Array, jax.Array]:
    """World points of a bank, the covariance of each, and which are known: depth to better than a third."""
    points, covariance = tracker.structure_model(settings).world(bank)

    def one(X: Array, C: Array) -> tuple[Array, Array]:
        w = jnp.where(jnp.abs(X[3]) > 1e-9, X[3], 1e-9)
        J = jnp.concatenate([jnp.eye(3, dtype=X.dtype), -(X[:3] / w)[:, None]], axis=1) / w
        return X[:3] / w, J @ C @ J.T

    return *jax.vmap(one)(points, covariance), points[:, 3] > 3 * jnp.sqrt(covariance[:, 3, 3])


class Points(NamedTuple):
    """Triangulated points: `ids` (n,) of their tracks, `xyz` (n, 3) in the world, `covariance` (n, 3, 3)."""

    ids: np.ndarray
    xyz: np.ndarray
    covariance: np.ndarray


def no_points() -> Points:
    """None at all."""
    return Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


class _Structure:
    """The points of a bank as tracks come and go: what each was last known to be."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._ended: list[tuple[Bank, np.ndarray]] = []

    def of(self, bank: Bank, good: np.ndarray, ids: np.ndarray) -> Points:
        """The known points of the `good` slots."""
        xyz, covariance, known = (np.asarray(x) for x in _world_points(bank, self._settings))
        good = good & known & np.isfinite(xyz).all(axis=1)
        return Points(ids[good], xyz[good], covariance[good])

    def end(self, bank: Bank, good: np.ndarray, ids: np.ndarray) -> None:
        """Keep the points of the `good` slots, whose tracks have ended."""
        if good.any():
            self._ended.append((jax.tree.map(lambda x: np.asarray(x)[good], bank), ids[good]))

    def ended(self) -> Points:
        """What was kept since the last call."""
        if not self._ended:
            return no_points()
        banks, ids = zip(*self._ended, strict=True)
        self._ended = []
        # Filled up to one of a few lengths, each of which compiles once.
        count = sum(map(len, ids))
        spare = capacity(count) - count
        bank = jax.tree.map(lambda *x: np.concatenate([*x, np.repeat(x[0][:1], spare, axis=0)]), *banks)
        return self.of(bank, np.arange(count + spare) < count, np.concatenate([*ids, np.full(spare, -1)]))


class Follower(Protocol):
    """A running filter, one frame at a time."""

    @property
    def depth(self) -> float:
        """Median depth of the scene."""
        ...

    keyframes: int
    begun: list[Restart]  # base pairs after the first, where one serves all tracks

    def follow(self, frame: Frame, dt: float) -> Report:
        """The pose of the next frame."""
        ...

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        ...

    def present(self) -> Points:
        """The points of the tracks that are followed now."""
        ...


class TrackPairs:
    """`jaxtri.tracker`: a base pair per track."""

    def __init__(self, settings: Settings, state: tracker.State, last: Frame, common: np.ndarray) -> None:
        self.settings, self.state = settings, state
        self.keyframes, self.begun = 2, list[Restart]()
        self._known = np.where(common, last.ids, -1)
        self._structure = _Structure(settings)

    @property
    def depth(self) -> float:
        """Median depth of the scene."""
        return float(self.state.depth)

    def follow(self, frame: Frame, dt: float) -> Report:
        """The pose of the next frame."""
        fresh = frame.fresh | (frame.visible & (frame.ids != self._known))
        over = (self._known >= 0) & (fresh | ~frame.visible)
        self._structure.end(self.state.structure, over & self._good(), self._known)
        self._known = np.where(frame.visible, frame.ids, -1)
        self.state, report = _step(
            self.settings,
            self.state,
            frame.u,
            frame.visible,
            fresh,
            dt,
            hold=np.False_,
            quality=frame.quality,
        )
        self.keyframes += int(report.keyframe)
        return report

    def _good(self) -> np.ndarray:
        # What no base pair agrees on is not a point of the scene.
        return np.asarray(self.state.tracks.usable) & np.asarray(self.state.born)

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        return self._structure.ended()

    def present(self) -> Points:
        """The points of the tracks that are followed now."""
        return self._structure.of(self.state.structure, self._good(), self._known)


class SinglePair:
    """`jaxtri.segments`: one base pair for all tracks, restarted as its tracks run out."""

    def __init__(
        self,
        settings: Settings,
        start: StartSettings,
        base: Base,
        frames: list[Frame],
        two_view: TwoView,
        world: SE3,
    ) -> None:
        self.settings, self.start, self.base = settings, start, base
        self.keyframes, self.begun = 2, list[Restart]()
        self._structure = _Structure(settings)
        placement = segments.origin(settings.sigma.dtype)._replace(pose=world)
        self._history: deque[tuple[Frame, SE3, Array]] = deque(maxlen=40)
        self._history.append((frames[0], world, jnp.zeros((6, 6), settings.sigma.dtype)))
        self._begin(frames[0], frames[-1], two_view, placement)

    @property
    def depth(self) -> float:
        """Median depth of the scene at the start of the segment."""
        return float(self.state.depth)

    def _begin(self, first: Frame, second: Frame, two_view: TwoView, placement: segments.Placement) -> None:
        mask = first.common(second)
        self.state = _segment_init(
            self.settings,
            jnp.asarray(first.u),
            jnp.asarray(second.u),
            jnp.asarray(mask),
            two_view,
            placement,
            float(second.index - first.index),
        )
        self._ids = np.where(mask, second.ids, -1)
        self._size = int(np.asarray(self.state.inside).sum())

    def _end(self) -> None:
        """Keep all points of a segment that another replaces."""
        self._structure.end(self.state.structure, np.asarray(self.state.inside), self._ids)

    def follow(self, frame: Frame, dt: float) -> Report:
        """The pose of the next frame, after a restart where the tracks of the pair have run out."""
        left = np.asarray(self.state.inside) & frame.visible & (frame.ids == self._ids)
        short = left.sum() < max(self.start.restart * self._size, 2 * float(self.settings.minimum))
        if short and self.base is Base.PAPER:
            report = self._consecutive(frame, dt)
            if report is not None:
                return report
        report = self._advance(frame, dt)
        if short and self.base is Base.INHERIT and int(report.status) == Status.TRACKING:
            self._inherit()
        return report

    def _advance(self, frame: Frame, dt: float) -> Report:
        fresh = frame.fresh | (frame.ids != self._ids)
        over = np.asarray(self.state.inside) & (fresh | ~frame.visible)
        self._structure.end(self.state.structure, over, self._ids)
        self.state, report = _segment_step(
            self.settings, self.state, frame.u, frame.visible, fresh, dt, quality=frame.quality
        )
        self._history.append((frame, report.pose, report.covariance))
        return report

    def _consecutive(self, frame: Frame, dt: float) -> Report | None:
        """The paper's restart: two consecutive frames, `overlap` frames back, the scale from common points."""
        known = [*self._history][-self.start.overlap :]
        first, pose1, covariance1 = known[0]
        frames = [k[0] for k in known[1:]] + [frame]
        second = frames[0]
        found = find(self.settings, self.start, [first, second]).found
        if found is None:
            return None  # go on with the old pair as long as it lasts
        arrays = jnp.asarray(first.u), jnp.asarray(second.u)
        common = jnp.asarray(first.common(second) & (first.ids == self._ids))
        pair = segments.Pair(*arrays, common, pose1, covariance1)
        view, placement, count = _consecutive(self.settings, self.state, pair, found.pose)
        if count < 3:
            return None
        self._end()
        self._begin(first, second, view, placement)
        self.begun.append(Restart(first.index, second.index, frame.index - 1, found.pose, found.inside))
        self.keyframes += 2
        report = _second_report(self.state)
        self._history = deque(known[:1], maxlen=40)
        self._history.append((second, report.pose, report.covariance))
        for later in frames[1:]:
            report = self._advance(later, dt)
        return report

    def _inherit(self) -> None:
        """A new pair from two frames already tracked: the present one and the best of those before it."""
        *earlier, (now, pose, _) = self._history
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
        refined, placement = _inherited(self.settings, self.state, segments.Pair(*arrays, other, covariance))
        if not bool(refined.converged):
            return
        self._end()
        self._begin(frame, now, refined, placement)
        self.begun.append(Restart(frame.index, now.index, now.index, refined, frame.common(now)))
        self.keyframes += 1

    def ended(self) -> Points:
        """The points of tracks that have ended since the last call."""
        return self._structure.ended()

    def present(self) -> Points:
        """The points of the pair's tracks that are followed now."""
        return self._structure.of(self.state.structure, np.asarray(self.state.inside), self._ids)


def _parallax(a: np.ndarray, b: np.ndarray, R: np.ndarray) -> float:
    x = np.c_[a, np.ones(len(a))] @ R.T
    y = np.c_[b, np.ones(len(b))]
    return float(np.median(np.arctan2(np.linalg.norm(np.cross(x, y), axis=1), (x * y).sum(axis=1))))
