"""A camera's trajectory from feature tracks, on the host: waiting for parallax, starting, following, restarting.

The arithmetic of a frame is jitted and stands elsewhere; what happens rarely, and needs a decision, is here.
"""

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

from jaxtri.bases import (
    Base,
    Follower,
    Frame,
    Points,
    Restart,
    SinglePair,
    StartSettings,
    TrackPairs,
    fill,
    find,
    hold,
    no_points,
)
from jaxtri.errors import InitialisationError, InputError
from jaxtri.estimation.two_view import scaled
from jaxtri.geometry.camera import Camera
from jaxtri.replay import Recording
from jaxtri.tracker import Report, Settings, Status
from jaxtri.trajectory import Trajectory
from jaxtri.vision.klt import FrameTracks


@dataclass
class FramePose:
    """One frame of the result.

    `T_camera_world` (4, 4) and `covariance` (6, 6) of its error exp(xi) T, (linear, angular) in camera axes;
    both None where there is no pose. `used` points agreed; `nis` is their normalised innovation squared.
    """

    time: float
    status: Status
    T_camera_world: np.ndarray | None = None
    covariance: np.ndarray | None = None
    used: int = 0
    nis: float = float("nan")

    def scaled(self, scale: float) -> "FramePose":
        """The pose in other units of length."""
        if self.T_camera_world is None or self.covariance is None:
            return self
        T, s = self.T_camera_world.copy(), np.repeat([scale, 1.0], 3)
        T[:3, 3] *= scale
        return replace(self, T_camera_world=T, covariance=self.covariance * np.outer(s, s))


class _Begun(NamedTuple):
    """A start: its base pair, the filter that goes on from it, and the poses of the frames that waited for it."""

    pair: Restart
    follower: Follower
    poses: dict[int, FramePose]


CATCH_UP = 2  # frames taken in for each that comes, where some came while a start was worked out
_normalise = jax.jit(lambda camera, pixels: camera.to_normalised(pixels))
_as_matrix = jax.jit(SE3.as_matrix)


def _matrix(pose: SE3) -> np.ndarray:
    return np.asarray(_as_matrix(pose), np.float64)


@dataclass
class Odometry:
    """Feeds feature tracks, frame by frame, to the recursive filters and collects what they say.

    `add` takes the frames in order and returns the tracks to give up. While the camera has not moved enough
    the frames wait with the status INITIALISING; they are filled in when the first base pair stands. After a
    complete loss a new start follows, whose scale is unknown: it is set so that the scene is as deep as it
    was, and `scale_unknown_from` names the frame from which this is a guess.

    A start takes as long as many frames, so it is worked out by a thread while the next `StartSettings.lag`
    frames queue up; what comes out of given tracks does not depend on that. `finish` takes in what is queued.
    """

    camera: Camera
    settings: Settings | None = None
    base: Base = Base.TRACKS
    start: StartSettings | None = None
    frame_time: float | None = None  # seconds of one frame; the first interval by default
    record: bool = False  # keep the tracks, for `recording`

    poses: list[FramePose] = field(default_factory=list, init=False)
    base_pair: tuple[int, int] | None = field(default=None, init=False)  # frames of the first start
    segments: int = field(default=0, init=False)  # starts: more than one means that the camera was lost
    scale_unknown_from: int | None = field(default=None, init=False)
    reason: str = field(default="no frames yet", init=False)  # why there is no start yet

    def __post_init__(self) -> None:
        if self.camera.width is None:
            raise InputError("the camera has no image width: set it, the thresholds of the tracker scale with it")
        self._settings = self.settings or Settings.of(self.camera)
        self._start = self.start or StartSettings.of(self.base)
        self._waiting: list[Frame] = []  # frames that may still become a base pair
        self._passed: list[Frame] = []  # frames that no longer can
        self._queue: deque[Frame] = deque()  # frames that are not taken in yet
        self._search: Future[_Begun | str] | None = None  # of a base pair: the first and the last of those waiting
        self._follower: Follower | None = None
        self._points: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._tried = (-1, 0.0)
        self._depth = 1.0
        self._changes = 0
        self._recording = self.record  # up to where the camera is lost
        self._tracks: list[FrameTracks] = []
        self._began: tuple[Restart, Follower] | None = None  # the first base pair, and what followed it

    def add(self, tracks: FrameTracks, time: float) -> np.ndarray:
        """Take one frame; returns the mask (n,) of the tracks that the filter has found to be outliers.

        `tracks` hold pixels in slots; entries that are not visible, or not finite, count nothing. Raises
        `InputError` where the time does not increase.
        """
        index = len(self.poses)
        if self.poses and not time > self.poses[-1].time:
            raise InputError(f"frame {index}: its time {time} does not follow {self.poses[-1].time}")
        if self.frame_time is None and self.poses:
            self.frame_time = time - self.poses[-1].time
        frame = self._frame(index, tracks, time)
        if self._recording:
            self._tracks.append(tracks._replace(visible=frame.visible))
        self.poses.append(FramePose(time, Status.LOST if self.segments else Status.INITIALISING))
        self._queue.append(frame)
        return np.isin(frame.ids, self._take_in(index, CATCH_UP))

    def finish(self) -> None:
        """Take in the frames that came while a start was worked out, which is waited for."""
        self._take_in(math.inf, math.inf)

    def _take_in(self, newest: float, most: float) -> np.ndarray:
        """Up to `most` queued frames, in order, but none before a start is there; the numbers of tracks to give up."""
        outliers: list[np.ndarray] = []
        while True:
            if self._search is not None:
                if newest < self._waiting[-1].index + self._start.lag:
                    break
                self._settle(self._search)
            if not self._queue or len(outliers) >= most:
                break
            frame = self._queue.popleft()
            if self._follower is None:
                self._waiting.append(frame)
                self._try_start()
                continue
            report = self._follower.follow(frame, self._dt(frame.index))
            self.poses[frame.index] = _pose(frame, report)
            outliers.append(frame.ids[np.asarray(report.drop)])
            if self.poses[frame.index].status is Status.LOST:
                self._lose(frame)
        return np.concatenate(outliers or [np.zeros(0, np.int64)])

    @property
    def status(self) -> Status:
        """Status of the newest frame."""
        return self.poses[-1].status if self.poses else Status.INITIALISING

    @property
    def keyframes(self) -> int:
        """Base frames kept since the last start."""
        return 0 if self._follower is None else self._follower.keyframes

    @property
    def changes(self) -> int:
        """How often the single pair was replaced (inherit, paper)."""
        return self._changes + (0 if self._follower is None else len(self._follower.begun))

    def trajectory(self) -> Trajectory:
        """The trajectory so far, camera to world; a frame without a pose repeats its neighbour's, by its status.

        Raises `InitialisationError`, with the reason, where no frame has a pose.
        """
        self.finish()
        known = [i for i, p in enumerate(self.poses) if p.T_camera_world is not None]
        if not known:
            raise InitialisationError(
                f"no camera motion was found in {len(self.poses)} frames: {self.reason}. A camera that stands still "
                "or only turns shows no parallax: give a longer sequence with sideways motion, or ask for less "
                "parallax"
            )
        nearest = [known[int(np.argmin(np.abs(np.array(known) - i)))] for i in range(len(self.poses))]
        T = np.stack([self.poses[i].T_camera_world for i in nearest])  # pyright: ignore[reportArgumentType, reportCallIssue]
        C = np.stack([self.poses[i].covariance for i in nearest])  # pyright: ignore[reportArgumentType, reportCallIssue]
        R = np.swapaxes(T[:, :3, :3], 1, 2)
        world = np.tile(np.eye(4), (len(T), 1, 1))
        world[:, :3, :3] = R
        world[:, :3, 3] = 0.0 - np.einsum("tij,tj->ti", R, T[:, :3, 3])
        # exp(xi) T_camera_world moves the centre by -R' rho and turns R_world_camera by exp(-theta) on the right.
        J = np.zeros((len(T), 6, 6))
        J[:, :3, :3] = -R
        J[:, 3:, 3:] = -np.eye(3)
        times = np.array([p.time for p in self.poses])
        status = np.array([int(p.status) for p in self.poses])
        return Trajectory(times, world, J @ C @ np.swapaxes(J, 1, 2), status)

    def points(self) -> Points:
        """The points of all tracks so far, in the world frame, each as it was last known."""
        self.finish()
        if self._follower is not None:
            _keep(self._points, self._follower.ended())
        known = self._points.copy()
        if self._follower is not None:
            _keep(known, self._follower.present())
        if not known:
            return no_points()
        ids = np.array(sorted(known))
        xyz, covariance = (np.stack([known[i][k] for i in ids]) for k in (0, 1))
        return Points(ids, xyz, covariance)

    def recording(self) -> Recording:
        """The tracks and base pairs so far, up to where the camera is lost, for `jaxtri.replay`.

        Raises `InputError` where `record` is off, `InitialisationError` where there is no start yet.
        """
        if not self.record:
            raise InputError("nothing was recorded: ask for it by record=True")
        self.finish()
        if self._began is None:
            raise InitialisationError(f"no camera motion was found in {len(self.poses)} frames: {self.reason}")
        start, follower = self._began
        origin, dtype = start.first, self._settings.sigma.dtype
        kept, pairs = self._tracks[origin:], [start, *follower.begun]
        ends = [*(p.last for p in pairs[1:]), origin + len(kept) - 1]
        measured = [np.arange(p.second + 1, end + 1) - origin for p, end in zip(pairs, ends, strict=True)]
        frames = np.full((len(pairs), max(1, *map(len, measured))), -1)
        for row, those in zip(frames, measured, strict=True):
            row[: len(those)] = those
        visible = np.stack([t.visible for t in kept])
        pixels = np.where(visible[..., None], np.stack([t.pixels for t in kept]), 0.0)
        quality = np.stack([np.stack([t.error, t.eigenvalue], axis=1) for t in kept])
        return Recording(
            jnp.asarray(pixels, dtype),
            jnp.asarray(visible),
            jnp.asarray(np.stack([t.ids for t in kept])),
            jnp.asarray(quality, dtype),
            jnp.asarray([self._dt(origin + k) for k in range(len(kept))], dtype),
            jnp.asarray([p.first - origin for p in pairs]),
            jnp.asarray([p.second - origin for p in pairs]),
            jnp.asarray(frames),
            jnp.stack([p.found.translation for p in pairs]),
            SO3(jnp.stack([p.found.rotation.wxyz for p in pairs])),
            jnp.asarray(np.stack([p.inside for p in pairs])),
            inherit=self.base is Base.INHERIT,
        )

    def _frame(self, index: int, tracks: FrameTracks, time: float) -> Frame:
        visible = np.asarray(tracks.visible, bool) & np.isfinite(tracks.pixels).all(axis=1)
        pixels = np.where(visible[:, None], tracks.pixels, 0.0).astype(self._settings.sigma.dtype)
        u = np.asarray(_normalise(self.camera, pixels))
        visible &= np.isfinite(u).all(axis=1)
        fresh = np.asarray(tracks.fresh, bool) & visible
        quality = np.stack([tracks.error, tracks.eigenvalue], axis=1).astype(u.dtype)
        return Frame(index, time, u, visible, fresh, np.array(tracks.ids), quality)

    def _dt(self, index: int) -> float:
        if index == 0 or not self.frame_time:
            return 1.0
        return (self.poses[index].time - self.poses[index - 1].time) / self.frame_time

    # -- starting ---------------------------------------------------------------------------------------------

    def _try_start(self) -> None:
        """Look for a base pair between the first waiting frame and the newest."""
        now = self._waiting[-1]
        while len(self._waiting) > 1:
            first = self._waiting[0]
            common = first.common(now)
            if common.sum() >= max(self._start.points, self._start.common * first.visible.sum()):
                break
            # Too little is left of the first frame: wait from a later one.
            self._passed.append(self._waiting.pop(0))
        if len(self._waiting) < 2:
            self.reason = f"only {int(now.visible.sum())} features in frame {now.index}, and fewer last"
            return
        first, common = self._waiting[0], self._waiting[0].common(now)
        width = (self.camera.width or 0) / float(jnp.sqrt(self.camera.fx * self.camera.fy))
        flow = float(np.median(np.linalg.norm(now.u[common] - first.u[common], axis=1))) / width
        if flow < self._start.flow:
            self.reason = f"the median flow is {flow:.1%} of the image width, {self._start.flow:.1%} needed"
            return
        tried, before = self._tried
        if tried == first.index and flow < 1.1 * before:
            return
        self._tried = (first.index, flow)
        # What a `with` has set in JAX holds for the thread that says so alone.
        x64, device = jax.enable_x64.value, jax.default_device.value

        def begin() -> _Begun | str:
            with jax.enable_x64(x64), jax.default_device(device):
                return self._begin()

        pool = ThreadPoolExecutor(1, thread_name_prefix="start")
        self._search = pool.submit(begin)
        pool.shutdown(wait=False)

    def _settle(self, search: Future[_Begun | str]) -> None:
        """Go on from a start that was worked out beside, or without one."""
        self._search = None
        begun = search.result()
        if isinstance(begun, str):
            self.reason = begun
            return
        for index, pose in begun.poses.items():
            self.poses[index] = pose
        if self.segments == 0:
            self._began = begun.pair, begun.follower
            self.base_pair = begun.pair.first, begun.pair.second
        elif self.scale_unknown_from is None:
            self.scale_unknown_from = begun.pair.first
        self._follower = begun.follower
        self.segments += 1
        self._waiting, self._passed = [], []

    def _begin(self) -> _Begun | str:
        """The filter from a base pair of waiting frames, those between and before filled in; or why it has to wait.

        Other frames are queued meanwhile, so it only reads, and only what they do not change.
        """
        frames = self._waiting
        searched = find(self._settings, self._start, frames)
        if searched.found is None:
            return searched.reason
        pose = searched.found.pose
        first, last = frames[0], frames[-1]
        again = self.segments > 0
        world = jax.tree.map(lambda x: x.astype(pose.translation.dtype), SE3.identity())
        if again:
            held = [p.T_camera_world for p in self.poses if p.T_camera_world is not None][-1]
            world = SE3.from_matrix(jnp.asarray(held, pose.translation.dtype))
            state, _ = fill(self._settings, [first, last], pose, world, [1.0])
            pose = scaled(pose, self._depth / float(state.depth))  # the scene as deep as it was: a guess
        state, reports = fill(self._settings, frames, pose, world, [self._dt(f.index) for f in frames[1:]])
        status = Status.RESTARTED if again else Status.TRACKING
        poses = {first.index: FramePose(first.time, status, _matrix(world), np.zeros((6, 6)))}
        poses |= {f.index: _pose(f, report) for f, report in [*reports, *self._backwards(first, state, world)]}
        if self.base is Base.TRACKS:
            follower: Follower = TrackPairs(self._settings, state, last, first.common(last))
        else:
            follower = SinglePair(self._settings, self._start, self.base, frames, pose, world)
        pair = Restart(first.index, last.index, first.index, searched.found.pose, searched.found.inside)
        return _Begun(pair, follower, poses)

    def _backwards(self, first: Frame, state, world: SE3) -> Iterator[tuple[Frame, Report]]:
        """Frames that waited before the first base frame, newest first, as far as its tracks reach."""
        mean = eqx.tree_at(
            lambda m: (m.pose, m.twist), state.belief.mean, (world, jnp.zeros_like(state.belief.mean.twist))
        )
        state = state._replace(belief=eqx.tree_at(lambda b: b.mean, state.belief, mean))
        for frame in reversed(self._passed):
            state, report = hold(self._settings, state, frame, first.common(frame), 1.0)
            if int(report.status) != Status.TRACKING:
                return
            yield frame, report

    def _lose(self, frame: Frame) -> None:
        """The camera is lost: start again from here."""
        assert self._follower is not None
        self._changes += len(self._follower.begun)
        if self._recording:
            del self._tracks[frame.index + 1 :]
        self._recording = False
        for queued in self._queue:
            self.poses[queued.index].status = Status.LOST
        self._depth = self._follower.depth
        for points in (self._follower.ended(), self._follower.present()):
            _keep(self._points, points)
        self._follower = None
        self._waiting, self._tried = [frame], (-1, 0.0)
        self.reason = "too few points agreed with any motion"


def _pose(frame: Frame, report: Report) -> FramePose:
    said = report.diagnostics
    covariance = np.asarray(report.covariance, np.float64)
    return FramePose(
        frame.time, Status(int(report.status)), _matrix(report.pose), covariance, int(said.used), float(said.nis)
    )


def _keep(known: dict[int, tuple[np.ndarray, np.ndarray]], points: Points) -> None:
    # A track that two segments share is kept as the more exact of the two knows it.
    for i, x, c in zip(*points, strict=True):
        if int(i) not in known or np.trace(c) < np.trace(known[int(i)][1]):
            known[int(i)] = (x, c)
