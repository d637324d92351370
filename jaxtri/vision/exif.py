"""What the EXIF block of an image file says of the camera. Source: CIPA DC-008, "Exchangeable image file format"."""

import struct
from collections.abc import Iterator
from typing import NamedTuple

ORIENTATION, PRIVATE, FOCAL_35MM = 0x112, 0x8769, 0xA405  # tags; the second leads to the directory of the third


class Exif(NamedTuple):
    """Of one image.

    Attributes:
        orientation: From 1 to 8; 1 (upright) where there is none.
        focal_35mm: Focal length in millimetres that on 35 mm film has the same diagonal field of view; None where that
            is not said.
    """

    orientation: int = 1
    focal_35mm: float | None = None


def read_exif(content: bytes) -> Exif:
    """Of the bytes of a JPEG or PNG file; of another one that there is none."""
    tiff = next(_blocks(content), b"")
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return Exif()
    found = _directory(tiff, order, 4)
    private = _directory(tiff, order, found[PRIVATE]) if PRIVATE in found else {}
    orientation, focal = (
        struct.unpack_from(order + "H", tiff, tags[tag])[0] if tag in tags else 0
        for tags, tag in ((found, ORIENTATION), (private, FOCAL_35MM))
    )
    return Exif(orientation if 1 <= orientation <= 8 else 1, float(focal) or None)


def _blocks(content: bytes) -> Iterator[bytes]:
    """TIFF blocks that say EXIF of themselves."""
    if content[:2] == b"\xff\xd8":
        at = 2
        while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
            size = struct.unpack_from(">H", content, at + 2)[0]
            if content[at + 1] == 0xE1 and content[at + 4 : at + 10] == b"Exif\0\0":
                yield content[at + 10 : at + 2 + size]
            at += 2 + size
    elif content[:4] == b"\x89PNG":
        at = 8
        while at + 12 <= len(content):
            size = struct.unpack_from(">I", content, at)[0]
            if content[at + 4 : at + 8] == b"eXIf":
                yield content[at + 8 : at + 8 + size]
            at += 12 + size


def _directory(tiff: bytes, order: str, pointer: int) -> dict[int, int]:
    """Where the values of the tags stand, in the directory that is pointed to."""
    found: dict[int, int] = {}
    try:
        start = struct.unpack_from(order + "I", tiff, pointer)[0]
        for k in range(struct.unpack_from(order + "H", tiff, start)[0]):
            at = start + 2 + 12 * k
            found[struct.unpack_from(order + "HHII", tiff, at)[0]] = at + 8
    except struct.error:
        pass  # cut short: what stands before is as good
    return found
