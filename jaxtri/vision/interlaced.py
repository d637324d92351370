"""Interlaced films, which some versions of OpenCV hand out black or as noise: decoded by PyAV, one field a frame."""

import contextlib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jaxtri.vision.quicktime import read_focal_35mm


def reader(path: Path) -> "Fields | None":
    """A reader of the film if it is interlaced and PyAV (extra `video`) is there; None otherwise."""
    try:
        av: Any = import_module("av")
    except ImportError:
        return None
    with contextlib.suppress(av.error.FFmpegError, IndexError), av.open(str(path.absolute())) as container:
        first = next(container.decode(video=0), None)
        if first is not None and first.interlaced_frame:
            return Fields(path, av)
    return None


class Fields:
    """The upper field of every frame, its missing rows interpolated: both at once show two moments in one picture."""

    def __init__(self, path: Path, av: Any):
        self._errors = av.error.FFmpegError
        self._container = av.open(str(path.absolute()))
        self._stream = self._container.streams.video[0]
        rate, aspect = self._stream.average_rate, self._stream.sample_aspect_ratio
        self.declared: int | None = self._stream.frames or None
        self.fps = float(rate) if rate else None
        self.folder: Path | None = None
        self.numbers: list[int] | None = None
        self.turned_deg, self.pixel_aspect = 0, float(aspect) if aspect else 1.0
        with path.open("rb") as file:
            self.focal_35mm = read_focal_35mm(file)
        self.index = 0
        self._frames: Iterator[Any] = self._container.decode(video=0)

    def read(self) -> tuple[int, float | None, np.ndarray | str] | None:
        """The next frame, or None at the end."""
        try:
            frame = next(self._frames, None)
            image = None if frame is None else frame.to_ndarray(format="bgr24")
        except self._errors:
            return None
        if frame is None or image is None:
            return None
        since = None if frame.pts is None else frame.pts - (self._stream.start_time or 0)
        self.index += 1
        time_s = None if since is None else float(since * frame.time_base)
        return self.index - 1, time_s, upper_field(image)

    def whole(self, decoded: int) -> bool:
        """Whether the file was read to its end, where it says how many frames it holds."""
        return self.declared is None or decoded >= self.declared

    def close(self) -> None:
        """Release the file."""
        self._container.close()


def upper_field(image: np.ndarray) -> np.ndarray:
    """The picture (h, w, 3) of the even rows alone; an odd row is the mean of those beside it."""
    rows = image[::2]
    below = np.concatenate([rows[1:], rows[-1:]])
    found = image.copy()
    found[1::2] = ((rows.astype(np.uint16) + below + 1) // 2)[: len(image) // 2]
    return found
