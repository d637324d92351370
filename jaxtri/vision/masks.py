"""Which pixels of the frames are to be ignored: one picture for all, or a folder of one a frame; white is ignored."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from jaxtri.errors import VideoError
from jaxtri.vision.images import read_image, turned
from jaxtri.vision.layouts import lay_out


class Masks:
    """Masks of a source's frames.

    Raises `VideoError` where a mask cannot be read, is of another size than the frames, or leaves nothing of them; and
    where a folder has not as many as there are frames.
    """

    def __init__(self, path: Path, size: tuple[int, int], frames: int | None):
        if not path.exists():
            raise VideoError(f"mask {path}: no such file or folder")
        self._path, self._size, self._one = path, size, not path.is_dir()
        self._files = [path] if self._one else lay_out(path).files
        self._last: tuple[int, np.ndarray] | None = None
        if not self._one and frames is not None and frames != len(self._files):
            raise VideoError(
                f"mask {path} holds {len(self._files)} pictures for {frames} frames: give one a frame, or a single "
                "picture for all"
            )
        self.of(0)

    def of(self, index: int) -> Bool[np.ndarray, "h w"]:
        """The pixels of a frame that are to be ignored; of one picture for all the same array every time."""
        index = 0 if self._one else index
        if self._last is None or self._last[0] != index:
            self._last = index, self._read(index)
        return self._last[1]

    def _read(self, index: int) -> np.ndarray:
        if index >= len(self._files):
            raise VideoError(f"mask {self._path} holds {len(self._files)} pictures, none for frame {index}")
        file = self._files[index]
        found = read_image(file)
        if isinstance(found, str):
            raise VideoError(f"mask {file}: {found}")
        image = turned(found[0], found[1].orientation)
        (h, w), (width, height) = image.shape[:2], self._size
        if (w, h) != (width, height):
            raise VideoError(f"mask {file} is {w}x{h}, the frames are {width}x{height}: draw it over one of the frames")
        ignored = image.max(axis=2) > np.iinfo(image.dtype).max // 2
        if ignored.all():
            raise VideoError(f"mask {file} is white all over, and white is ignored: is it inverted?")
        return ignored
