"""The focal length that a film's own metadata say: wherever it stands, however it is written, and however broken."""

import io
import struct

import cv2
import numpy as np
import pytest
from mp4 import change_mp4

from jaxtri.cli.cameras import FROM_EXIF, begin_camera
from jaxtri.cli.options import Track
from jaxtri.vision.quicktime import read_focal_35mm
from jaxtri.vision.video import open_source, write_video

KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
XMP = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")
TEXT = (1, b"26")


def box(kind, *content):
    joined = b"".join(content)
    return struct.pack(">I4s", 8 + len(joined), kind) + joined


def meta(*values, before=(), full=False):
    """A list of keys, the focal length's after others, and its values as (type, bytes)."""
    names = (*before, KEY)
    keys = box(b"keys", struct.pack(">II", 0, len(names)), *(box(b"mdta", name) for name in names))
    data = [box(b"data", struct.pack(">II", kind, 0), value) for kind, value in values]
    items = [box(struct.pack(">I", 1 + k), box(b"data", struct.pack(">II", 1, 0), b"7")) for k in range(len(before))]
    handler = box(b"hdlr", bytes(8), b"mdta", bytes(13))
    items = box(b"ilst", *items, box(struct.pack(">I", len(names)), *data))
    return box(b"meta", b"\0\0\0\0" if full else b"", handler, keys, items)


def film(*boxes):
    return b"".join((box(b"ftyp", b"qt  \0\0\0\0"), box(b"wide"), box(b"mdat", b"x" * 40), *boxes))


def read(content):
    return read_focal_35mm(io.BytesIO(content))


@pytest.mark.parametrize(
    ("value", "focal"),
    [
        (TEXT, 26),
        ((1, b"50.00mm"), 50),
        ((21, b"\x1a"), 26),
        ((67, struct.pack(">i", 26)), 26),
        ((22, struct.pack(">H", 300)), 300),
        ((78, struct.pack(">Q", 26)), 26),
        ((23, struct.pack(">f", 26.5)), 26.5),
        ((24, struct.pack(">d", 26.5)), 26.5),
        # What is no focal length.
        ((67, struct.pack(">i", -13)), None),
        ((23, struct.pack(">f", float("nan"))), None),
        ((1, b"wide"), None),
        ((1, b"0"), None),
        ((13, b"26"), None),
        ((24, b"\0"), None),
        ((21, b""), None),
    ],
)
def test_every_way_to_write_it_is_read(value, focal):
    assert read(film(box(b"moov", meta(value)))) == focal


def test_it_is_found_wherever_it_may_stand():
    named = meta(TEXT, before=(b"com.apple.quicktime.make", b"com.apple.quicktime.camera.lens_model"))
    packet = b'<x:xmpmeta><rdf:Description exif:FocalLengthIn35mmFilm="26"/></x:xmpmeta>'
    element = b"<exif:FocalLengthIn35mmFilm>26</exif:FocalLengthIn35mmFilm>"
    for boxes in (
        box(b"moov", box(b"mvhd", bytes(100)), named),
        box(b"moov", box(b"trak", box(b"tkhd", bytes(84)), named)),
        box(b"moov", box(b"udta", meta(TEXT, full=True))),
        box(b"moov", box(b"udta", box(b"XMP_", packet))),
        box(b"uuid", XMP, element),
        struct.pack(">I4sQ", 1, b"moov", 16 + len(named)) + named,  # of 64 bits
        struct.pack(">I4s", 0, b"moov") + named,  # to the end
    ):
        assert read(film(boxes)) == 26
    assert read(box(b"moov", named)) == 26  # without a head


def test_without_it_or_of_two_minds_there_is_none():
    one, other = box(b"trak", meta(TEXT)), box(b"trak", meta((1, b"13")))
    assert read(film(box(b"moov", one, one))) == 26
    assert read(film(box(b"moov", one, other))) is None
    assert read(film(box(b"uuid", bytes(16), b'exif:FocalLengthIn35mmFilm="26"'))) is None
    assert read(film(box(b"moov", box(b"mvhd", bytes(100))))) is None
    for other in (b"", b"RIFF" + film(box(b"moov", one)), b"\x1a\x45\xdf\xa3" + bytes(40), bytes(40)):
        assert read(other) is None


def test_broken_boxes_never_crash():
    """Cut at every byte, and every byte changed: sizes that are too large, too small, of 64 bits or to the end."""
    whole = film(box(b"moov", box(b"trak", meta(TEXT, before=(b"a",))), box(b"udta", box(b"XMP_", b"<x/>"))))
    for end in range(len(whole)):
        assert read(whole[:end]) in (None, 2, 26)  # of two digits one may be left
    for at in range(len(whole)):
        for value in (0, 1, 0xFF):
            focal = read(whole[:at] + bytes([value]) + whole[at + 1 :])
            assert focal is None or 1 <= focal <= 10_000
    assert read(film(struct.pack(">I4sQ", 1, b"free", 2**64 - 1), box(b"moov", meta(TEXT)))) is None


@pytest.mark.filterwarnings("ignore:.*the pixels are turned")
@pytest.mark.parametrize(("clockwise", "aspect"), [(0, None), (90, None), (0, (64, 45))])
def test_the_search_begins_with_the_focal_length_of_the_film(tmp_path, clockwise, aspect):
    """Of the picture as it is shown, by its diagonal; PyAV, where it is installed, reads the same of the file."""
    path = tmp_path / "a.mp4"
    scene = cv2.resize(np.random.default_rng(0).integers(0, 200, (6, 8, 3), np.uint8), (64, 48))
    write_video(path, [scene] * 3, 25.0)
    plain = open_source(path)
    assert plain.field_of_view_deg is None
    change_mp4(path, clockwise, aspect, meta(TEXT))
    w, h = (48, 64) if clockwise else (64, 48)
    if aspect:
        w *= aspect[0] / aspect[1]
    with open_source(path) as source:
        camera, prior = begin_camera(Track(str(path)), source, False)
    assert prior == FROM_EXIF
    shown = 26 * np.hypot(w, h) / np.hypot(36, 24)
    assert source.field_of_view_deg == pytest.approx(2 * np.degrees(np.arctan(w / 2 / shown)))
    np.testing.assert_allclose(camera.fy, shown)
    av = pytest.importorskip("av")
    with av.open(str(path)) as container:
        assert container.metadata[KEY.decode()] == "26"
