"""What the metadata of a QuickTime or MP4 file say of the camera.

Sources: Apple, "QuickTime File Format", metadata atoms and well-known types; Adobe, "XMP Specification Part 3", MPEG-4
and QuickTime.
"""

import re
import struct
from collections.abc import Iterator
from io import BufferedIOBase

BEGINS = (b"ftyp", b"moov", b"mdat", b"wide", b"free")
"""Kinds of the box that such a file begins with."""

_FOCAL = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_XMP = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")  # of a `uuid` box; in `udta` it is a box of its own kind
_XMP_FOCAL = re.compile(rb"""exif:FocalLengthIn35mmFilm(?:\s*=\s*["']|>)\s*(\d{1,4})\b""")
_NUMBER = re.compile(rb"\s*(\d+(?:\.\d*)?)")  # "26", "50.00mm"
_FLOATS = {23: ">f", 24: ">d"}
_INTEGERS = {21: True, 22: False, 65: True, 66: True, 67: True, 74: True, 75: False, 76: False, 77: False, 78: False}
_LIKELY = (1, 10_000)  # millimetres: what lies outside is no focal length
_MOST = 1 << 26  # bytes of a box that are read: an hour's film has a few million


def read_focal_35mm(file: BufferedIOBase) -> float | None:
    """Focal length in millimetres that on 35 mm film has the same diagonal field of view, as a whole film has it.

    None where the file is no such one, is broken before it is said, does not say it, or says several that differ.
    """
    found = {focal for focal in _said(file) if focal is not None and _LIKELY[0] <= focal <= _LIKELY[1]}
    return found.pop() if len(found) == 1 else None


def _said(file: BufferedIOBase) -> Iterator[float | None]:
    for kind, content in _outer(file):
        if kind == b"uuid" and content[:16] == _XMP:
            yield _of_xmp(content)
        elif kind == b"moov":
            for inner, part in _boxes(content):
                if inner == b"meta":
                    yield from _of_meta(part)
                elif inner in (b"trak", b"udta"):
                    for innermost, piece in _boxes(part):
                        if innermost == b"meta":
                            yield from _of_meta(piece)
                        elif innermost == b"XMP_":
                            yield _of_xmp(piece)


def _outer(file: BufferedIOBase) -> Iterator[tuple[bytes, bytes]]:
    """The boxes of a file that may hold metadata, without reading the film itself."""
    at, end = 0, file.seek(0, 2)
    while at < end:
        file.seek(at)
        head = file.read(16)
        if len(head) < 8 or (at == 0 and head[4:8] not in BEGINS):
            return
        size, start = _extent(head, 0, _MOST)
        if size < start:
            return
        if head[4:8] in (b"moov", b"uuid"):
            file.seek(at + start)
            yield head[4:8], file.read(min(size - start, _MOST))
        at += size


def _boxes(content: bytes, at: int = 0) -> Iterator[tuple[bytes, bytes]]:
    """Kinds and contents of boxes side by side; one that is cut short has what is left of it."""
    while at + 8 <= len(content):
        size, start = _extent(content, at, len(content) - at)
        if size < start:
            return
        yield content[at + 4 : at + 8], content[at + start : at + size]
        at += size


def _extent(content: bytes, at: int, left: int) -> tuple[int, int]:
    """Size of a box and where in it its content starts; a size that cannot be is 0."""
    size = struct.unpack_from(">I", content, at)[0]
    if size == 1:  # it did not fit
        return (struct.unpack_from(">Q", content, at + 8)[0] if at + 16 <= len(content) else 0), 16
    return size or left, 8


def _of_meta(meta: bytes) -> Iterator[float | None]:
    """A list of keys, and a list of items whose kinds are the numbers of their keys, from 1."""
    # MP4 has a version before the boxes, QuickTime has none.
    boxes = dict(_boxes(meta, 0 if meta[4:8] == b"hdlr" else 4))
    # A key is laid out as a box is: its size, the space of its name, and the name.
    keys = [name for _, name in _boxes(boxes.get(b"keys", b""), 8)]
    for number, item in _boxes(boxes.get(b"ilst", b"")):
        k = int.from_bytes(number, "big") - 1
        if 0 <= k < len(keys) and keys[k] == _FOCAL:
            yield from (_number(data) for kind, data in _boxes(item) if kind == b"data")


def _number(data: bytes) -> float | None:
    """A type, a language, and the value."""
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind == 1 and (text := _NUMBER.match(value)):
        return float(text[1])
    if kind in _FLOATS and len(value) == struct.calcsize(_FLOATS[kind]):
        return float(struct.unpack(_FLOATS[kind], value)[0])
    if kind in _INTEGERS and 0 < len(value) <= 8:
        return float(int.from_bytes(value, "big", signed=_INTEGERS[kind]))
    return None


def _of_xmp(packet: bytes) -> float | None:
    found = _XMP_FOCAL.search(packet)
    return float(found[1]) if found else None
