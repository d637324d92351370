"""Dissolves between two shots: pictures that are a mixture of an earlier and a later one, however the camera moves.

A mixture with the shares a and 1 - a of two pictures that have nothing to do with one another has, part by part, a²
times the contrast (`Look.contrast`, a mean square) of the one and (1 - a)² times that of the other: less than lies
between the two. What moves takes the contrast of a part from the one to the other, and it lies between. So nothing need
be aligned, which no optical flow does where two pictures shine through one another. After Alattar, "Detecting and
compressing dissolve regions in video sequences", ISCAS 1993, where it is the variance of the whole picture.
"""

from collections import deque

import numpy as np

from jaxtri.vision.pictures import Glance

SPANS = 5, 9, 13, 17
"""Frames before and after a picture that it is compared with: the answer is final so many frames later."""

# Found on rendered clips, dissolves between them, and copies of them with blur and dips of brightness.
LEAST = 2  # frames in a row that are mixed: by chance one may be
MIXED = 0.75  # `mixture` (22 rendered shots and seven sequences that are tracked have .87 and more)
_CLOSE = 0.65  # residual of the logarithms up to which a mixture explains the contrast at all
_MIDDLE = 0.2  # share that the weaker picture has at least: with less a mixture is hardly one
_BLURRIER = 0.1  # `Look.blur` over that of both others: a blur takes contrast, too
_OTHERS = 0.15  # share of the colours that are others after than before: less is one shot, whatever dims it meanwhile
_SHARES = np.linspace(_MIDDLE, 1 - _MIDDLE, 31)[:, None]


class Dissolves:
    """Looks at one picture after another.

    Attributes:
        mixed: Of every picture so far what `mixture` says at best, of all spans that have been seen; 1 where none has.
    """

    def __init__(self) -> None:
        self.mixed: list[float] = []
        self._seen: deque[Glance] = deque(maxlen=2 * SPANS[-1] + 1)

    def add(self, now: Glance) -> None:
        """The next picture; what it says of those before it."""
        self._seen.append(now)
        self.mixed.append(1.0)
        for span in SPANS:
            if len(self._seen) > 2 * span:
                found = mixture(self._seen[-1 - 2 * span], self._seen[-1 - span], now)
                self.mixed[-1 - span] = min(self.mixed[-1 - span], found)

    def beyond(self, frame: int) -> int | None:
        """First frame of a dissolve that lasts until `frame` or longer, of the latest ones; None where there is none.

        A dissolve is at least `LEAST` frames in a row that are mixed.
        """
        begun, found = max(0, len(self.mixed) - 2 * SPANS[-1] - 1), None
        for k in range(begun, len(self.mixed)):
            if self.mixed[k] >= MIXED:
                begun = k + 1
            elif k >= frame and k - begun + 1 >= LEAST:
                found = begun
        return found


def mixture(before: Glance, now: Glance, after: Glance) -> float:
    """What a mixture leaves unexplained of the contrast, over what a picture between does; 1 where it is none."""
    if after.recoloured(before) < _OTHERS:
        return 1.0
    contrast, a, b = np.log(now.contrast), before.contrast, after.contrast
    mixed = _residuals(contrast, _SHARES**2 * a + (1 - _SHARES) ** 2 * b)
    between = _residuals(contrast, np.linspace(0, 1, 31)[:, None] * (a - b) + b)
    if mixed.argmin() in (0, len(mixed) - 1) or mixed.min() > min(_CLOSE, between.min()):
        return 1.0
    if now.blur > max(before.blur, after.blur) + _BLURRIER:  # last, since it takes longest to work out
        return 1.0
    return float(mixed.min() / max(between.min(), 1e-6))


def _residuals(contrast: np.ndarray, models: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((contrast - np.log(models)) ** 2, axis=1))
