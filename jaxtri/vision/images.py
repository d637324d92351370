"""Image files: decoded as they are stored, the orientation that they declare, and the bits that they use."""

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

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


def read_image(path: Path) -> tuple[np.ndarray, int] | str:
    """The pixels as stored, BGR of 8 or 16 bits, and their EXIF orientation; or why they cannot be had."""
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
    return f"{path.name} is not a readable image" if image is None else (image, orientation(content))


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


def orientation(content: bytes) -> int:
    """The EXIF orientation of a JPEG or PNG file, from 1 to 8; 1 (upright) where it has none."""
    if content[:2] == b"\xff\xd8":
        at = 2
        while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
            size = struct.unpack_from(">H", content, at + 2)[0]
            if content[at + 1] == 0xE1 and content[at + 4 : at + 10] == b"Exif\0\0":
                return _tag(content[at + 10 : at + 2 + size])
            at += 2 + size
    elif content[:4] == b"\x89PNG":
        at = 8
        while at + 12 <= len(content):
            size = struct.unpack_from(">I", content, at)[0]
            if content[at + 4 : at + 8] == b"eXIf":
                return _tag(content[at + 8 : at + 8 + size])
            at += 12 + size
    return 1


def _tag(tiff: bytes) -> int:
    """Tag 0x112 of the first directory of a TIFF block."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return 1
    try:
        start = struct.unpack_from(order + "I", tiff, 4)[0]
        for k in range(struct.unpack_from(order + "H", tiff, start)[0]):
            tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, start + 2 + 12 * k)
            if tag == 0x112:
                return value if value in _UPRIGHT else 1
    except struct.error:
        pass
    return 1
