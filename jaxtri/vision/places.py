"""Places that were seen before: the features of some frames are described, and found again in later ones.

A place is a frame whose features are kept, with a descriptor and the patch of each. One is kept whenever more than half
of the features of the last one are gone, and is looked for among the others then. The descriptor is SIFT at the feature
itself (Lowe 2004, section 6), upright, its roots compared (Arandjelovic & Zisserman 2012). Two features are one where
each is the other's best match by a margin; whether their patches are one is for the flow to say. Of many places those
are matched that have most words in common, rare ones above all; the words are the first descriptors of the sequence
(Sivic & Zisserman 2003).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

GONE = 0.5  # share of a place's features that are left, below which the next place is kept
LEFT = 0.1  # share of them that are still followed, from which the place has not been left
MARGIN = 0.8  # largest distance to the best match over that to the second best. Source: Lowe 2004, section 7.1
MOST = 256  # places that are kept; where there are more, every other one of the older half is forgotten
FEWEST = 12  # matches that are worth to be looked at
WORDS = 512  # descriptors by which the places are found that are worth to be matched
LIKELY = 8  # places that are


class Place(NamedTuple):
    """The features of a frame.

    Attributes:
        frame: Its number.
        ids: (n,) numbers of the features.
        pixels: (n, 2) where they are.
        descriptors: (n, 128) roots of SIFT, of unit length.
        patches: (n, side, side) about the rounded pixels.
        words: (n,) that the descriptors are nearest to.
    """

    frame: int
    ids: np.ndarray
    pixels: np.ndarray
    descriptors: np.ndarray
    patches: np.ndarray
    words: np.ndarray


class Returns(NamedTuple):
    """Features that were given up, and are seen again under other numbers.

    Attributes:
        now: (m,) numbers of the features of this frame.
        before: (m,) numbers that they had.
        pixels: (m, 2) where those are in this frame, by their own patches: up to a pixel or two from the new ones, but
            for fresh ones, which are put there.
        frame: One of before that holds all of them.
    """

    now: np.ndarray
    before: np.ndarray
    pixels: np.ndarray
    frame: int


class Matches(NamedTuple):
    """Features of a frame that may be some of a place: rows of both."""

    place: Place
    now: np.ndarray
    before: np.ndarray


@dataclass
class Places:
    """The places of a sequence.

    Attributes:
        size: Of a feature, in pixels: its descriptor is six times as wide.
        kept: Those that are kept, in order.
    """

    size: float
    kept: list[Place] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._sift = cv2.SIFT.create()
        self._words = np.zeros((0, 128), np.float32)

    def due(self, ids: np.ndarray) -> bool:
        """Whether too little is left of the last place, for features of these numbers (n,)."""
        if not self.kept:
            return len(ids) >= FEWEST
        last = self.kept[-1].ids
        return len(ids) >= FEWEST and int(np.isin(last, ids).sum()) < GONE * len(last)

    def place(self, frame: int, gray: np.ndarray, ids: np.ndarray, pixels: np.ndarray, patches: np.ndarray) -> Place:
        """The features of a frame, described."""
        points = [cv2.KeyPoint(float(x), float(y), self.size, 0.0) for x, y in pixels]
        _, found = self._sift.compute(gray, points)
        roots = np.sqrt(found / np.maximum(np.abs(found).sum(axis=1, keepdims=True), 1.0))
        if len(self._words) < WORDS:
            self._words = np.concatenate([self._words, roots])[:WORDS]
        words = np.argmax(roots @ self._words.T, axis=1)
        return Place(frame, ids, pixels.astype(np.float32), roots.astype(np.float16), patches, words)

    def keep(self, place: Place) -> None:
        """One more."""
        self.kept.append(place)
        if len(self.kept) > MOST:
            half = MOST // 2
            self.kept = self.kept[:half:2] + self.kept[half:]

    def find(self, now: Place) -> Matches | None:
        """The place, of those that have been left, that most features may be of; None where none is likely."""
        others = [p for p in self.kept if np.isin(p.ids, now.ids).sum() < LEFT * len(p.ids)]
        if len(others) > LIKELY:
            likeness = _likeness(np.stack([np.bincount(p.words, minlength=WORDS) for p in (now, *others)]))
            others = [others[k] for k in np.argsort(likeness)[-LIKELY:]]
        found = [Matches(p, *_matched(now, p)) for p in others]
        best = max(found, key=lambda m: len(m.now), default=None)
        return None if best is None or len(best.now) < FEWEST else best


def _likeness(counts: np.ndarray) -> np.ndarray:
    """Cosines between the words (p, w) of the first place and those of the others, each by how few places have it."""
    rare = np.log(len(counts) / np.maximum((counts > 0).sum(axis=0), 1))
    weighed = counts * rare
    weighed /= np.maximum(np.linalg.norm(weighed, axis=1, keepdims=True), 1e-9)
    return weighed[1:] @ weighed[0]


def _matched(now: Place, place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Rows of either that are each other's best match by a margin."""
    like = now.descriptors.astype(np.float32) @ place.descriptors.astype(np.float32).T
    if min(like.shape) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    before, rows = np.argmax(like, axis=1), np.arange(len(like))
    mutual = np.argmax(like, axis=0)[before] == rows
    rows, before = rows[mutual], before[mutual]
    others = like[rows]
    others[np.arange(len(rows)), before] = -1.0
    # Squared distances of unit vectors are 2 - 2 times their product.
    clear = 1 - like[rows, before] < MARGIN**2 * (1 - others.max(axis=1, initial=-1.0))
    return rows[clear], before[clear]
