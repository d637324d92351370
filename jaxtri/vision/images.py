"""Image files: decoded as they are stored, turned as they declare, and the bits that they use."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxtri.vision.exif import Exif, read_exif
from jaxtri.vision.quiet import quiet

# What brings a picture of each EXIF orientation upright: (transpose, flip rows, flip columns).
_UPRIGHT = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}
CLOCKWISE = {1: 0, 2: 0, 3: 180, 4: 180, 5: 90, 6: 90, 7: 270, 8: 270}
"""Degrees by which a picture of each EXIF orientation is turned; 2, 4, 5 and 7 are mirrored besides."""

_DEPTHS = (8, 10, 12, 14, 16)  # bits that cameras have
_LOOKED_AT = 5  # images of a folder by which the bits in use are told


def read_image(path: Path) -> tuple[np.ndarray, Exif] | str:
    """The pixels as stored, BGR of 8 or 16 bits, and what their EXIF says; or why they cannot be had."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        return f"{path.name} cannot be read ({error.strerror})"
    content = data.tobytes()
    # OpenCV 4 fills up a JPEG that was cut off; what is missing then is the end-of-image marker.
    whole = data.size > 0 and (content[:2] != b"\xff\xd8" or b"\xff\xd9" in content)
    image = None
    with quiet():
        for depth in (cv2.IMREAD_ANYDEPTH, 0):
            # Orientation is left to `turned`: OpenCV would turn every image by its own.
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | depth
            image = cv2.imdecode(data, flags) if whole else None
            if image is None or image.dtype in (np.uint8, np.uint16):
                break
    return f"{path.name} is not a readable image" if image is None else (image, read_exif(content))


def turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """The picture as a viewer shows it, given its EXIF orientation."""
    transpose, rows, columns = _UPRIGHT[orientation]
    image = image.swapaxes(0, 1) if transpose else image
    return np.ascontiguousarray(image[:: -1 if rows else 1, :: -1 if columns else 1])


def bits_in_use(files: Sequence[Path]) -> int:
    """How many bits the 16-bit images of a folder use, told by the brightest pixel of a few of them.

    Industrial cameras store 10 or 12 bits in files of 16; read as 16 these are all but black.
    """
    brightest = -1
    for k in np.unique(np.linspace(0, len(files) - 1, _LOOKED_AT).astype(int)):
        found = read_image(files[k])
        if not isinstance(found, str) and found[0].dtype == np.uint16:
            brightest = max(brightest, int(found[0].max()))
    return next(bits for bits in _DEPTHS if brightest < 2**bits)
