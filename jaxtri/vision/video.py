"""Frames from a video file, a folder of images or a camera; whatever can go wrong on the way is noticed and said."""

import contextlib
import math
import os
import warnings
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Thread
from typing import Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jaxtri.errors import ResolutionChangeError, SourceWarning, TruncatedVideoError, TruncatedVideoWarning, VideoError
from jaxtri.formats import atomic_path
from jaxtri.vision import interlaced
from jaxtri.vision.layouts import IMAGE_SUFFIXES
from jaxtri.vision.masks import Masks
from jaxtri.vision.quiet import quiet
from jaxtri.vision.readers import Capture, Folder, Item

T = TypeVar("T")

DEFAULT_FPS = 25.0
"""Frames a second of a source that has no clock of its own and was given none."""


@dataclass(frozen=True)
class Frame:
    """One image of a source.

    Attributes:
        index: Place in the source, from 0; a frame that cannot be decoded is skipped, its number is not.
        time_s: Seconds.
        image: (h, w, 3) uint8, BGR.
        ignore: (h, w) where no features are looked for; None for nowhere.
    """

    index: int
    time_s: float
    image: UInt8[np.ndarray, "h w 3"]
    ignore: Bool[np.ndarray, "h w"] | None = None


@runtime_checkable
class _Reader(Protocol):
    declared: int | None
    fps: float | None
    folder: Path | None
    turned_deg: int
    pixel_aspect: float
    focal_35mm: float | None
    numbers: list[int] | None

    def read(self) -> Item | None:
        """The next frame, or None at the end."""
        ...

    def whole(self, decoded: int) -> bool:
        """Whether `decoded` frames are all that there are."""
        ...

    def close(self) -> None: ...


class FrameSource:
    """The frames of a video, folder or camera: a one-pass iterator of `Frame` and a context manager.

    Times increase strictly: a time that does not is replaced by the last one plus a frame. Gray and 16-bit images
    come as 8-bit BGR, scaled by the bits that the source uses; pictures are turned upright by the first one's
    orientation. Build one with `open_source`, which documents the errors.

    Attributes:
        name: What the source is called in messages.
        size: (width, height) in pixels.
        declared: Frames that the source claims to hold, None where it makes no claim. Containers without a count (WebM,
            MPEG) claim their duration times the rate.
        folder: Folder that holds the images, None for a video.
        fps: Nominal frames a second; `DEFAULT_FPS` where neither source nor caller says.
        timed: Whether the source or the caller says when frames were taken; `DEFAULT_FPS` is assumed otherwise.
        turned_deg: Degrees clockwise by which the stored pixels are turned, as their metadata or EXIF orientation says.
        pixel_aspect: Width of a pixel over its height, as the metadata say; the images are not resized.
        field_of_view_deg: From the left edge to the right one of a pinhole with the focal length that the first image's
            EXIF or the video's metadata say, for 35 mm film; None where none do.
        decoded: Frames handed out so far.
    """

    def __init__(self, name: str, reader: _Reader, fps: float | None, strict: bool):
        self.name = name
        self.declared, self.folder = reader.declared, reader.folder
        self.fps = fps or reader.fps or DEFAULT_FPS
        self.decoded = 0
        self._reader, self._strict, self._override = reader, strict, fps is not None
        self.timed = fps is not None or reader.fps is not None or not isinstance(reader, Folder)
        self._time = -math.inf
        self._bad: list[str] = []
        self._ended = False
        self._masks: Masks | None = None
        # The first frame is decoded here, so that a source without any fails on opening.
        try:
            self._first = self._read()
        except Exception:
            reader.close()
            raise
        if self._first is None:
            reader.close()
            raise VideoError(f"{name}: no frame can be decoded" + "".join(f"; {bad}" for bad in self._bad[:1]))
        self.size = _size(self._first)
        self.turned_deg, self.pixel_aspect = reader.turned_deg, reader.pixel_aspect
        w, h = self.size
        self.field_of_view_deg = _field_of_view_deg(reader.focal_35mm, w * self.pixel_aspect, h)
        if self.turned_deg:
            warnings.warn(
                f"{name}: the pixels are turned by {self.turned_deg} degrees, as their orientation (EXIF or metadata) "
                "says; the calibration must be that of the turned picture",
                SourceWarning,
                stacklevel=3,
            )
        if isinstance(reader, Capture) and not reader.live and np.ptp(self._first.image) == 0:
            warnings.warn(
                f"{name}: the first frame is of one colour. If the film is interlaced, OpenCV may not decode it: "
                "install jaxtri[video], or deinterlace it by ffmpeg -i FILE -vf yadif new.mp4",
                SourceWarning,
                stacklevel=3,
            )
        if not self.timed:
            warnings.warn(
                f"{name}: no list of times and no names of images say when they were taken: {DEFAULT_FPS:g} frames a "
                "second are assumed; give the rate (--fps) or a timestamps.txt",
                SourceWarning,
                stacklevel=3,
            )

    def _read(self) -> Frame | None:
        while (item := self._reader.read()) is not None:
            index, stamp, image = item
            if isinstance(image, str):
                if self._strict:
                    raise TruncatedVideoError(f"{self.name}: {image}")
                self._bad.append(image)
                continue
            if stamp is None or self._override or not math.isfinite(stamp):
                numbers = self._reader.numbers
                stamp = (index if numbers is None else numbers[index]) / self.fps
            if stamp <= self._time:
                stamp = self._time + 1 / self.fps
            self._time = stamp
            return Frame(index, stamp, _bgr8(image))
        return None

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        if self._ended:
            raise StopIteration
        frame, self._first = self._first or self._read(), None
        if frame is None:
            self._finish()
            raise StopIteration
        if (size := _size(frame)) != self.size:
            self.close()
            raise ResolutionChangeError(
                f"{self.name}: frame {frame.index} is {size[0]}x{size[1]} pixels, those before it "
                f"{self.size[0]}x{self.size[1]}; split the source where the size changes"
            )
        self.decoded += 1
        return frame if self._masks is None else replace(frame, ignore=self._masks.of(frame.index))

    def ignore(self, mask: Path) -> None:
        """Ignore what is white in a picture, or in each frame's own of a folder. Raises `VideoError`: see `Masks`."""
        self._masks = Masks(mask, self.size, None if self.folder is None else self.declared)

    def _finish(self) -> None:
        self.close()
        if not self._reader.whole(self.decoded):
            message = f"{self.name}: {self.decoded} frames decoded of {self.declared} declared"
            message += f" (first failure: {self._bad[0]})" if self._bad else "; the file ends early"
            if self._strict:
                raise TruncatedVideoError(message)
            warnings.warn(message, TruncatedVideoWarning, stacklevel=3)

    def close(self) -> None:
        """Release the file or camera; the iteration ends."""
        self._ended, self._first = True, None
        self._reader.close()

    def __enter__(self) -> "FrameSource":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def open_source(
    source: str | os.PathLike[str] | int,
    *,
    fps: float | None = None,
    strict: bool = False,
    mask: str | os.PathLike[str] | None = None,
) -> FrameSource:
    """Open a video file, a folder of images, or a camera by its number (an integer or, say, "0").

    A folder gives its images in natural order ("2" before "10", but .05 before .1), or those below it as data sets have
    them: `frames`, EuRoC's `cam0/data`, KITTI's `image_0` and `image_00/data`, TUM's `rgb`. Times come from a list
    beside them or one folder above (`timestamps.txt`, `times.txt`, `data.csv`, `rgb.txt`: seconds, whole nanoseconds or
    dates, then optionally the file's name, a line a frame), or else from the names of the files, if they are seconds
    or nanoseconds. Numbered files are `fps` apart, a missing number counts as a frame; where nothing says the rate, a
    `SourceWarning` says which is assumed. `fps` overrides the times of any source. A camera's times count from its
    first frame, by the clock of this computer. `mask` is a picture, or a folder of one a frame, of the frames' size:
    what is white in it shows no features (an overlay, a bonnet, what moves).

    Raises VideoError if there is nothing to read, the file is no video, or the time stamps or masks do not fit the
    images; ResolutionChangeError, while iterating, if the frame size changes (OpenCV's FFmpeg reader hides
    such a change by rescaling; there it goes unseen). A frame that cannot be decoded is skipped. Where
    frames are missing, or the source ends early, one TruncatedVideoWarning at the end says how many were decoded of how
    many; with `strict` a TruncatedVideoError is raised at once.
    """
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise VideoError(f"fps is {fps}; give frames a second as a positive number")
    found = _opened(source, fps, strict)
    if mask is not None:
        try:
            found.ignore(Path(mask))
        except VideoError:
            found.close()
            raise
    return found


def _opened(source: str | os.PathLike[str] | int, fps: float | None, strict: bool) -> FrameSource:
    text = str(source)
    path = Path(text)
    if isinstance(source, int) or (text.isdecimal() and not path.exists()):
        return FrameSource(f"camera {text}", Capture(int(text), f"camera {text}"), fps, strict)
    if path.is_dir():
        return FrameSource(text, Folder(path), fps, strict)
    if not path.exists():
        raise VideoError(f"{text}: no such file or folder")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise VideoError(f"{text} is a single image; give the folder of the frames")
    return FrameSource(text, interlaced.reader(path) or Capture(text, text), fps, strict)


def ahead(frames: Iterable[T], depth: int = 4) -> Generator[T, None, None]:
    """The same frames, read by a thread of their own, up to `depth` of them before they are asked for.

    What the source raises is raised where its frame would have come. Close the generator (`contextlib.closing`) when
    you leave early: after that the thread no longer uses the source.
    """
    ready: Queue[T | BaseException | None] = Queue(depth)
    left = Event()

    def read() -> None:
        last: BaseException | None = None
        try:
            for frame in frames:
                ready.put(frame)
                if left.is_set():
                    return
        except BaseException as error:
            last = error
        ready.put(last)

    reader = Thread(target=read, name="reads ahead", daemon=True)
    reader.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        left.set()
        while reader.is_alive():
            with contextlib.suppress(Empty):  # make room for one who waits to put
                ready.get(timeout=0.01)


def spool(frames: Iterable[Frame], folder: Path) -> Iterator[Frame]:
    """Pass the frames of a camera on, and keep them in `folder` as JPEG files with their times."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "timestamps.txt", "w") as stamps:
        for frame in frames:
            name = f"{frame.index:06d}.jpg"
            cv2.imwrite(str(folder / name), frame.image, [cv2.IMWRITE_JPEG_QUALITY, 95])
            stamps.write(f"{frame.time_s:.6f} {name}\n")
            stamps.flush()
            yield frame


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float) -> int:
    """Write BGR uint8 images (h, w, 3) as a video file, which appears when complete; returns their number.

    H.264 where OpenCV has an encoder, else MPEG-4 part 2 (Motion JPEG for `.avi`); an odd width or height
    loses a row or column to them. Raises VideoError for no frames or if no codec opens, and
    ResolutionChangeError if the images differ in size.
    """
    codecs = ("MJPG",) if Path(path).suffix.lower() == ".avi" else ("avc1", "mp4v")
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise VideoError(f"{path}: there are no frames to write")
    h, w = first.shape[:2]
    with atomic_path(path) as temporary:
        writer = cv2.VideoWriter()
        with quiet():
            if not any(
                writer.open(str(temporary.absolute()), cv2.VideoWriter.fourcc(*codec), fps, (w, h)) for codec in codecs
            ):
                raise VideoError(f"{path}: none of the codecs {', '.join(codecs)} opens; try a name in .mp4 or .avi")
        count = 0
        try:
            image: np.ndarray | None = first
            while image is not None:
                if image.shape != (h, w, 3):
                    raise ResolutionChangeError(f"{path}: frame {count} has shape {image.shape}, the first {(h, w, 3)}")
                writer.write(np.ascontiguousarray(image))
                count += 1
                image = next(frames, None)
        finally:
            writer.release()
    return count


def _field_of_view_deg(focal_35mm: float | None, width: float, height: float) -> float | None:
    """Of the width of a picture as it is shown, by a focal length for film of 36 by 24 mm, whose diagonal it has."""
    if focal_35mm is None:
        return None
    return 2 * math.degrees(math.atan(width / math.hypot(width, height) * math.hypot(36, 24) / (2 * focal_35mm)))


def _size(frame: Frame) -> tuple[int, int]:
    return frame.image.shape[1], frame.image.shape[0]


def _bgr8(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2 or image.shape[2] == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(image[..., :3])
