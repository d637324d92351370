"""What `jaxtri.vision.video` reads from: OpenCV's captures and folders of images, one frame at a time."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxtri.errors import VideoError
from jaxtri.vision.layouts import lay_out

Item = tuple[int, float | None, np.ndarray | str]
"""Index, time in seconds if known, and the image, or the reason why it cannot be decoded."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV and FFmpeg from printing what is reported as an error or warning here."""
    # Where the level lives has changed: `cv2.setLogLevel` in 4, `cv2.utils.logging` in 5.
    module: Any = cv2 if hasattr(cv2, "setLogLevel") else getattr(cv2.utils, "logging", None)
    level = module.getLogLevel() if module else 0
    # FFmpeg's own level is read from here once, at the first opening of a process.
    added = "OPENCV_FFMPEG_LOGLEVEL" not in os.environ
    if added:
        os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "-8"
    try:
        if module:
            module.setLogLevel(0)
        yield
    finally:
        if module:
            module.setLogLevel(level)
        if added:
            os.environ.pop("OPENCV_FFMPEG_LOGLEVEL", None)


class Capture:
    """A video file or camera read by OpenCV."""

    def __init__(self, source: str | int, name: str):
        self.index, self.live = 0, isinstance(source, int)
        self.start: float | None = None
        self.folder: Path | None = None
        self.numbers: list[int] | None = None
        self.last, self.longest = 0.0, 0.0  # time of the frame before, longest time between two
        with quiet():
            self.capture = _opened(source)
            opened = self.capture.isOpened()
        if not opened:
            hint = "is it connected and free?" if self.live else "not a video that OpenCV can decode, or cut short"
            raise VideoError(f"{name}: cannot be opened; {hint}")
        count, fps = self.capture.get(cv2.CAP_PROP_FRAME_COUNT), self.capture.get(cv2.CAP_PROP_FPS)
        # Containers without an index give nonsense (-9e18 for a bare MJPEG stream).
        self.declared = int(count) if not self.live and 0 < count < 1e9 else None
        self.fps = fps if 0 < fps < 1e4 else None
        self.counted = not self.live and _is_counted(Path(str(source)))

    def whole(self, decoded: int) -> bool:
        """Whether the file was read to its end, given how many frames came out."""
        if self.declared is None or decoded >= self.declared:
            return True
        # Matroska and streams hold no count: what is declared there is duration times rate, which a variable rate, or
        # sound that goes on, makes too large. The frames then end early where their times do.
        if self.counted or self.fps is None or not self.last:
            return False
        return self.last + max(self.longest, 1 / self.fps) > (self.declared - 1.5) / self.fps

    def read(self) -> Item | None:
        """The next frame, or None at the end (a file) or when the camera stops giving any."""
        with quiet():
            ok, image = self.capture.read()
        if not ok:
            return None
        if self.live:
            now = time.monotonic()
            self.start = now if self.start is None else self.start
            stamp: float | None = now - self.start
        else:
            seconds = self.capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            stamp = seconds if 0 <= seconds < 1e9 else None
            if stamp is not None:
                self.longest, self.last = max(self.longest, stamp - self.last), stamp
        self.index += 1
        return self.index - 1, stamp, image

    def close(self) -> None:
        """Release the file or camera."""
        self.capture.release()


def _opened(source: str | int) -> cv2.VideoCapture:
    if isinstance(source, int):
        return cv2.VideoCapture(source)
    # FFmpeg takes what comes before a colon for a protocol, but not in an absolute path; where it fails OpenCV takes a
    # per cent sign for the pattern of a sequence of images.
    path = str(Path(source).absolute())
    return cv2.VideoCapture(path, cv2.CAP_FFMPEG if "%" in path else cv2.CAP_ANY)


def _is_counted(path: Path) -> bool:
    """Whether the container has an index, and with it the number of frames: MP4, MOV and AVI."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") or head[:4] == b"RIFF"


class Folder:
    """The images of a folder."""

    def __init__(self, folder: Path):
        found = lay_out(folder)
        self.files, self.times, self.numbers = found.files, found.times, found.numbers
        self.folder: Path | None = found.home
        self.declared: int | None = len(self.files)
        self.fps = float(1 / np.median(np.diff(self.times))) if self.times and self.times[1:] else None
        self.index = -1

    def whole(self, decoded: int) -> bool:
        """Whether every image could be decoded."""
        return decoded == len(self.files)

    def read(self) -> Item | None:
        """The next image, or why it cannot be decoded; None at the end."""
        self.index += 1
        if self.index >= len(self.files):
            return None
        time_s = None if self.times is None else self.times[self.index]
        return self.index, time_s, _read_image(self.files[self.index])

    def close(self) -> None:
        """Nothing is held open between images."""


def _read_image(path: Path) -> np.ndarray | str:
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        return f"{path.name} cannot be read ({error.strerror})"
    # OpenCV 4 fills up a JPEG that was cut off; what is missing then is the end-of-image marker.
    whole = data.size > 0 and (data[:2].tobytes() != b"\xff\xd8" or b"\xff\xd9" in data.tobytes())
    with quiet():
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if whole else None
    return f"{path.name} is not a readable image" if image is None else image
