"""OpenCV and FFmpeg, silent where their errors are reported here."""

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import cv2


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
