"""What `jaxtri.vision.video` reads from: OpenCV's captures and folders of images, one frame at a time."""

import time
import warnings
from pathlib import Path

import cv2
import numpy as np

from jaxtri.errors import SourceWarning, VideoError
from jaxtri.vision.exif import Exif
from jaxtri.vision.images import CLOCKWISE, bits_in_use, read_image, turned
from jaxtri.vision.layouts import lay_out
from jaxtri.vision.quicktime import BEGINS, read_focal_35mm
from jaxtri.vision.quiet import quiet

Item = tuple[int, float | None, np.ndarray | str]
"""Index, time in seconds if known, and the image, or the reason why it cannot be decoded."""


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
        # Whether the picture is turned as its metadata say by default differs between versions of OpenCV.
        upright = not self.live and self.capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self.turned_deg = round(self.capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360 if upright else 0
        sar = self.capture.get(cv2.CAP_PROP_SAR_NUM), self.capture.get(cv2.CAP_PROP_SAR_DEN)
        aspect = sar[0] / sar[1] if min(sar) > 0 and not self.live else 1.0
        self.pixel_aspect = 1 / aspect if self.turned_deg in (90, 270) else aspect
        self.counted, self.focal_35mm = (False, None) if self.live else _of_container(Path(str(source)))

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


def _of_container(path: Path) -> tuple[bool, float | None]:
    """Whether it has an index, and with it the number of frames: MP4, MOV and AVI. And the focal length, if said."""
    with path.open("rb") as file:
        head = file.read(12)
        return head[4:8] in BEGINS or head[:4] == b"RIFF", read_focal_35mm(file)


class Folder:
    """The images of a folder."""

    def __init__(self, folder: Path):
        found = lay_out(folder)
        self.files, self.times, self.numbers = found.files, found.times, found.numbers
        self.folder: Path | None = found.home
        self.declared: int | None = len(self.files)
        self.fps = float(1 / np.median(np.diff(self.times))) if self.times and self.times[1:] else None
        self.orientation: int | None = None  # EXIF's, of the first image
        self.turned_deg, self.pixel_aspect = 0, 1.0
        self.focal_35mm: float | None = None  # of the first image
        self.bits: int | None = None  # in use, of images of 16
        self.said = False  # that the orientation changes
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
        found = read_image(self.files[self.index])
        return self.index, time_s, found if isinstance(found, str) else self._as_first(*found)

    def _as_first(self, image: np.ndarray, exif: Exif) -> np.ndarray:
        """The picture with 8 bits, turned as the first one says."""
        name, orientation = self.files[self.index].name, exif.orientation
        if self.orientation is None:
            self.orientation, self.turned_deg = orientation, CLOCKWISE[orientation]
            self.focal_35mm = exif.focal_35mm
        elif orientation != self.orientation and not self.said:
            # A camera writes which way is up as its gravity sensor sees it; its pixels stay those of one sensor.
            self.said = True
            warnings.warn(
                f"{name}: the EXIF orientation changes from {self.orientation} to {orientation} here; all images are "
                "turned as the first one says",
                SourceWarning,
                stacklevel=2,
            )
        if image.dtype == np.uint16:
            if self.bits is None:
                self.bits = bits_in_use(self.files)
                if self.bits < 16:
                    message = f"{name}: these images of 16 bits use only {self.bits} bits, and are read as such"
                    warnings.warn(message, SourceWarning, stacklevel=2)
            image = np.minimum(image >> (self.bits - 8), 255).astype(np.uint8)
        return turned(image, self.orientation)

    def close(self) -> None:
        """Nothing is held open between images."""
