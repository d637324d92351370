"""Places that were seen before: the features of some frames are described, and found again in later ones.

A place is a frame whose features are kept, with a descriptor and the patch of each. One is kept whenever more than half
of the features of the last one are gone, and is looked for among the others then. The descriptor is ORB's at the
feature itself, upright: a pattern of comparisons, 256 bits (Rublee et al. 2011). Two features are one where each is the
other's best match by a margin; whether their patches are one is for the flow to say. Of many places those are matched
that have most words in common, rare ones above all; the words are the first descriptors of the sequence (Sivic &
Zisserman 2003).
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
LIKELY = 2  # places that are
ACROSS = 31.0  # pixels of a picture that are compared


class Place(NamedTuple):
    """The features of a frame.

    Attributes:
        frame: Its number.
        ids: (n,) numbers of the features.
        pixels: (n, 2) where they are.
        descriptors: (n, 32) uint8, of bits.
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
        kept: Those that are kept, in order.
    """

    kept: list[Place] = field(default_factory=list)

    def __post_init__(self) -> None:
        # One level, and no edge at which features are left out: they are given, and the picture is reflected there.
        self._orb = cv2.ORB.create(nlevels=1, edgeThreshold=0, patchSize=int(ACROSS))
        self._words = np.zeros((0, 32), np.uint8)

    def due(self, ids: np.ndarray) -> bool:
        """Whether too little is left of the last place, for features of these numbers (n,)."""
        if not self.kept:
            return len(ids) >= FEWEST
        last = self.kept[-1].ids
        return len(ids) >= FEWEST and int(np.isin(last, ids).sum()) < GONE * len(last)

    def place(self, frame: int, gray: np.ndarray, ids: np.ndarray, pixels: np.ndarray, patches: np.ndarray) -> Place:
        """The features of a frame, described."""
        points = [cv2.KeyPoint(float(x), float(y), ACROSS, 0.0, 0.0, 0, k) for k, (x, y) in enumerate(pixels)]
        there, found = self._orb.compute(gray, points)
        described = np.zeros((len(ids), 32), np.uint8)
        described[[point.class_id for point in there]] = found
        if len(self._words) < WORDS:
            self._words = np.concatenate([self._words, described])[:WORDS]
        words = np.array([match.trainIdx for match in _MATCHER.match(described, self._words)], int)
        return Place(frame, ids, pixels.astype(np.float32), described, patches, words)

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


_MATCHER = cv2.BFMatcher(cv2.NORM_HAMMING)


def _matched(now: Place, place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Rows of either that are each other's best match by a margin."""
    two = _MATCHER.knnMatch(now.descriptors, place.descriptors, k=2)
    clear = [best for best, *other in two if other and best.distance < MARGIN * other[0].distance]
    rows, before = (np.array([getattr(m, of) for m in clear], int) for of in ("queryIdx", "trainIdx"))
    back = np.array([m.trainIdx for m in _MATCHER.match(place.descriptors[before], now.descriptors)], int)
    return rows[back == rows], before[back == rows]
