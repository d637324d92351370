"""What stays in its place while the picture moves: a logo, a time code, a watermark, a bonnet, dirt on the lens."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

STEP = 4.0  # pixels that the picture moves between two looks at it: ten times the noise of a followed feature
STAY = 1 / 3  # pixels within which a feature has stayed: its noise is .1 to .4; a hand or a road shakes it by more
NEED = 10  # looks at which a cell has stayed; real sequences have three at most, in the middle of a slow turn
CREEP = 1 / 4  # share of the picture's motion below which one is slow: of features near a centre of motion
ALIKE = 0.5  # correlation with its look when it was found, above which a place has stayed as it was
AROUND = 7  # cells across, in which slow features tell a centre of motion from an overlay
GAP = 5  # cells across a gap that belongs to an overlay, as between letters, and one


class Ignored(NamedTuple):
    """A part of the picture in which no features are looked for.

    Attributes:
        kind: `overlay` or `bar`.
        left: Its first column.
        top: Its first row.
        right: Its last column.
        bottom: Its last row.
        first: Frame from which on it is ignored.
        last: Last frame in which it is; None where it is to the end.
    """

    kind: str
    left: int
    top: int
    right: int
    bottom: int
    first: int
    last: int | None


class Overlays:
    """Finds overlays by features that stay while most of the others move, in cells of the picture.

    A look is taken whenever the median feature has moved by `STEP` since the last. A cell in which features have stayed
    where they were first seen gains by one, a cell in which more features move loses one. `NEED` of these make an
    overlay. That is none of a camera that stands: nothing moves, and there is no look.

    The motion of a scene may vanish at a point: where the camera goes to, what it circles, the axis that it rolls
    about. From there it grows smoothly, so that features are found around it that go on slowly. At the rim of an
    overlay it jumps. What lies at infinity before a camera that slides without any shake cannot be told from one.

    An overlay ends where the picture there no longer looks as it did when it was found.

    Attributes:
        mask: (h, w) what is ignored, None for nothing; another array whenever it changes.
    """

    def __init__(self, shape: tuple[int, int], cell: int, capacity: int):
        self.mask: Bool[np.ndarray, "h w"] | None = None
        self._shape, self._cell = shape, cell
        cells = -(-shape[0] // cell), -(-shape[1] // cell)
        self._gain = np.zeros(cells, np.int16)
        self._stayed, self._crept = np.zeros((2, *cells), np.float32)  # features so far, the older the less
        self._found = np.zeros(cells, bool)
        self._first, self._last = np.full((2, *cells), -1)
        self._looks = np.zeros(shape, np.uint8)  # of the cells that were found, when they were
        # By slot: the feature of the last look, where it was then and when it was first seen, how it had moved since
        # the look before, and whether it has left.
        self._ids = np.full(capacity, -1, np.int64)
        self._before, self._origin, self._step = np.zeros((3, capacity, 2), np.float32)
        self._left = np.zeros(capacity, bool)

    def see(
        self,
        gray: UInt8[np.ndarray, "h w"],
        frame: int,
        pixels: Float32[np.ndarray, "n 2"],
        ids: Int[np.ndarray, " n"],
        alive: Bool[np.ndarray, " n"],
    ) -> bool:
        """Take the features of a frame, by slot, into account; returns whether the picture has moved for a look."""
        same = alive & (ids == self._ids)
        slots = np.flatnonzero(same)
        if 2 * slots.size < np.count_nonzero(alive):  # too few are left to say how it moved; an overlay's last longest
            self._remember(pixels, ids, alive, alive & ~same)
            return False
        now = pixels[slots]
        step = now - self._before[slots]
        moved = _squares(step)
        if 2 * np.count_nonzero(moved > STEP**2) <= slots.size:
            return False
        away = _squares(now - self._origin[slots])
        self._left[slots] |= away > STAY**2
        left = self._left[slots]
        slow = left & (moved < CREEP**2 * np.partition(moved, slots.size // 2)[slots.size // 2])  # of the median
        # What shines through a watermark drags its features to and fro; those near a centre of motion go on and on.
        creep = slow * np.sign((step * self._step[slots]).sum(axis=1))
        self._step[slots] = step
        self._vote(self._cells_of(now), ~left, left & (moved > STAY**2), creep)
        self._decide(gray, frame)
        self._remember(pixels, ids, alive, alive & ~same)
        return True

    def regions(self) -> list[Ignored]:
        """The overlays that were found, each as the rectangle around it."""
        ever = _closed(self._first >= 0)
        number, labels, boxes, _ = cv2.connectedComponentsWithStats(ever.astype(np.uint8))
        (h, w), found = self._shape, []
        for label in range(1, number):
            x, y, columns, rows = (int(v) * self._cell for v in boxes[label, :4])
            part = (labels == label) & (self._first >= 0)
            last = None if self._found[part].any() else int(self._last[part].max())
            right, bottom = min(x + columns, w) - 1, min(y + rows, h) - 1
            found.append(Ignored("overlay", x, y, right, bottom, int(self._first[part].min()), last))
        return found

    def _remember(self, pixels: np.ndarray, ids: np.ndarray, alive: np.ndarray, new: np.ndarray) -> None:
        self._origin[new], self._step[new], self._left[new] = pixels[new], 0, False
        self._before, self._ids = pixels.copy(), np.where(alive, ids, -1)

    def _cells_of(self, pixels: np.ndarray) -> np.ndarray:
        """The numbers of the cells that features are in."""
        rows, columns = self._gain.shape
        x, y = (pixels * (1 / self._cell)).astype(np.int32).T
        return np.minimum(y, rows - 1) * columns + np.minimum(x, columns - 1)

    def _vote(self, cells: np.ndarray, stay: np.ndarray, move: np.ndarray, creep: np.ndarray) -> None:
        """Count the features (n,) in some cells (n,) that stay and that move; `creep` is 1 or -1 of slow ones, or 0."""
        shape, size = self._gain.shape, self._gain.size
        staying, moving = (np.bincount(cells[of], minlength=size).reshape(shape) for of in (stay, move))
        creeping = np.bincount(cells, creep, size).reshape(shape)
        self._gain += (staying > 0) & (staying >= moving)
        self._gain -= moving > staying
        for sums, new in ((self._stayed, staying), (self._crept, creeping)):
            sums *= 1 - 1 / (2 * NEED)
            sums += new

    def _decide(self, gray: np.ndarray, frame: int) -> None:
        """Find new overlays, and end those that look otherwise."""
        if self._found.any():  # they have no features any more
            rows, columns = np.nonzero(self._found)
            self._gain[rows, columns] += self._alike(gray, rows, columns)
        self._gain = np.minimum(np.maximum(self._gain, 0), NEED)
        new = ~self._found & (self._gain == NEED)
        if new.any():
            near = (AROUND, AROUND)
            around = [
                cv2.boxFilter(x, -1, near, normalize=False, borderType=cv2.BORDER_CONSTANT)
                for x in (self._stayed, self._crept)
            ]
            new &= 2 * around[1] < around[0]
        ended = self._found & (self._gain == 0)
        if not (new.any() or ended.any()):
            return
        self._first[new & (self._first < 0)], self._last[ended] = frame, frame
        self._found = (self._found | new) & ~ended
        fresh = self._pixels_of(new)
        self._looks[fresh] = gray[fresh]
        self.mask = self._pixels_of(_closed(self._found)) if self._found.any() else None

    def _pixels_of(self, cells: np.ndarray) -> np.ndarray:
        h, w = self._shape
        return np.repeat(np.repeat(cells, self._cell, axis=0), self._cell, axis=1)[:h, :w]

    def _alike(self, gray: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """1 for cells that look as they did when they were found, and -1 for the others."""
        side = self._cell
        # Cells at the right and the lower edge may be cut: they are compared as far as they go.
        h, w = self._shape
        y, x = (np.minimum(np.arange(side) + n[:, None] * side, most - 1) for n, most in ((rows, h), (columns, w)))
        at = y[:, :, None], x[:, None, :]
        now, then = (image[at].reshape(len(rows), -1).astype(np.float32) for image in (gray, self._looks))
        now, then = (v - v.mean(axis=1, keepdims=True) for v in (now, then))
        scale = np.sqrt((now**2).sum(axis=1) * (then**2).sum(axis=1))
        return np.where((now * then).sum(axis=1) > ALIKE * scale, 1, -1)


def _squares(vectors: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", vectors, vectors)


def _closed(cells: np.ndarray) -> np.ndarray:
    """With the gaps between cells, as between letters."""
    return cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((GAP, GAP), np.uint8)).astype(bool)
