"""From frames to a trajectory: feature tracking, the recursive filter, and what is worth keeping of both."""

import contextlib
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import islice

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxtri.checks import ArrayOrList, booleans, numbers
from jaxtri.compilation import capacity
from jaxtri.errors import CameraError, InputError, InputWarning
from jaxtri.formats.archive import Archived
from jaxtri.geometry.camera import Camera, same_aspect
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.odometry.calibrate import Calibration
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.poses import FramePose
from jaxtri.odometry.refine import Refinement
from jaxtri.odometry.refine import refine as refine_run
from jaxtri.odometry.settings import Base, Settings, StartSettings
from jaxtri.odometry.structure import Points
from jaxtri.trajectory import Trajectory, angle
from jaxtri.vision.klt import KLT, FrameTracks, KLTSettings
from jaxtri.vision.video import Frame, FrameSource, ahead

MUCH = 0.3  # share of the picture above which what is ignored may be missed


@dataclass
class Run(Archived):
    """What a sequence gave.

    Attributes:
        trajectory: Camera poses, camera to world, one a frame: the best that are known.
        points: The scene, a point a track.
        colours: (n, 3) uint8 RGB of the points.
        odometry: What the filters said of every frame.
        statistics: Figures of the run, as `run.json` has them.
        refined: What came of all frames together, where that was asked for.
        calibration: The camera from its own video, where it was not known (`track_uncalibrated`).
        track_colours: RGB of every track, where it was first seen.
    """

    trajectory: Trajectory
    points: Points
    colours: np.ndarray
    odometry: Odometry
    statistics: dict[str, object] = field(default_factory=dict)
    refined: Refinement | None = None
    calibration: Calibration | None = None
    track_colours: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def poses(self) -> list[FramePose]:
        """Every frame, as it is known best."""
        return self.odometry.poses if self.refined is None else self.refined.poses

    def scaled(self, scale: float) -> "Run":
        """The same run in other units of length: trajectory, points and poses multiplied by `scale`."""
        odometry, refined = copy(self.odometry), self.refined
        odometry.poses = [p.scaled(scale) for p in self.odometry.poses]
        points = Points(self.points.ids, self.points.xyz * scale, self.points.covariance * scale**2)
        if refined is not None:
            refined = replace(refined, poses=[p.scaled(scale) for p in refined.poses], points=points)
        best = odometry if refined is None else refined
        return replace(self, trajectory=best.trajectory(), points=points, odometry=odometry, refined=refined)


def track(
    source: Iterable[Frame],
    camera: Camera,
    *,
    base: Base | str = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    klt: KLTSettings | None = None,
    progress: bool = True,
    max_frames: int | None = None,
    zoom: ZoomCurve | None = None,
    record: bool = False,
    refine: bool = False,
) -> Run:
    """Recover the camera's trajectory from the frames of a source, one pass, in order.

    Frames are decoded by a thread of their own, and their features followed by another, while others are filtered.

    `zoom` is how the focal length changes on the way, where that is known: `jaxtri.calibrate` finds it. With `refine`
    a frame whose focal length is another one than the camera's is called uncertain.

    With `record` the run can be differentiated: `run.odometry.recording()` and `jaxtri.replay`. With `refine` all
    keyframes are adjusted together at the end (`jaxtri.refine`): the trajectory is no longer causal, and about .8 times
    as far off on real video; `run.odometry.trajectory()` is as it was.
    An interrupt (Ctrl-C) ends the sequence there; what was tracked so far is kept. Raises
    `InitialisationError` where the camera never moved enough, `CameraError` where the frames are not of the
    size the camera was calibrated for, `InputError` on fewer than two frames, and what the source raises.
    """
    klt = klt or KLTSettings()
    kept = record or refine
    odometry = Odometry(camera, settings, base, start, zoom=zoom, record=kept, capacity=klt.capacity)
    features = KLT(klt)
    colours: dict[int, np.ndarray] = {}
    clock = _Clock()
    declared = source.declared if isinstance(source, FrameSource) else None
    bar = tqdm(total=declared, unit="frame", disable=None if progress else True, leave=False)
    interrupted, dissolves = False, list[tuple[int, int]]()
    try:
        # What the filter gives up of a frame the next one shows no more, and its slots are free from the one after
        # that on: the same whether the flow or the filter is faster.
        outliers, lost = np.zeros(0, np.int64), False
        frames = islice(source, max_frames)
        with contextlib.closing(_followed(frames, camera, features, clock, lambda: (outliers, lost))) as followed:
            for frame, tracks in followed:
                with clock.part("filter"):
                    if tracks.dissolved is not None:
                        odometry.cut(tracks.dissolved)
                        dissolves.append((tracks.dissolved, len(odometry.poses) - 1))
                    tracks = tracks._replace(visible=tracks.visible & ~np.isin(tracks.ids, outliers))
                    _sample(colours, tracks, frame.image)
                    quality = np.stack([tracks.error, tracks.eigenvalue], axis=1)
                    give_up = odometry.add(
                        tracks.pixels,
                        tracks.visible,
                        frame.time_s,
                        ids=tracks.ids,
                        quality=quality,
                        returns=tracks.returns,
                    )
                    outliers, lost = tracks.ids[give_up], odometry.lost
                newest = odometry.poses[-1]
                bar.set_postfix_str(f"{newest.status.name.lower()}, {newest.used} points", refresh=False)
                bar.update()
                clock.frame()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    if len(odometry.poses) < 2:
        raise InputError(f"{len(odometry.poses)} frame: a camera's motion needs at least two")
    causal = odometry.trajectory()
    clock.end()
    statistics = _statistics(odometry, odometry.poses) | clock.statistics() | {"interrupted": interrupted}
    statistics |= {"refined": None, "ignored": _ignored(features), "dissolves": _dissolved(dissolves)}
    points = odometry.points()
    run = Run(causal, points, _coloured(points, colours), odometry, statistics, track_colours=colours)
    return refined(run, progress=progress) if refine else run


def refined(run: Run, *, progress: bool = False) -> Run:
    """The run with all its keyframes adjusted together: `track(..., refine=True)` ends with it.

    Raises `InputError` where its tracks were not kept (`record`).
    """
    clock = _Clock()
    with clock.part("refinement"):
        found = refine_run(run.odometry, progress=progress)
    best, seconds = found.trajectory(), run.statistics["seconds"]
    assert isinstance(seconds, dict)
    statistics = run.statistics | _statistics(run.odometry, found.poses)
    statistics["seconds"] = seconds | {"refinement": clock.seconds["refinement"]}
    statistics["refined"] = found.statistics | _change(run.odometry.trajectory(), best)
    colours = _coloured(found.points, run.track_colours)
    return replace(run, trajectory=best, points=found.points, colours=colours, statistics=statistics, refined=found)


def _coloured(points: Points, colours: dict[int, np.ndarray]) -> np.ndarray:
    grey = np.full(3, 128, np.uint8)
    return np.array([colours.get(int(i), grey) for i in points.ids], np.uint8).reshape(-1, 3)


class _Clock:
    """Where the time of a run goes."""

    def __init__(self) -> None:
        self._seconds = {"waiting for frames": 0.0, "optical flow": 0.0, "filter": 0.0, "refinement": 0.0}
        self._milliseconds: list[float] = []
        self._began = self._last = self._ended = time.perf_counter()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Counts what is done within."""
        begun = time.perf_counter()
        yield
        self._seconds[name] += time.perf_counter() - begun

    def frame(self) -> None:
        """The end of a frame."""
        now = time.perf_counter()
        self._milliseconds.append(1e3 * (now - self._last))
        self._last = now

    def end(self) -> None:
        """The end of the last frame."""
        self._ended = time.perf_counter()

    @property
    def seconds(self) -> dict[str, float]:
        """Of each part."""
        return {k: round(v, 3) for k, v in self._seconds.items()}

    def statistics(self) -> dict[str, object]:
        """As `run.json` has them."""
        return {
            "frames_per_second": len(self._milliseconds) / (self._ended - self._began),
            "seconds": self.seconds,
            "milliseconds_of_frame": [round(m, 2) for m in self._milliseconds],
        }


def _followed(
    source: Iterable[Frame], camera: Camera, features: KLT, clock: _Clock, said: Callable[[], tuple[np.ndarray, bool]]
) -> Generator[tuple[Frame, FrameTracks], None, None]:
    """Every frame with its tracks, the next one followed already.

    What is `said` of the one before are its outliers, and whether the camera is lost.
    """

    def follow(frame: Frame) -> FrameTracks:
        with clock.part("optical flow"):
            return features.track(frame.image, frame.ignore)

    with contextlib.closing(ahead(source)) as frames, ThreadPoolExecutor(1) as pool:

        def following() -> tuple[Frame, Future[FrameTracks]] | None:
            with clock.part("waiting for frames"):
                frame = next(frames, None)
            if frame is None:
                return None
            _same_size(camera, frame)
            return frame, pool.submit(follow, frame)

        now = following()
        while now is not None:
            frame, tracks = now[0], now[1].result()
            outliers, features.lost = said()
            features.drop(outliers)
            now = following()
            yield frame, tracks


def warm_up(
    camera: Camera,
    *,
    base: Base | str = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    klt: KLTSettings | None = None,
    refine: bool = False,
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
    odometry = Odometry(camera, settings, base, start, record=refine, capacity=n)
    for k in range(6):
        shift = np.stack([0.04 * w * k / depth, np.zeros(n)], axis=1)
        odometry.add(pixels + shift, np.ones(n, bool), float(k))
    odometry.points()
    if refine:
        refine_run(odometry)


def follow_tracks(
    camera: Camera,
    pixels: ArrayOrList,
    visible: ArrayOrList,
    times: ArrayOrList | None = None,
    *,
    base: Base | str = Base.TRACKS,
    settings: Settings | None = None,
    start: StartSettings | None = None,
    zoom: ZoomCurve | None = None,
    record: bool = False,
) -> Odometry:
    """Recover the camera's trajectory from feature tracks: `pixels` (t, n, 2) and `visible` (t, n), a column a track.

    A pixel that is NaN counts as not visible. `times` (t,) are in seconds, by default the numbers of the frames. `zoom`
    is how the focal length changes on the way, where that is known: `jaxtri.calibrate` finds it. The columns are filled
    up to 64, 128, 256, ..., so that another number of tracks compiles nothing.

    Raises `InputError` where a shape does not fit or there are fewer than two frames.
    """
    z = numbers("pixels", pixels, ("t", "n", 2))
    seen = booleans("visible", visible, z.shape[:2])
    t = np.arange(len(z), dtype=float) if times is None else numbers("times", times, (len(z),))
    if len(z) < 2:
        raise InputError(f"pixels hold {len(z)} frames; a camera's motion needs at least two")
    odometry = Odometry(camera, settings, base, start, zoom=zoom, record=record, capacity=capacity(z.shape[1]))
    for k in range(len(z)):
        odometry.add(z[k], seen[k], float(t[k]))
    odometry.finish()
    return odometry


def _same_size(camera: Camera, frame: Frame) -> None:
    h, w = frame.image.shape[:2]
    if camera.width is None or camera.height is None or (camera.width, camera.height) == (w, h):
        return
    size, remedy = (camera.width, camera.height), "they are cropped or stretched; give the calibration of this size"
    if same_aspect(size, (w, h)):
        remedy = "give the calibration of this size, or, where they were resized and not cropped, camera.scaled(w, h)"
    elif same_aspect(size, (h, w)):
        remedy = "give camera.turned(90) where they are the calibrated picture turned clockwise, else turned(270)"
    raise CameraError(f"the camera was calibrated at {size[0]}x{size[1]}, the frames are {w}x{h}: {remedy}")


def _sample(colours: dict[int, np.ndarray], tracks: FrameTracks, image: np.ndarray) -> None:
    new = np.flatnonzero(tracks.fresh)
    h, w = image.shape[:2]
    x, y = tracks.pixels[new].round().astype(int).clip(0, [w - 1, h - 1]).T
    colours |= dict(zip(tracks.ids[new].tolist(), image[y, x][:, ::-1], strict=True))


def _figures(values: Iterable[float]) -> list[float]:
    """To four figures: a file is for people, too."""
    return [float(f"{x:.4g}") for x in values]


def _statistics(odometry: Odometry, poses: list[FramePose]) -> dict[str, object]:
    status = Counter(p.status.name.lower() for p in poses)
    used = [p.used for p in poses if p.status.measured]
    return {
        "frames": len(poses),
        "status": dict(status),
        "status_of_frame": [p.status.name.lower() for p in poses],
        "doubts": {k: p.doubts for k, p in enumerate(poses) if p.doubts},
        "evidence_of_frame": {
            "nis_per_component": _figures(p.nis / (2 * p.used) if p.used else p.nis for p in poses),
            "points_measured": [p.measured for p in poses],
            "points_used": [p.used for p in poses],
            "rotation_sd_deg": _figures(p.rotation_sd_deg for p in poses),
            "position_sd": _figures(p.position_sd for p in poses),
            "parallax_deg": _figures(p.parallax_deg for p in poses),
            "noise_over_assumed": _figures(p.noise for p in poses),
        },
        "starts": odometry.starts,
        "restarts": odometry.changes,
        "scale_unknown_from_frame": odometry.scale_unknown_from,
        "found": [again._asdict() for again in odometry.found],
        "base_pair": odometry.base_pair,
        "keyframes": odometry.keyframes,
        "points_used_per_frame": float(np.mean(used)) if used else 0.0,
    }


def _ignored(features: KLT) -> dict[str, object]:
    """The bars and overlays that were found; warns where they are much of the picture."""
    found, share = features.found(), round(features.ignored_share(), 4)
    if found and share > MUCH:
        warnings.warn(
            f"{share:.0%} of the picture is ignored, as bars or overlays (run.json says where): if they are none, give "
            "--no-find-overlays, or KLTSettings(find_overlays=False), and mark what is one by --mask",
            InputWarning,
            stacklevel=3,
        )
    return {"share": share, "found": [part._asdict() for part in found]}


def _dissolved(found: list[tuple[int, int]]) -> list[list[int]]:
    """The first and last frames of dissolves, with a warning where there are any."""
    if found:
        frames = ", ".join(f"{first} to {last}" for first, last in found)
        warnings.warn(
            f"frames {frames} show two shots at once, as one dissolves into the other: they have no pose, and what "
            "follows has a scale of its own; cut the clip there, or, if there is no dissolve, give "
            "--no-find-dissolves, or KLTSettings(find_dissolves=False)",
            InputWarning,
            stacklevel=3,
        )
    return [list(span) for span in found]


def _change(before: Trajectory, after: Trajectory) -> dict[str, float]:
    """How far refinement has moved the frames: root mean squares, positions over the length of the path."""
    length, shift = before.path_length, np.linalg.norm(after.positions - before.positions, axis=1)
    turn = np.degrees(angle(jnp.asarray(np.swapaxes(before.rotations, 1, 2) @ after.rotations)))
    moved, turned = (float(np.sqrt(np.mean(x**2))) for x in (shift, turn))
    return {"moved_percent_of_path": 100 * moved / length if length else 0.0, "turned_deg": turned}
