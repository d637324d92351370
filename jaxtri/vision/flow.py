"""The flow of patches between images: pyramidal Lucas-Kanade through OpenCV, there and back."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

STEPS, CLOSE = 30, 0.003  # optical flow ends after so many steps, or when a step is shorter than so many pixels
COARSE, TILES, FLAT = 160, 3, 2.0  # pixels across, tiles each way, and deviation of grey levels that says nothing
MOST = 0.9  # share of the points whose flow the way back must reach: for the few longest all would take a level more


@dataclass(frozen=True)
class Flow:
    """How patches are followed; the attributes are those of `KLTSettings`."""

    window: int
    levels: int
    forward_backward: float
    anchor_move: float

    @property
    def reach(self) -> int:
        """Pixels from the middle of a patch that is kept to its edge."""
        return self.window // 2 + max(4, math.ceil(2 * self.anchor_move))

    def between(
        self, a: np.ndarray, b: np.ndarray, pixels: np.ndarray, guess: np.ndarray | None, levels: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions in `b`, whether tracking there and back agrees, its distance in pixels, and the eigenvalues."""
        window, stop = (self.window, self.window), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, CLOSE)
        start = (pixels if guess is None else guess).reshape(-1, 1, 2).copy()
        origin = pixels.reshape(-1, 1, 2)
        # Without a guess the flow starts where the feature was, as OpenCV's default does.
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS
        there, ok, eigenvalue = cv2.calcOpticalFlowPyrLK(a, b, origin, start, None, None, window, levels, stop, flags)
        if levels:  # on the way back, only as many levels as the flow of most points was long
            length = np.linalg.norm(there - origin, axis=2)[ok == 1]
            length = length[np.isfinite(length)]
            windows = np.quantile(length, MOST) / (self.window / 2) if length.size else 1.0
            levels = min(levels, math.ceil(math.log2(max(windows, 1.0))))
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, origin.copy(), None, None, window, levels, stop, flags)
        there, back = there.reshape(-1, 2), back.reshape(-1, 2)
        distance = np.linalg.norm(back - pixels, axis=1)
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (distance < self.forward_backward)
        return there, np.asarray(good & np.isfinite(there).all(axis=1)), distance, eigenvalue.ravel()

    def aligned(
        self, patches: np.ndarray, origin: np.ndarray, present: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where patches of other frames, about pixels `origin`, are in the `present` ones about `guess`; as `between`.

        Those that have moved by more than `anchor_move` from the guess do not agree.
        """
        # All of them stand side by side in one image, whatever frame they come from: one call follows them all.
        (then, centre), (now, _) = _mosaic(patches), _mosaic(present)
        offset = np.rint(guess) - centre
        moved, ok, *quality = self.between(then, now, centre + origin - np.rint(origin), guess - offset, 0)
        moved = moved + offset
        return moved, ok & (np.linalg.norm(moved - guess, axis=1) < self.anchor_move), quality[0], quality[1]

    def patches(self, gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Patches about the rounded pixels (n, 2): (n, side, side)."""
        r = self.reach
        padded = cv2.copyMakeBorder(gray, r, r, r, r, cv2.BORDER_REFLECT_101)
        x, y = np.rint(pixels).astype(int).T
        return np.lib.stride_tricks.sliding_window_view(padded, (2 * r + 1, 2 * r + 1))[y, x]


def _mosaic(patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patches (n, side, side) side by side in one image, and the pixel (n, 2) of the centre of each."""
    n, side = patches.shape[:2]
    columns = math.ceil(math.sqrt(n))
    rows = math.ceil(n / columns)
    tiles = np.zeros((rows * columns, side, side), np.uint8)
    tiles[:n] = patches
    row, column = np.divmod(np.arange(n), columns)
    centre = np.stack([column, row], axis=1).astype(np.float32) * side + side // 2
    image = tiles.reshape(rows, columns, side, side).swapaxes(1, 2).reshape(rows * side, columns * side)
    return image, centre


def shift_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """By how many pixels (x, y) the image has moved from `a` to `b`: that of the part that is found again best."""
    scale = COARSE / max(a.shape)
    small, other = (cv2.resize(x, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for x in (a, b))
    h, w = (n // TILES for n in small.shape[:2])
    best, shift = 0.0, np.zeros(2)
    for y, x in np.ndindex(TILES, TILES):
        tile = small[y * h : (y + 1) * h, x * w : (x + 1) * w]
        if tile.std() > FLAT:
            _, score, _, at = cv2.minMaxLoc(cv2.matchTemplate(other, tile, cv2.TM_CCOEFF_NORMED))
            if score > best:
                best, shift = score, np.array([at[0] - x * w, at[1] - y * h]) / scale
    return shift.astype(np.float32)
