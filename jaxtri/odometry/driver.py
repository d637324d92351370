"""A camera's trajectory from feature tracks, on the host: waiting for parallax, starting, following, starting anew.

The arithmetic of a frame is jitted and stands elsewhere; what happens rarely, and needs a decision, is here.
"""

import math
from concurrent.futures import Future
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from jaxtri.checks import ArrayOrList, image_noise
from jaxtri.compilation import capacity
from jaxtri.errors import InitialisationError, InputError
from jaxtri.formats.archive import Archived
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.zoom_curve import ZoomCurve, camera_at
from jaxtri.odometry.beginning import Before, Begun, begin
from jaxtri.odometry.beside import beside
from jaxtri.odometry.followers import Follower
from jaxtri.odometry.observing import Rows, at_frame_times, observed
from jaxtri.odometry.places import Found, Places, mark_apart
from jaxtri.odometry.poses import FramePose, trajectory
from jaxtri.odometry.recorder import Recorder
from jaxtri.odometry.replay import Recording
from jaxtri.odometry.settings import Base, Settings, StartSettings, Status
from jaxtri.odometry.slots import Slotted
from jaxtri.odometry.start import BasePair, Observations, Start, Way, short_lived, too_slow
from jaxtri.odometry.structure import Points, gathered, keep
from jaxtri.trajectory import Trajectory
from jaxtri.vision.places import Returns

CATCH_UP = 2  # frames taken in for each that comes, where some came while a start was worked out
AGAIN = 1.1  # flow, over that of the last attempt, from which a start from the same first frame is tried again


@dataclass
class Odometry(Archived):
    """Feeds feature tracks, frame by frame, to the recursive filters and collects what they say.

    `add` takes the frames in order and returns the tracks to give up. While the camera has not moved enough
    the frames wait with the status INITIALISING; they are filled in when the first base pair stands. After a
    complete loss a new start follows, whose scale is unknown: it is set so that the scene is as deep as it
    was, and `scale_unknown_from` names the frame from which this is a guess.

    A start takes as long as many frames, so it is worked out by a thread while the next `StartSettings.lag`
    frames queue up; what comes out of given tracks does not depend on that. `finish` takes in what is queued.
    `save` and `load` keep all of it in a file, also while a start is being worked out, and go on as if never stopped.

    Attributes:
        camera: Intrinsics, with the width of the image in pixels.
        settings: What the filters may tune; `Settings.of(camera)` by default.
        base: Which two base frames a track is measured from; a `Base` or its name.
        start: When a base pair is good enough; `StartSettings.of(base)` by default.
        frame_time: Seconds of one frame, the unit of time of the filters; the first interval by default.
        zoom: How the focal length changes on the way, where it does.
        record: Keep the tracks, for `recording` and `jaxtri.refine`.
        capacity: Most tracks that are followed at once; by default the least of 64, 128, 256, ... that holds the rows
            of the first frame. Filters are compiled once for each.
        poses: One `FramePose` a frame.
        base_pair: Frames of the first start, None before it.
        starts: Starts so far; more than one means that the camera was lost.
        scale_unknown_from: Frame from which the scale is a guess, None where there is none.
        reason: Why there is no start yet.
        found: Where the camera was found again after it was lost.
    """

    camera: Camera
    settings: Settings | None = None
    base: Base | str = Base.TRACKS
    start: StartSettings | None = None
    frame_time: float | None = None
    zoom: ZoomCurve | None = None
    record: bool = False
    capacity: int | None = None

    poses: list[FramePose] = field(default_factory=list, init=False)
    base_pair: tuple[int, int] | None = field(default=None, init=False)
    starts: int = field(default=0, init=False)
    scale_unknown_from: int | None = field(default=None, init=False)
    reason: str = field(default="no frames yet", init=False)
    found: list[Found] = field(default_factory=list, init=False)

    _held: np.ndarray | None = field(default=None, init=False, repr=False)  # (capacity,) tracks in the slots
    _waiting: list[Observations] = field(default_factory=list, init=False, repr=False)  # may still become a base pair
    _passed: list[Observations] = field(default_factory=list, init=False, repr=False)  # no longer can
    _queue: list[Observations] = field(default_factory=list, init=False, repr=False)  # are not taken in yet
    _seeking: bool = field(default=False, init=False, repr=False)  # a base pair: the first and last of those waiting
    _search: Future[Begun | Start] | None = field(default=None, init=False, repr=False, metadata={"saved": False})
    _follower: Follower | None = field(default=None, init=False, repr=False)
    _points: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)
    _way: Way | None = field(default=None, init=False, repr=False)
    _tried: tuple[int, float] = field(default=(-1, 0.0), init=False, repr=False)  # first frame and flow of an attempt
    _depth: float = field(default=1.0, init=False, repr=False)
    _changes: int = field(default=0, init=False, repr=False)
    _world: int = field(default=0, init=False, repr=False)  # number of the start that the filter goes back to
    _places: Places = field(default_factory=Places, init=False, repr=False)
    _recorder: Recorder = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.camera.width is None:
            raise InputError("the camera has no image width: set it, the thresholds of the tracker scale with it")
        if self.capacity is not None and self.capacity < 1:
            raise InputError(f"capacity is {self.capacity}; give the most tracks that are followed at once, or None")
        self.base = Base(self.base)
        self.settings = self.settings or Settings.of(self.camera)
        image_noise("settings.sigma", self._settings.sigma)
        self.start = self.start or StartSettings.of(self.base)
        self._recorder = Recorder(self.record)

    def __getstate__(self) -> dict:
        # A thread cannot be kept: what it works out is begun again, with the same outcome.
        return self.__dict__ | {"_search": None}

    @property
    def _settings(self) -> Settings:
        assert self.settings is not None
        return self.settings

    @property
    def _start(self) -> StartSettings:
        assert self.start is not None
        return self.start

    def add(
        self,
        pixels: ArrayOrList,
        visible: ArrayOrList,
        time: float,
        *,
        ids: ArrayOrList | None = None,
        quality: ArrayOrList | None = None,
        returns: Returns | None = None,
    ) -> np.ndarray:
        """Take one frame; returns the mask (n,) of the tracks that the filter has found to be outliers.

        `pixels` (n, 2) are image points, `visible` (n,) says which rows hold one; what is not finite is not visible.
        `ids` (n,) are the numbers of the tracks, not negative: rows may come in any order and number. Without, a row
        is a track in every frame. `time` is in seconds. `quality` (n, 2) are the forward-backward errors in
        pixels and the smaller eigenvalues of the patches, for `Settings.point_noise`. `returns` says which tracks are
        earlier ones that had ended, as `FrameTracks.returns` has it: by it the camera is found again where it was lost.

        Raises `InputError`, and takes nothing, where an array has another shape, the time does not increase, two
        visible rows have one number, or there are more of them than `capacity`.
        """
        index = len(self.poses)
        rows, before = Rows.of(pixels, visible, ids, quality, returns), self.poses[-1].time if index else None
        held = np.full(self.capacity or capacity(len(rows.ids)), -1) if self._held is None else self._held
        unit = self.frame_time or (1.0 if before is None else time - before)
        camera, dtype = self.camera_at(time), self._settings.sigma.dtype
        frame, tracks = observed(index, time, before, rows, held, camera, unit, dtype)
        if self.frame_time is None and before is not None:
            self.frame_time, self._waiting = unit, [f.in_frames(unit) for f in self._waiting]
        self._held, self.capacity = tracks.ids, len(held)
        self._recorder.take(tracks, rows.returns)
        lost = self.starts > 0 and self._follower is None  # else it only waits for its turn
        self.poses.append(FramePose(frame.time, Status.LOST if lost else Status.INITIALISING))
        self._queue.append(frame)
        return np.isin(rows.ids, self._take_in(index, CATCH_UP))

    def camera_at(self, time_s: float) -> Camera:
        """The camera, with the focal length that it has at a time."""
        return camera_at(self.camera, self.zoom, time_s)

    def cut(self, frame: int) -> None:
        """Another shot begins with the frame that comes next; since `frame` there was none that could be followed.

        Poses from there on are taken back: `LOST`, or `INITIALISING` where no start came before. What comes next starts
        anew with a scale that is not known. `KLT` says when: `FrameTracks.dissolved`. Raises `InputError` where there
        is no such frame yet.
        """
        if not 0 <= frame <= len(self.poses):
            raise InputError(f"cut: frame {frame} of {len(self.poses)}; give one of those so far, or the next")
        self.finish()
        begun = self._leave(present=False)
        if self.starts:
            self._recorder.stop(frame - 1, begun)
        if self.base_pair is not None and self.base_pair[0] >= frame:
            self._recorder.pairs, self._recorder.lost = [], None
            self.base_pair, self.starts, frame = None, 0, 0
        if self.scale_unknown_from is not None and self.scale_unknown_from >= frame:
            self.scale_unknown_from = None
        self._places.forget(frame)
        self.found = [again for again in self.found if again.frame < frame]
        status = Status.LOST if self.starts else Status.INITIALISING
        self.poses[frame:] = [FramePose(p.time, status) for p in self.poses[frame:]]
        self._waiting, self._passed, self._tried = [], [], (-1, 0.0)
        self.reason = "one shot dissolves into another"

    def finish(self) -> None:
        """Take in the frames that came while a start was worked out, which is waited for."""
        self._take_in(math.inf, math.inf)

    @property
    def latest(self) -> FramePose | None:
        """The newest frame that has been taken in, with its pose, covariance and status; None before the first.

        It is the frame given last, but for the `StartSettings.lag` frames after a start was begun, which queue up.
        """
        decided = len(self.poses) - len(self._queue)
        return self.poses[decided - 1] if decided else None

    @property
    def lost(self) -> bool:
        """Whether the camera was followed, and the newest frame that has been taken in shows nothing that was known."""
        return self.starts > 0 and (self._follower is None or not (self.latest or self.poses[0]).status.measured)

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
        return trajectory(self.poses, self.reason)

    def points(self) -> Points:
        """The points of all tracks so far, in the world frame, each as it was last known."""
        self.finish()
        if self._follower is None:
            return gathered(self._points)
        keep(self._points, self._follower.ended())
        return gathered(self._points, self._follower.present())

    def recording(self) -> Recording:
        """The tracks and base pairs so far, up to where the camera is lost, for `jaxtri.replay`.

        Raises `InputError` where `record` is off, or the camera zooms or rolls; `InitialisationError` without a start.
        """
        if not self.record:
            raise InputError("nothing was recorded: ask for it by record=True")
        if self.zoom is not None or self.camera.readout is not None:
            raise InputError(
                "the camera zooms, or its shutter rolls: a replay takes one focal length and one time a frame"
            )
        self.finish()
        if not self._recorder.pairs:
            raise InitialisationError(f"no camera motion was found in {len(self.poses)} frames: {self.reason}")
        begun = self._follower.begun if self._recorder.lost is None and self._follower is not None else []
        inherit = self.base is Base.INHERIT
        return self._recorder.recording(begun, self._dt, inherit=inherit, dtype=self._settings.sigma.dtype)

    @property
    def tracks(self) -> list[Slotted]:
        """The tracks of all frames so far, where `record` is on; a rolling shutter is taken out of them."""
        return self._recorder.steady(self.camera, self.frame_time or 1.0)

    @property
    def returns(self) -> dict[int, Returns]:
        """Tracks of earlier frames that were found again, by frame, where `record` is on."""
        return self._recorder.returns

    def _dt(self, index: int) -> float:
        passed = self.poses[index].time - self.poses[index - 1].time
        return passed / self.frame_time if index and self.frame_time else 1.0

    def _take_in(self, newest: float, most: float) -> np.ndarray:
        """Up to `most` queued frames, in order, but none before a start is there; the numbers of tracks to give up."""
        outliers: list[np.ndarray] = []
        # A place that is seen again is better than a start, which need not be waited for.
        if self._seeking and self._queue[-1:] and self._queue[-1].index == newest and self._find_again(self._queue[-1]):
            self._queue.clear()
        while True:
            if self._seeking:
                search = self._search = self._search or beside(self._begin, "start")
                if newest < self._waiting[-1].index + self._start.lag:
                    break
                self._settle(search.result())
            if not self._queue or len(outliers) >= most:
                break
            frame = self._queue.pop(0)
            if self._follower is None:
                if not self._find_again(frame):
                    self._waiting.append(frame)
                    self._try_start()
                continue
            before = copy(self._follower)
            report = self._follower.follow(frame, self._dt(frame.index))
            pose = self.poses[frame.index] = FramePose.of(frame.time, report, self._world)
            if not pose.status.measured and self.poses[frame.index - 1].status.measured:
                self._places.see(frame.index - 1, self._world, before, last=True)
            if self._find_again(frame):
                continue
            if pose.status is Status.TRACKING:
                self._places.see(frame.index, self._world, self._follower)
            self._recorder.judge(frame.index, np.asarray(report.moving))
            outliers.append(frame.ids[np.asarray(report.drop)])
            if pose.status is Status.LOST:
                self._lose(frame)
        return np.concatenate(outliers or [np.zeros(0, np.int64)])

    def _try_start(self) -> None:
        """Look for a base pair between the first waiting frame and the newest."""
        now = gone = self._waiting[-1]
        while len(self._waiting) > 1:
            first = self._waiting[0]
            common = first.common(now)
            if common.sum() >= max(self._start.points, self._start.common * first.visible.sum()):
                break
            # Too little is left of the first frame: wait from a later one.
            gone = self._waiting.pop(0)
            self._passed.append(gone)
        if len(self._waiting) < 2:
            self.reason = short_lived(self._start, gone, now)
            return
        first, width = self._waiting[0], (self.camera.width or 0) / float(self.camera.focal)
        self._way = Way.of(self._waiting, self._way)
        flow = self._way.flow / width
        tried, before = self._tried
        if flow < self._start.flow:
            self.reason = self.reason if tried == first.index else too_slow(self._start, flow, first)
            return
        if tried != first.index or flow >= AGAIN * before:
            self._tried, self._seeking = (first.index, flow), True

    def _settle(self, begun: Begun | Start) -> None:
        """Go on from a start that was worked out beside, or without one."""
        self._search, self._seeking = None, False
        if isinstance(begun, Start):
            self.reason = begun.reason
            if begun.over:
                *gone, last = self._waiting
                self._tried, self._passed, self._waiting = (last.index, 0.0), self._passed + gone, [last]
            return
        for index, pose in begun.poses.items():
            self.poses[index] = pose
        if self.starts == 0:
            self._recorder.pairs = [begun.pair]
            self.base_pair = begun.pair.first, begun.pair.second
        elif self.scale_unknown_from is None:
            self.scale_unknown_from = min(begun.poses)
        self._follower, self._world = begun.follower, self.starts
        self.starts += 1
        self._waiting, self._passed = [], []

    def _begin(self) -> Begun | Start:
        """A start from the frames that wait, or why there is none yet.

        Other frames are queued meanwhile, so it only reads, and only what they do not change.
        """
        held = [p.T_camera_world for p in self.poses if p.T_camera_world is not None]
        before = Before(held[-1], self._depth, self.starts) if self.starts else None
        assert isinstance(self.base, Base)
        passed, waiting = (at_frame_times(frames) for frames in (self._passed, self._waiting))
        return begin(self._settings, self._start, self.base, waiting, passed, self._dt, before)

    def _find_again(self, frame: Observations) -> bool:
        """Go on from an earlier place, where the camera is lost or its scale a guess and enough tracks are back."""
        followed = self._follower is not None and self.poses[frame.index].status.measured
        found = self._places.find(self._settings, frame, self._start.points, self._world if followed else self.starts)
        if found is None:
            return False
        place, follower, report = found
        self._recorder.stop(frame.index, self._leave(present=True))
        since = mark_apart(self.poses[: frame.index], place.start, frame.index)
        if self.scale_unknown_from is not None and self.scale_unknown_from >= since:
            self.scale_unknown_from = None
        self.poses[frame.index] = replace(FramePose.of(frame.time, report, place.start), status=Status.FOUND)
        self.found.append(Found(frame.index, place.frame, since, int(report.diagnostics.used)))
        self._follower, self._world = follower, place.start
        self._search, self._seeking = None, False
        self._waiting, self._passed, self._tried = [], [], (-1, 0.0)
        return True

    def _lose(self, frame: Observations) -> None:
        """The camera is lost: start again from here."""
        self._recorder.stop(frame.index, self._leave(present=True))
        for queued in self._queue:
            self.poses[queued.index].status = Status.LOST
        self._waiting, self._tried = [frame], (-1, 0.0)
        self.reason = "too few points agreed with any motion"

    def _leave(self, *, present: bool) -> list[BasePair]:
        """The end of a filter, if there is one: its later base pairs; its points are kept, those at `present` too."""
        follower, self._follower = self._follower, None
        if follower is None:
            return []
        self._changes += len(follower.begun)
        self._depth = follower.depth
        keep(self._points, follower.ended())
        if present:
            keep(self._points, follower.present())
        return follower.begun
