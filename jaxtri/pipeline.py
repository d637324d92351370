"""From frames to a trajectory: feature tracking, the recursive filter, and what is worth keeping of both."""

import contextlib
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from tqdm import tqdm

from jaxtri.bases import Base, Points, StartSettings
from jaxtri.errors import CameraError, InputError
from jaxtri.geometry.camera import Camera
from jaxtri.odometry import Odometry
from jaxtri.tracker import Settings, Status
from jaxtri.trajectory import Trajectory
from jaxtri.vision.klt import KLT, FrameTracks, KLTSettings
from jaxtri.vision.video import Frame, FrameSource, ahead


@dataclass
class Run:
    """What a sequence gave: the camera's trajectory, the points it was measured from, and figures of the run."""

    trajectory: Trajectory
    points: Points
    colours: np.ndarray  # (n, 3) uint8 RGB of the points
    odometry: Odometry
    statistics: dict[str, object] = field(default_factory=dict)

    def scaled(self, scale: float) -> "Run":
        """The same run in other units of length: trajectory, points and poses multiplied by `scale`."""
        odometry = copy(self.odometry)
        odometry.poses = [p.scaled(scale) for p in self.odometry.poses]
        points = Points(self.points.ids, self.points.xyz * scale, self.points.covariance * scale**2)
        return replace(self, trajectory=odometry.trajectory(), points=points, odometry=odometry)


def track(
    source: Iterable[Frame],
    camera: Camera,
    *,
    base: Base = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    klt: KLTSettings | None = None,
    progress: bool = True,
    max_frames: int | None = None,
    record: bool = False,
) -> Run:
    """Recover the camera's trajectory from the frames of a source, one pass, in order.

    Frames are decoded by a thread of their own, and their features followed by another, while others are filtered.

    With `record` the run can be differentiated: `run.odometry.recording()` and `jaxtri.replay`.
    An interrupt (Ctrl-C) ends the sequence there; what was tracked so far is kept. Raises
    `InitialisationError` where the camera never moved enough, `CameraError` where the frames are not of the
    size the camera was calibrated for, `InputError` on fewer than two frames, and what the source raises.
    """
    follower, tracker = KLT(klt or KLTSettings()), Odometry(camera, settings, base, start, record=record)
    colours: dict[int, np.ndarray] = {}
    seconds = {"waiting for frames": 0.0, "optical flow": 0.0, "filter": 0.0}
    declared = source.declared if isinstance(source, FrameSource) else None
    bar = tqdm(total=declared, unit="frame", disable=None if progress else True, leave=False)
    interrupted = False
    milliseconds: list[float] = []
    began = clock = time.perf_counter()

    def follow(image: np.ndarray) -> FrameTracks:
        begun = time.perf_counter()
        tracks = follower.track(image)
        seconds["optical flow"] += time.perf_counter() - begun
        return tracks

    try:
        # A frame is filtered while the next one is followed already. What the filter gives up of it the next one shows
        # no more, and its slots are free from the one after that on: the same whichever of the two is faster.
        with contextlib.closing(ahead(islice(source, max_frames))) as frames, ThreadPoolExecutor(1) as pool:

            def following() -> tuple[Frame, Future[FrameTracks]] | None:
                begun = time.perf_counter()
                frame = next(frames, None)
                seconds["waiting for frames"] += time.perf_counter() - begun
                if frame is None:
                    return None
                _same_size(camera, frame)
                return frame, pool.submit(follow, frame.image)

            outliers, now = np.zeros(0, np.int64), following()
            while now is not None:
                frame, tracks = now[0], now[1].result()
                follower.drop(outliers)
                now = following()
                begun = time.perf_counter()
                tracks = tracks._replace(visible=tracks.visible & ~np.isin(tracks.ids, outliers))
                _sample(colours, tracks, frame.image)
                outliers = tracks.ids[tracker.add(tracks, frame.time_s)]
                seconds["filter"] += time.perf_counter() - begun
                bar.set_postfix_str(f"{tracker.status.name.lower()}, {tracker.poses[-1].used} points", refresh=False)
                bar.update()
                milliseconds.append(1e3 * (time.perf_counter() - clock))
                clock = time.perf_counter()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    if len(tracker.poses) < 2:
        raise InputError(f"{len(tracker.poses)} frame: a camera's motion needs at least two")
    trajectory, points = tracker.trajectory(), tracker.points()
    grey = np.full(3, 128, np.uint8)
    statistics = _statistics(tracker) | {
        "frames_per_second": len(tracker.poses) / (time.perf_counter() - began),
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
        "milliseconds_of_frame": [round(m, 2) for m in milliseconds],
        "interrupted": interrupted,
    }
    rgb = np.array([colours.get(int(i), grey) for i in points.ids], np.uint8).reshape(-1, 3)
    return Run(trajectory, points, rgb, tracker, statistics)


def warm_up(
    camera: Camera,
    *,
    base: Base = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    klt: KLTSettings | None = None,
) -> None:
    """Compile what `track` needs, with the same arguments, by following a few made-up tracks.

    A first run spends most of its time compiling; a camera should not wait for it, and what is rendered or
    read meanwhile need not either.
    """
    n = (klt or KLTSettings()).capacity
    rng = np.random.default_rng(0)
    w, h = camera.width or 2 * float(camera.cx), camera.height or 2 * float(camera.cy)
    pixels = rng.uniform([0.2 * w, 0.2 * h], [0.8 * w, 0.8 * h], (n, 2))
    depth = rng.uniform(1, 2, n)
    everything = np.ones((6, n), bool)
    shift = np.zeros((6, n, 2))
    shift[..., 0] = 0.04 * w * np.arange(6)[:, None] / depth
    odometry = follow_tracks(camera, pixels + shift, everything, base=base, settings=settings, start=start)
    odometry.points()


def follow_tracks(
    camera: Camera,
    pixels: np.ndarray,
    visible: np.ndarray,
    times: np.ndarray | None = None,
    *,
    base: Base = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    record: bool = False,
) -> Odometry:
    """The same from feature tracks: `pixels` (t, n, 2) and `visible` (t, n), a column a track.

    NaN where a track is not seen is as good as False. `times` (t,) in seconds, by default the frame number.
    """
    if pixels.ndim != 3 or pixels.shape[2] != 2 or visible.shape != pixels.shape[:2]:
        raise InputError(f"tracks of shape {pixels.shape} with visible {visible.shape}: give (t, n, 2) and (t, n)")
    times = np.arange(len(pixels), dtype=float) if times is None else times
    odometry = Odometry(camera, settings, base, start, record=record)
    ids, unknown = np.arange(pixels.shape[1]), np.full(pixels.shape[1], np.nan)
    before = np.zeros(pixels.shape[1], bool)
    for t, (z, seen) in enumerate(zip(pixels, visible, strict=True)):
        odometry.add(FrameTracks(z, seen, seen & ~before, ids, unknown, unknown), float(times[t]))
        before = seen
    odometry.finish()
    return odometry


def _same_size(camera: Camera, frame: Frame) -> None:
    h, w = frame.image.shape[:2]
    if camera.width is not None and camera.height is not None and (camera.width, camera.height) != (w, h):
        raise CameraError(
            f"the camera was calibrated at {camera.width}x{camera.height}, the frames are {w}x{h}: give the "
            "calibration of this size, or resize the frames"
        )


def _sample(colours: dict[int, np.ndarray], tracks: FrameTracks, image: np.ndarray) -> None:
    new = np.flatnonzero(tracks.fresh)
    h, w = image.shape[:2]
    x, y = tracks.pixels[new].round().astype(int).clip(0, [w - 1, h - 1]).T
    colours |= dict(zip(tracks.ids[new].tolist(), image[y, x][:, ::-1], strict=True))


def _statistics(odometry: Odometry) -> dict[str, object]:
    status = Counter(p.status.name.lower() for p in odometry.poses)
    used = [p.used for p in odometry.poses if p.status is Status.TRACKING]
    return {
        "frames": len(odometry.poses),
        "status": dict(status),
        "status_of_frame": [p.status.name.lower() for p in odometry.poses],
        "segments": odometry.segments,
        "restarts": odometry.changes,
        "scale_unknown_from_frame": odometry.scale_unknown_from,
        "base_pair": odometry.base_pair,
        "keyframes": odometry.keyframes,
        "points_used_per_frame": float(np.mean(used)) if used else 0.0,
    }
