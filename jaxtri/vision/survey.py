"""What a source shows before anything is tracked: exposure, blur, features and how they last, faults of the film."""

import contextlib
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

from jaxtri.errors import InputError
from jaxtri.vision.dissolves import LEAST, MIXED, Dissolves
from jaxtri.vision.hypotheses import FARTHER, SHARES
from jaxtri.vision.klt import KLT, FrameTracks, KLTSettings
from jaxtri.vision.pictures import Look, look
from jaxtri.vision.video import Frame, FrameSource, ahead

POINTS, COMMON, FLOW = 20, 0.15, 0.035
"""What a start of `track` needs: tracks, share of the first frame's tracks, and flow as a share of the width."""

# Found on real sequences, on faulty copies of them and on rendered clips. In brackets what those show that are fine.
BLURRED, BLURRIER = 0.75, 0.25  # `Survey.blur`, and that over the median nearby (.67 and .20; 15 pixels: .85 and .32)
COMBED = 0.01  # `Survey.combing` (0; where the camera moves, two fields in a frame have .07 and more)
STILL_PX, STILL = 0.1, 5  # flow below which, for so many frames, the camera stands (noise of 2 grey levels: .03 pixels)
SAME = 0.05  # difference from the frame before over that nearby: less is the same picture, coded anew (.005 to .01)
NEAR = 8  # frames to each side that a frame is compared with
BROKEN = (
    0.5  # survival over the median nearby, below which the flow is broken (.7; cuts .23 to .28, 20 frames gone .46)
)
CUT, CUT_NEARBY = 0.1, 2.0  # change of the colours, and that over the median nearby, at a cut (both at once: none)
BY_CHANCE = 0.4  # survival up to which what is found again may be a likeness (cuts .28; 20 frames gone .46)
WAITING = 32  # frames that are kept to begin a start from: what is older is thinned out, so that memory stays flat


@dataclass(frozen=True)
class Survey:
    """What a source shows, a number a frame; made by `survey`.

    The first frame has NaN where two are compared, and so has a frame after one without features.

    Attributes:
        name: What the source is called in messages.
        size: (width, height) in pixels.
        folder: Whether it is a folder of images.
        declared: Frames that the source claims to hold, None where it makes no claim.
        fps: Nominal frames a second.
        timed: Whether the times are the source's own, or given; they are assumed otherwise.
        turned_deg: Degrees clockwise by which the stored pixels are turned.
        pixel_aspect: Width of a pixel over its height.
        index: (t,) place of the frame in the source.
        time_s: (t,) seconds.
        brightness: (t,) mean grey level, 0 to 1.
        black: (t,) share of the pixels at the lower end of the scale.
        white: (t,) share of the pixels at its upper end.
        blur: (t,) 0 (sharp) to 1 (blurred in at least one direction); neither contrast nor size changes it.
        combing: (t,) share of the pixels that differ from both rows beside them, less three times the columns' share.
        features: (t,) features followed.
        survival: (t,) share of the features of the frame before that are followed into this one.
        flow_px: (t,) their median motion, pixels.
        difference: (t,) mean absolute difference from the frame before, grey levels.
        change: (t,) share of the picture whose colours are others than in the frame before, 0 to 1.
        start_flow: (t,) flow that half of the features exceed, or a quarter 1.4 times, as a share of the width, since
            the first frame of which enough are left.
        depth: (t,) where that flow suffices for a start: how much worse one homography fits than an epipolar geometry.
        mixed: (t,) what a mixture of an earlier and a later picture leaves unexplained of its contrast, over what a
            picture between the two does; 1 for none: see `jaxtri.vision.dissolves`.
        life: Median number of frames that a feature is followed for.
    """

    name: str
    size: tuple[int, int]
    folder: bool
    declared: int | None
    fps: float | None
    timed: bool
    turned_deg: int
    pixel_aspect: float
    index: Int[np.ndarray, " t"]
    time_s: Float[np.ndarray, " t"]
    brightness: Float[np.ndarray, " t"]
    black: Float[np.ndarray, " t"]
    white: Float[np.ndarray, " t"]
    blur: Float[np.ndarray, " t"]
    combing: Float[np.ndarray, " t"]
    features: Int[np.ndarray, " t"]
    survival: Float[np.ndarray, " t"]
    flow_px: Float[np.ndarray, " t"]
    difference: Float[np.ndarray, " t"]
    change: Float[np.ndarray, " t"]
    start_flow: Float[np.ndarray, " t"]
    depth: Float[np.ndarray, " t"]
    mixed: Float[np.ndarray, " t"]
    life: float

    @property
    def seconds(self) -> float:
        """Length, the last frame's own time included."""
        steps = np.diff(self.time_s)
        return float(self.time_s[-1] - self.time_s[0] + (np.median(steps) if len(steps) else 0))

    @property
    def flicker(self) -> float:
        """Median change of the brightness to and fro between frames, as a share of it."""
        if len(self.brightness) < 3:
            return 0.0
        bend = np.abs(np.diff(self.brightness, 2)) / 2
        return float(np.median(bend / np.maximum(self.brightness[1:-1], 1 / 255)))

    @property
    def repeated(self) -> Bool[np.ndarray, " t"]:
        """Frames that show the picture of the one before again, exactly or as coded anew."""
        nearby = _nearby(self.difference, lambda x: float(np.quantile(x, 0.9)))
        return (self.difference <= SAME * nearby) & ~self.still

    @property
    def still(self) -> Bool[np.ndarray, " t"]:
        """Frames of stretches in which the picture does not move."""
        return _runs(self.flow_px < STILL_PX, STILL)

    @property
    def blurred(self) -> Bool[np.ndarray, " t"]:
        """Frames whose edges are gone in at least one direction; a picture of one colour has none to go."""
        nearby = _nearby(self.blur, np.median)
        return ((self.blur > BLURRED) | (self.blur > nearby + BLURRIER)) & (self.features >= POINTS)

    @property
    def combed(self) -> Bool[np.ndarray, " t"]:
        """Frames whose even and odd rows show two moments."""
        return self.combing > COMBED

    @property
    def cuts(self) -> Bool[np.ndarray, " t"]:
        """First frames of another shot: features and colours are others at once; a shot of one frame is a flash."""
        other = (self.change > CUT) & (self.change > CUT_NEARBY * _nearby(self.change, np.median))
        found = self._broken & other & (self.survival < BY_CHANCE)
        return found & ~_runs(found, 2)

    @property
    def dissolves(self) -> Bool[np.ndarray, " t"]:
        """Middle frames of what seem to be dissolves from one shot to another."""
        return _runs(self.mixed < MIXED, LEAST)

    @property
    def jumps(self) -> Bool[np.ndarray, " t"]:
        """Frames into which most features are lost although the shot goes on."""
        return self._broken & ~self.cuts

    @property
    def _broken(self) -> np.ndarray:
        # A frame that shows nothing has lost them all; that is another fault.
        return (self.survival < BROKEN * _nearby(self.survival, np.median)) & (self.features >= POINTS)

    @property
    def startable(self) -> bool:
        """Whether the picture moves far enough for a start while enough features last."""
        return bool((self.start_flow >= FLOW).any())


def survey(source: Iterable[Frame], *, max_frames: int | None = None, progress: bool = True) -> Survey:
    """Look at the frames of a source, in one pass, as `track` will see them; no camera is needed.

    Features are found and followed by the tracker of `track` with its default settings. Frames are decoded and
    measured by a thread of their own. An interrupt (Ctrl-C) ends the sequence there. Raises `InputError` where there
    is no frame, and what the source raises.
    """
    known = source if isinstance(source, FrameSource) else None
    bar = tqdm(total=known.declared if known else None, unit="frame", disable=None if progress else True, leave=False)
    rows, features, dissolves, size, before = [], _Features(), Dissolves(), (0, 0), None
    looked = contextlib.closing(ahead(_looked(islice(source, max_frames))))
    with contextlib.closing(bar), contextlib.suppress(KeyboardInterrupt), looked as frames:
        for frame, now in frames:
            size = frame.image.shape[1], frame.image.shape[0]
            shown = now.brightness, now.black, now.white, now.blur, now.combing
            compared = (np.nan, np.nan) if before is None else now.against(before)
            rows.append((frame.index, frame.time_s, *shown, *features.add(frame), *compared))
            before = now
            dissolves.add(now)
            bar.update()
    if not rows:
        raise InputError("there are no frames to look at")
    names = (
        "index time_s brightness black white blur combing features survival flow_px start_flow depth difference change"
    )
    arrays = dict(zip(names.split(), np.array(rows, float).T, strict=True))
    arrays |= {name: arrays[name].astype(int) for name in ("index", "features")}
    return Survey(
        name="frames" if known is None else known.name,
        size=size,
        folder=known is not None and known.folder is not None,
        declared=None if known is None else known.declared,
        fps=None if known is None else known.fps,
        timed=known is None or known.timed,
        turned_deg=0 if known is None else known.turned_deg,
        pixel_aspect=1.0 if known is None else known.pixel_aspect,
        mixed=np.array(dissolves.mixed),
        life=features.life,
        **arrays,
    )


def _looked(frames: Iterable[Frame]) -> Generator[tuple[Frame, Look], None, None]:
    for frame in frames:
        yield frame, look(frame.image)


class _Features:
    """Follows features, and sees how far they come."""

    def __init__(self) -> None:
        self._klt = KLT(KLTSettings(find_dissolves=False))  # they are looked for anyway
        self._ages = np.zeros(self._klt.settings.capacity, int)
        self._lives: list[int] = []  # counts of the features that were followed for 0, 1, 2, ... frames
        self._last: FrameTracks | None = None
        self._waiting: list[FrameTracks] = []

    def add(self, frame: Frame) -> tuple[float, ...]:
        """Features, survival, flow in pixels, flow since the first frame of a start, and depth: see `Survey`."""
        now, last = self._klt.track(frame.image, frame.ignore), self._last
        self._last = now
        survival = flow = np.nan
        if last is not None:
            kept = _common(last, now)
            self._count(self._ages[last.visible & ~kept])
            self._ages = np.where(kept, self._ages + 1, 1)
            if last.visible.any():
                survival = kept.sum() / last.visible.sum()
            if kept.any():
                flow = np.median(np.linalg.norm(now.pixels[kept] - last.pixels[kept], axis=1))
        else:
            self._ages[:] = 1
        return float(now.visible.sum()), float(survival), float(flow), *self._start(now, frame.image.shape[1])

    @property
    def life(self) -> float:
        """Median number of frames of all features, of those that live on to this frame."""
        alive = [] if self._last is None else self._ages[self._last.visible]
        counts = np.bincount(alive, minlength=len(self._lives)).astype(float)
        counts[: len(self._lives)] += self._lives
        return float(np.searchsorted(np.cumsum(counts), counts.sum() / 2)) if counts.sum() else 0.0

    def _count(self, ages: np.ndarray) -> None:
        counts = np.bincount(ages, minlength=len(self._lives))
        counts[: len(self._lives)] += np.array(self._lives, int)
        self._lives = counts.tolist()

    def _start(self, now: FrameTracks, width: int) -> tuple[float, float]:
        """The flow since the first frame that enough features are left of, and what it says of depth."""
        waiting = self._waiting
        while waiting and _common(waiting[0], now).sum() < max(POINTS, COMMON * waiting[0].visible.sum()):
            waiting.pop(0)
        flow = depth = np.nan
        if waiting:
            kept = _common(waiting[0], now)
            a, b = waiting[0].pixels[kept], now.pixels[kept]
            half, quarter = np.quantile(np.linalg.norm(b - a, axis=1), SHARES)
            flow = max(float(half), float(quarter) / FARTHER) / width
            if flow >= FLOW:
                depth = _depth(a, b)
                waiting.clear()
        waiting.append(now)
        if len(waiting) > WAITING:
            del waiting[1:-1:2]
        return flow, depth


def _common(a: FrameTracks, b: FrameTracks) -> np.ndarray:
    return a.visible & b.visible & (a.ids == b.ids)


def _depth(a: np.ndarray, b: np.ndarray) -> float:
    """How much worse a homography fits than an epipolar geometry: 2.5 times where only noise speaks against it."""
    H, _ = cv2.findHomography(a, b, cv2.RANSAC, 2.0)
    F, _ = cv2.findFundamentalMat(a, b, cv2.USAC_DEFAULT, 1.0, 0.999, 2000)
    if H is None or F is None or F.shape != (3, 3):
        return np.nan
    off = np.linalg.norm(cv2.perspectiveTransform(a[:, None], H)[:, 0] - b, axis=1)
    x, y = (np.concatenate([p, np.ones((len(p), 1))], axis=1) for p in (a, b))
    there, back = x @ F.T, y @ F
    slope = np.sqrt((there[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    distance = np.abs((y * there).sum(axis=1)) / np.maximum(slope, 1e-12)
    return float(np.median(off) / max(np.median(distance), 1e-6))


def _nearby(x: np.ndarray, summary: Callable[[np.ndarray], float]) -> np.ndarray:
    """A summary of the frames about each, itself left out; NaN where there are none."""
    found = np.full(len(x), np.nan)
    for k in range(len(x)):
        others = np.concatenate([x[max(0, k - NEAR) : k], x[k + 1 : k + 1 + NEAR]])
        others = others[np.isfinite(others)]
        if others.size:
            found[k] = summary(others)
    return found


def _runs(mask: np.ndarray, least: int) -> np.ndarray:
    """What is True for at least so many frames in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    found = np.zeros(len(mask), bool)
    for begin, end in edges.reshape(-1, 2):
        found[begin:end] = end - begin >= least
    return found
