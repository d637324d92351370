"""Bars at the edges of the picture: letterbox and pillarbox."""

import numpy as np
from jaxtyping import Bool, UInt8

from jaxtri.vision.overlays import NEED, Ignored

NOISE = 8  # grey levels across that compression makes of one colour
BLACK = 24  # grey levels below which a bar is black: 16 is video's black
LEAST = 2  # rows of a bar: features keep that far away from the edge of the picture
BLOCK = 8  # rows that a code treats together: so far from the edge of a bar may what is inside colour it


class _Bar:
    """The bar at the top of pictures that are turned so that it is there."""

    def __init__(self) -> None:
        self.rows = 0  # from the top, up to its edge; 0 for none
        self.open = True  # whether there may be one: once something was seen in the first row, no more
        self._low: np.ndarray | None = None  # darkest and brightest so far of the rows of one colour
        self._high: np.ndarray | None = None
        self._edge: int | None = None  # the first row of another colour
        self._frames = self._shown = 0  # how many could show the edge, and how many did

    def see(self, image: np.ndarray, moved: bool) -> None:
        """A picture that is not of one colour, and whether it has moved enough to be another one."""
        low, high = self._range(image)
        flat = len(low)
        self.open = flat >= LEAST
        if not self.open:
            self.rows = 0
            return
        edge = _edge(image[flat : flat + BLOCK], int(low.min()), int(high.max()))
        # What is black up to a straight edge is a bar. Overexposed sky is not, nor a wall: their edge does not stay.
        black = int(high.max()) <= BLACK
        if edge is not None and (self._edge is None or flat + edge < self._edge - 1):
            self._edge, self._frames, self._shown = flat + edge, 0, 0
        if black or moved:
            self._frames += 1
            self._shown += edge is not None and self._edge is not None and abs(flat + edge - self._edge) <= 1
        found = self._shown >= (1 if black else NEED) and 2 * self._shown > self._frames
        self.rows = self._edge if found and self._edge is not None else 0

    def _range(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The darkest and the brightest of each row from the top on that has been of one colour so far."""
        if self._low is None or self._high is None:
            low, high = image.min(axis=1), image.max(axis=1)
        else:
            strip = image[: len(self._low)]
            if strip.min() >= self._low.min() and strip.max() <= self._high.max():
                return self._low, self._high
            low, high = np.minimum(self._low, strip.min(axis=1)), np.maximum(self._high, strip.max(axis=1))
        several = np.maximum.accumulate(high).astype(int) - np.minimum.accumulate(low) > NOISE
        flat = int(np.argmax(several)) if several.any() else len(several)
        if self._edge is not None and flat < self._edge - BLOCK:  # there is something in the bar
            self._edge, self._frames, self._shown = None, 0, 0
        low, high = self._low, self._high = low[:flat], high[:flat]
        return low, high


def _edge(rows: np.ndarray, low: int, high: int) -> int | None:
    """The first of some rows most of which is darker or brighter than a colour, by more than noise."""
    other = (rows < low - NOISE) | (rows > high + NOISE)
    most = 2 * np.count_nonzero(other, axis=1) > rows.shape[1]
    return int(np.argmax(most)) if most.any() else None


class Bars:
    """Finds rows at the top and the bottom, and columns at the sides, of one colour in all frames so far.

    They are bars where most of the picture beside them is of another colour, up to the same row, in most frames: not a
    sky or a night, of which only the highest roof tells where it ends. Bars that are not black are found once the
    picture has moved. A bar ends where a frame shows something in it. Frames of one colour say nothing.

    Attributes:
        mask: (h, w) the bars, None for none; another array whenever they change.
    """

    def __init__(self) -> None:
        self.mask: Bool[np.ndarray, "h w"] | None = None
        self._bars = [_Bar() for _ in range(4)]  # top, bottom, left, right
        self._first = [0] * 4  # frames
        self._ended: list[Ignored] = []
        self._shape = 0, 0

    def see(self, gray: UInt8[np.ndarray, "h w"], frame: int, moved: bool) -> None:
        """Take a frame into account; `moved` says whether the picture has moved since it last did."""
        if not any(bar.open for bar in self._bars):
            return
        some = gray[:: BLOCK // 2]
        if int(some.max()) - int(some.min()) <= NOISE:
            return
        self._shape = gray.shape
        changed = False
        for k, (bar, image) in enumerate(zip(self._bars, (gray, gray[::-1], gray.T, gray.T[::-1]), strict=True)):
            if not bar.open:
                continue
            before, rows = self._region(k), bar.rows
            bar.see(image, moved)
            changed |= bar.rows != rows
            if rows and (not bar.rows or bar.rows < rows - BLOCK):
                self._ended.append(before._replace(last=frame - 1))
                rows = 0
            if not rows:
                self._first[k] = frame
        if changed:
            top, bottom, left, right = (bar.rows for bar in self._bars)
            h, w = gray.shape
            mask = np.ones((h, w), bool)
            mask[top : h - bottom, left : w - right] = False
            self.mask = mask if mask.any() else None

    def regions(self) -> list[Ignored]:
        """The bars that were found, with those that have ended."""
        return [*self._ended, *(self._region(k) for k in range(4) if self._bars[k].rows)]

    def _region(self, k: int) -> Ignored:
        h, w = self._shape
        rows = self._bars[k].rows
        box = [(0, 0, w, rows), (0, h - rows, w, h), (0, 0, rows, h), (w - rows, 0, w, h)][k]
        return Ignored("bar", box[0], box[1], box[2] - 1, box[3] - 1, self._first[k], None)
