"""Feature tracks from images: Shi-Tomasi corners followed by pyramidal Lucas-Kanade, through OpenCV."""

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from jaxtri.errors import ResolutionChangeError
from jaxtri.vision.bars import Bars
from jaxtri.vision.dissolves import Dissolves
from jaxtri.vision.flow import Flow, shift_between
from jaxtri.vision.overlays import Ignored, Overlays
from jaxtri.vision.pictures import Glance
from jaxtri.vision.places import FEWEST, Places, Returns

BLOCK = 5  # pixels across, over which the strength of a corner is summed: a corner, and not the noise of one pixel
LOST = 0.5  # share of the features below which the flow is sought again from elsewhere


@dataclass(frozen=True)
class KLTSettings:
    """How features are found and followed; lengths in pixels of the image.

    The defaults were found on the sequences of `benchmarks/real_sequences.py`. Patches of 11 to 15 pixels and 600 to
    1,000 features gave 0.68 to 0.95 times the error of `pnp` there.

    Attributes:
        capacity: Slots for features; also the most that are followed at once. More take longer, and average more noise.
        quality: Smallest corner strength, as a share of the best corner's. Low, so that a bright corner does not starve
            the rest of the image; the filter leaves out what turns out to be none. Lower finds more and weaker corners.
        spacing: Smallest distance between two new features. Smaller lets patches overlap, whose errors are then alike.
        window: Side of the patch that is compared. Larger is less noisy, slower, and more often spans two surfaces.
        levels: Pyramid levels beyond the image itself. Flow of about half a window, doubled for each level, is reached.
        forward_backward: Largest distance between a feature and where it comes back to when tracked there and back; one
            beyond it is given up. Larger keeps more tracks and more false ones.
        anchor_move: Largest correction by the anchor patch, the one that the feature was found in. Beyond it the patch
            has changed too much, and the present frame becomes the anchor. Larger risks jumps to something similar.
        refill: Share of the capacity below which new corners are sought. 1 seeks in every frame, which takes time;
            lower lets the number of features swing.
        cells: The image is divided into `cells` x `cells`, each of which gets its share of the features: spread over
            the whole view they fix the pose better than in one corner of it.
        find_overlays: Ignore bars at the edges, and what stays in its place while the picture moves. Without it a logo,
            a time code or a bonnet hold features that say that the camera stands.
        find_dissolves: Give up all features where one shot is found to have dissolved into another, 5 to 17 frames
            after its middle. Without it features go over from the one to the other, and with them a wrong scale.
        find_places: Look for features of earlier frames where most of those that are followed are gone: what was lost
            is found again, and a place that was left is recognised. Costs a description of the features each time.
    """

    capacity: int = 800
    quality: float = 0.005
    spacing: float = 8.0
    window: int = 13
    levels: int = 4
    forward_backward: float = 0.7
    anchor_move: float = 1.5
    refill: float = 0.8
    cells: int = 8
    find_overlays: bool = True
    find_dissolves: bool = True
    find_places: bool = True


class FrameTracks(NamedTuple):
    """Features of one frame in fixed slots.

    A slot keeps its feature from frame to frame as long as `visible` stays True.

    Attributes:
        pixels: (n, 2) float64 image points; the centre of the top-left pixel is (0, 0).
        visible: (n,) slots that hold a feature.
        fresh: (n,) slots whose feature is seen for the first time.
        ids: (n,) numbers of the features.
        error: (n,) forward-backward distance in pixels; NaN where it is not known, as of a fresh feature.
        eigenvalue: (n,) smaller eigenvalue of the patch's gradient matrix, per pixel
            (`cv2.OPTFLOW_LK_GET_MIN_EIGENVALS`); NaN where it is not known.
        dissolved: Where a dissolve is found in this frame, the first frame of it: what was followed since then belongs
            to neither shot, and all features are new. None elsewhere.
        returns: Features of earlier frames that are found again in this one, where they were looked for and are enough.
    """

    pixels: np.ndarray
    visible: np.ndarray
    fresh: np.ndarray
    ids: np.ndarray
    error: np.ndarray
    eigenvalue: np.ndarray
    dissolved: int | None = None
    returns: Returns | None = None


@dataclass
class KLT:
    """A feature tracker fed one image at a time.

    Each patch is followed from frame to frame and then re-aligned with the frame it was found in (its
    anchor), against drift; when it has changed too much for that, the present frame becomes its anchor.

    Attributes:
        settings: How features are found and followed.
        lost: Whether to look in every frame for features that were given up, and not only where most are new.
    """

    settings: KLTSettings = field(default_factory=KLTSettings)
    lost: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        n = self.settings.capacity
        self._pixels = np.zeros((n, 2), np.float32)
        self._alive = np.zeros(n, bool)
        self._ids = np.full(n, -1, np.int64)
        self._anchor = np.full(n, -1, np.int64)
        self._anchor_pixels = np.zeros((n, 2), np.float32)
        given = self.settings
        self._flow = Flow(given.window, given.levels, given.forward_backward, given.anchor_move)
        side = 2 * self._flow.reach + 1
        self._patches = np.zeros((n, side, side), np.uint8)  # of the anchors, about the rounded pixel
        self._previous: np.ndarray | None = None
        self._frame = -1
        self._next_id = 0
        self._shape: tuple[int, ...] | None = None
        self._parts: list[np.ndarray | None] = []  # what is ignored: as given, the bars, the overlays
        self._ignore: np.ndarray | None = None  # all of it, with its surroundings
        self._bars = Bars()
        self._overlays: Overlays | None = None
        self._dissolves, self._shot = Dissolves(), 0  # the first frame of the present shot, so far as is known
        self._places = Places()

    def track(self, image: np.ndarray, ignore: np.ndarray | None = None) -> FrameTracks:
        """Follow all features into `image` (h, w) or (h, w, 3) uint8, and fill the free slots.

        Where `ignore` (h, w) is True, and half a patch around, there are none.

        Raises `ResolutionChangeError` when the image is not of the first one's size.
        """
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._frame += 1
        if self._shape is not None and gray.shape != self._shape:
            (h0, w0), (h, w) = self._shape[:2], gray.shape[:2]
            raise ResolutionChangeError(
                f"frame {self._frame} is {w}x{h}, the frames before it {w0}x{h0}: split the video there"
            )
        self._shape = gray.shape
        dissolved = self._dissolved(image, gray)
        error, eigenvalue = np.full((2, self.settings.capacity), np.nan)
        if self._previous is not None and self._alive.any():
            slots = np.flatnonzero(self._alive)
            moved, ok, *quality = self._follow(self._previous, gray, self._pixels[slots])
            self._pixels[slots] = moved
            error[slots], eigenvalue[slots] = quality
            self._alive[slots] = ok
            self._realign(gray, error, eigenvalue)
            self._separate()
        parts = [ignore, *(self._find(gray) if self.settings.find_overlays else ())]
        if [id(p) for p in parts] != [id(p) for p in self._parts]:
            self._parts, self._ignore = parts, self._around(parts)
        self._alive &= ~self._ignored()
        fresh = np.zeros(self.settings.capacity, bool)
        if self._alive.sum() < self.settings.refill * self.settings.capacity:
            fresh = self._fill(gray)
        returns = self._look_back(gray, fresh) if self.settings.find_places else None
        self._previous = gray
        pixels, alive, ids = self._pixels.astype(np.float64), self._alive.copy(), self._ids.copy()
        return FrameTracks(pixels, alive, fresh, ids, error, eigenvalue, dissolved, returns)

    def drop(self, ids: np.ndarray) -> None:
        """Give up the features of these numbers: the filter found them to be outliers."""
        self._alive &= ~np.isin(self._ids, ids)

    def found(self) -> list[Ignored]:
        """The bars and overlays that were found so far, in the order in which they were."""
        overlays = [] if self._overlays is None else self._overlays.regions()
        return sorted([*self._bars.regions(), *overlays], key=lambda part: part.first)

    def ignored_share(self) -> float:
        """The share of the picture in which the latest frame may hold no features."""
        return 0.0 if self._ignore is None else float(self._ignore.mean())

    def _dissolved(self, image: np.ndarray, gray: np.ndarray) -> int | None:
        """Look for a dissolve; where one is found give up all features, and say which frame is its first."""
        if not self.settings.find_dissolves or image.ndim == 2:
            return None
        self._dissolves.add(Glance.of(image, gray))
        first = self._dissolves.beyond(self._shot)
        if first is not None:
            self._alive[:] = False
            first, self._shot = max(first, self._shot), self._frame
        return first

    def _find(self, gray: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """What is found to be ignored (h, w): bars and overlays."""
        if self._overlays is None:
            h, w = gray.shape
            self._overlays = Overlays((h, w), self.settings.window, self.settings.capacity)
        moved = self._overlays.see(gray, self._frame, self._pixels, self._ids, self._alive)
        self._bars.see(gray, self._frame, moved)
        return self._bars.mask, self._overlays.mask

    def _follow(self, a: np.ndarray, b: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        """The flow from frame to frame, of features that stay inside; as of `Flow.between`.

        Where it loses most of them (a frame is missing, the camera is thrown about) it is sought again from where the
        image as a whole has gone, and the one that keeps more of them is taken.
        """

        def flow(guess: np.ndarray | None) -> tuple[np.ndarray, ...]:
            moved, ok, *quality = self._flow.between(a, b, pixels, guess, self.settings.levels)
            return moved, ok & self._inside(moved), *quality

        found = flow(None)
        if found[1].mean() < LOST:
            again = flow(pixels + shift_between(a, b))
            found = max(found, again, key=lambda f: f[1].sum())
        return found

    def _realign(self, gray: np.ndarray, error: np.ndarray, eigenvalue: np.ndarray) -> None:
        slots = np.flatnonzero(self._alive & (self._anchor < self._frame - 1))
        if not slots.size:
            return
        guess = self._pixels[slots]
        present = self._flow.patches(gray, guess)
        moved, ok, fb, smaller = self._flow.aligned(self._patches[slots], self._anchor_pixels[slots], present, guess)
        self._pixels[slots[ok]] = moved[ok]
        error[slots[ok]], eigenvalue[slots[ok]] = fb[ok], smaller[ok]
        self._set_anchor(slots[~ok], present[~ok])

    def _look_back(self, gray: np.ndarray, fresh: np.ndarray) -> Returns | None:
        """Features that were given up and are in this frame, of the place that holds most of them; `fresh` (n,) slots.

        Keeps a place where one is due. Fresh features are put where those before them are found.
        """
        slots = np.flatnonzero(self._alive)
        due = self._places.due(self._ids[slots])
        if not (due or self.lost) or not slots.size:
            return None
        pixels = self._pixels[slots]
        present = self._flow.patches(gray, pixels)
        here = self._places.place(self._frame, gray, self._ids[slots], pixels, present)
        found = self._places.find(here)
        if due:
            self._places.keep(here)
        if found is None:
            return None
        place, now, before = found
        moved, ok, *_ = self._flow.aligned(place.patches[before], place.pixels[before], present[now], pixels[now])
        if ok.sum() < FEWEST:
            return None
        moved, now, before = moved[ok], now[ok], before[ok]
        new = fresh[slots[now]]
        at = slots[now[new]]
        self._pixels[at] = moved[new]
        self._set_anchor(at, self._flow.patches(gray, moved[new]))
        return Returns(here.ids[now], place.ids[before], moved.astype(np.float64), place.frame)

    def _set_anchor(self, slots: np.ndarray, patches: np.ndarray) -> None:
        self._anchor[slots] = self._frame
        self._anchor_pixels[slots] = self._pixels[slots]
        self._patches[slots] = patches

    def _inside(self, pixels: np.ndarray) -> np.ndarray:
        assert self._shape is not None
        h, w = self._shape[:2]
        margin = self.settings.window // 4
        return np.all((pixels >= margin) & (pixels < np.array([w, h]) - margin), axis=1)

    def _around(self, parts: list[np.ndarray | None]) -> np.ndarray | None:
        """What is ignored (h, w), and half a patch around: a patch that holds some of it follows that, too."""
        for part in parts:
            if part is not None and part.shape != self._shape:
                raise ResolutionChangeError(f"ignore is of shape {part.shape}, the image of {self._shape}")
        there = [part for part in parts if part is not None]
        if not there:
            return None
        ignore = np.logical_or.reduce(there)
        return cv2.dilate(ignore.astype(np.uint8), np.ones((self.settings.window | 1,) * 2, np.uint8)).astype(bool)

    def _ignored(self) -> np.ndarray:
        """The slots (n,) whose feature lies in what is ignored."""
        if self._ignore is None or self._shape is None:
            return np.zeros(len(self._alive), bool)
        x, y = np.rint(self._pixels).astype(int).T
        h, w = self._shape[:2]
        return self._ignore[y.clip(0, h - 1), x.clip(0, w - 1)]

    def _separate(self) -> None:
        """Give up features that have run into an older one."""
        slots = np.flatnonzero(self._alive)
        if slots.size < 2:
            return
        slots = slots[np.argsort(self._ids[slots])]
        cell = np.floor(self._pixels[slots] / (self.settings.spacing / 2)).astype(np.int64)
        _, first = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_index=True)
        lost = np.ones(slots.size, bool)
        lost[first] = False
        self._alive[slots[lost]] = False

    def _fill(self, gray: np.ndarray) -> np.ndarray:
        s = self.settings
        mask = np.full(gray.shape[:2], 255, np.uint8)
        if self._ignore is not None:
            mask[self._ignore] = 0
        for x, y in self._pixels[self._alive]:
            cv2.circle(mask, (round(float(x)), round(float(y))), int(s.spacing), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            gray, 0, s.quality, s.spacing, mask=mask, blockSize=BLOCK, useHarrisDetector=False
        )
        fresh = np.zeros(s.capacity, bool)
        if corners is None:  # a blank image
            return fresh
        corners = corners.reshape(-1, 2)
        corners = corners[self._inside(corners)]
        corners = corners[self._spread(corners)]
        slots = np.flatnonzero(~self._alive)[: len(corners)]
        corners = corners[: slots.size]
        self._pixels[slots] = corners
        self._alive[slots] = True
        self._ids[slots] = np.arange(self._next_id, self._next_id + slots.size)
        self._next_id += slots.size
        self._set_anchor(slots, self._flow.patches(gray, corners))
        fresh[slots] = True
        return fresh

    def _spread(self, corners: np.ndarray) -> np.ndarray:
        """Order of the corners that fills the emptiest cells first, each by its strongest corners."""
        assert self._shape is not None
        h, w = self._shape[:2]
        g = self.settings.cells

        def cell(p: np.ndarray) -> np.ndarray:
            return (p[:, 1] * g / h).astype(int).clip(0, g - 1) * g + (p[:, 0] * g / w).astype(int).clip(0, g - 1)

        held = np.bincount(cell(self._pixels[self._alive]), minlength=g * g)
        cells = cell(corners)
        rank = np.zeros(len(corners), int)
        for c in np.unique(cells):  # corners come in order of strength
            rank[cells == c] = held[c] + np.arange((cells == c).sum())
        return np.argsort(rank, kind="stable")
