"""Figures of single pictures: exposure, blur, combing, and how two pictures differ."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt8

WIDE = 640  # pixels across: larger pictures are looked at smaller, or in their middle alone, for speed
THUMBNAIL, SOFT = (64, 48), 1.5  # its pixels, and their blur: so that neither noise nor blur changes its colours
BINS = 8  # of each colour channel
ENDS = 2  # grey levels from either end that count as clipped: coding moves them by as much
SMOOTH, REBLUR = 0.8, 9  # pixels: against noise; and the blur that a blurred picture hardly notices
STRONG = 0.95  # share of the pixels that have weaker edges than those by which blur is told
STANDS_OUT = 8  # grey levels by which a row must differ from both beside it
COARSE, FINE, PARTS, SPREAD = 160, (1.0, 4.0), (8, 6), 8.0  # of contrast: pixels across, band, parts, their blur


@dataclass(frozen=True)
class Glance:
    """What tells one shot from another: little of a picture, and soon worked out.

    Attributes:
        grey: The picture in grey, at most `WIDE` pixels across.
        colours: Histogram of the thumbnail, its mean brought to the middle of the scale; sums to 1.
        contrast: Mean square of the fine structure in each part, over that of the brightness; never zero.
    """

    grey: UInt8[np.ndarray, "h w"]
    colours: Float[np.ndarray, " bins"]
    contrast: Float[np.ndarray, " parts"]

    @classmethod
    def of(cls, image: UInt8[np.ndarray, "h w 3"], grey: UInt8[np.ndarray, "h w"]) -> "Glance":
        """Of a BGR picture, and the same in grey."""
        small = _small(grey)
        return cls(small, _colours(image), _contrast(small))

    @cached_property
    def blur(self) -> float:
        """0 (sharp) to 1 (blurred in at least one direction)."""
        return _blur(self.grey)

    def recoloured(self, before: "Glance") -> float:
        """The share whose colours are others."""
        return float(1 - np.minimum(self.colours, before.colours).sum())


@dataclass(frozen=True)
class Look(Glance):
    """Figures of one picture; see `jaxtri.vision.survey.Survey`.

    Attributes:
        brightness: Mean grey level, 0 to 1.
        black: Share of the pixels at the lower end of the scale.
        white: Share of the pixels at its upper end.
        combing: Share of the pixels that differ from both rows beside them, less three times the columns' share.
    """

    brightness: float
    black: float
    white: float
    combing: float

    def against(self, before: "Look") -> tuple[float, float]:
        """Mean absolute difference in grey levels, and the share whose colours are others."""
        return float(cv2.absdiff(self.grey, before.grey).mean()), self.recoloured(before)


def look(image: UInt8[np.ndarray, "h w 3"]) -> Look:
    """The figures of a BGR picture."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    step = max(1, round(max(grey.shape) / WIDE))
    levels = np.bincount(grey[::step, ::step].ravel(), minlength=256) / grey[::step, ::step].size
    return Look(
        **vars(Glance.of(image, grey)),
        brightness=float(levels @ np.arange(256)) / 255,
        black=float(levels[: ENDS + 1].sum()),
        white=float(levels[-ENDS - 1 :].sum()),
        combing=_combing(_middle(grey)),
    )


def _small(grey: np.ndarray) -> np.ndarray:
    scale = WIDE / max(grey.shape)
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey


def _middle(grey: np.ndarray) -> np.ndarray:
    y, x = (max(0, (n - WIDE) // 2) for n in grey.shape)
    return grey[y : y + WIDE, x : x + WIDE]


def _blur(grey: np.ndarray) -> float:
    """How little a blur changes the strongest edges, in the direction that it changes least.

    After Crete, Dolmiere, Ladret and Nicolas, "The blur effect: perception and estimation with a new no-reference
    perceptual blur metric", SPIE 2007; there over all edges, of which noise makes most of a dark picture.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTH).astype(np.float32)
    found = 0.0
    for axis, size in ((0, (1, REBLUR)), (1, (REBLUR, 1))):
        edge = np.abs(np.diff(smooth, axis=axis))
        again = np.abs(np.diff(cv2.blur(smooth, size), axis=axis))
        strong = edge >= max(float(np.quantile(edge[::4, ::4], STRONG)), 0.5)
        if not strong.any():
            return 1.0
        left = np.minimum(again[strong], edge[strong]).sum() / edge[strong].sum()
        found = max(found, float(left))
    return found


def _combing(grey: np.ndarray) -> float:
    def share(levels: np.ndarray) -> float:
        above, below = levels[1:-1] - levels[:-2], levels[1:-1] - levels[2:]
        alike = np.abs(levels[2:] - levels[:-2])  # rows of one field
        least = np.where((above > 0) == (below > 0), np.minimum(np.abs(above), np.abs(below)), 0)
        return float((least > alike + STANDS_OUT).mean()) if least.size else 0.0

    levels = grey.astype(np.int16)
    return max(0.0, share(levels) - 3 * share(np.ascontiguousarray(levels.T)))


def _colours(image: np.ndarray) -> np.ndarray:
    # All but the margins, so that each pixel is the mean of a block: other ratios take OpenCV ten times as long.
    (h, w), (width, height) = image.shape[:2], THUMBNAIL
    rows, columns = h - h % height if h > height else h, w - w % width if w > width else w
    y, x = (h - rows) // 2, (w - columns) // 2
    blocks = image[y : y + rows, x : x + columns]
    small = cv2.resize(blocks, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
    small = cv2.GaussianBlur(small, (0, 0), SOFT, borderType=cv2.BORDER_REFLECT)
    # A flash or a lamp that flickers makes the same picture brighter.
    level = np.clip(small * (128 / max(float(small.mean()), 1.0)), 0, 255).astype(np.uint8)
    counts = cv2.calcHist([level], [0, 1, 2], None, [BINS] * 3, [0, 256] * 3).ravel()
    return (counts / counts.sum()).astype(np.float64)


def _contrast(grey: np.ndarray) -> np.ndarray:
    scale = COARSE / max(grey.shape)
    coarse = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    fine, rough = (cv2.GaussianBlur(coarse, (0, 0), sigma) for sigma in FINE)
    square = cv2.resize(cv2.GaussianBlur((fine - rough) ** 2, (0, 0), SPREAD), PARTS, interpolation=cv2.INTER_AREA)
    # Less than a grey level is noise, and so is the brightness of what is all but black.
    return (np.maximum(square, 1) / max(float(coarse.mean()), 8) ** 2).ravel().astype(np.float64)
