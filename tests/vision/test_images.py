"""Pixels as they are stored and as they are meant: bits, orientation, aspect."""

import json
import re
import struct
import sys

import cv2
import numpy as np
import pytest
from mp4 import change_mp4

from jaxtri.cli import main
from jaxtri.cli.cameras import FROM_EXIF, begin_camera
from jaxtri.cli.options import Track, _Input
from jaxtri.errors import SourceWarning
from jaxtri.vision.exif import read_exif
from jaxtri.vision.images import CLOCKWISE
from jaxtri.vision.video import open_source, write_video

pytestmark = pytest.mark.filterwarnings("ignore:.*frames a second are assumed")
RNG = np.random.default_rng(0)
SCENE = cv2.resize(RNG.integers(0, 200, (6, 8, 3), np.uint8), (64, 48))


def with_exif(jpeg, orientation, order="<", focal_35mm=None):
    mark = {"<": b"II", ">": b"MM"}[order]
    tiff = struct.pack(order + "2sHIHHHIHHI", mark, 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    if focal_35mm is not None:  # in a directory of its own, which the first one leads to
        first = struct.pack(order + "HHHIHHHHIII", 2, 0x0112, 3, 1, orientation, 0, 0x8769, 4, 1, 38, 0)
        tiff = tiff[:8] + first + struct.pack(order + "HHHIHHI", 1, 0xA405, 3, 1, focal_35mm, 0, 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 8 + len(tiff)) + b"Exif\0\0" + tiff + jpeg[2:]


def save(folder, orientations, order="<"):
    folder.mkdir()
    jpeg = cv2.imencode(".jpg", SCENE)[1].tobytes()
    for k, orientation in enumerate(orientations):
        (folder / f"{k}.jpg").write_bytes(with_exif(jpeg, orientation, order))


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_a_viewer_turns_them(tmp_path, orientation, order):
    """OpenCV's own reading of a file is the twin."""
    save(tmp_path / "f", [orientation], order)
    with pytest.warns(SourceWarning):
        source = open_source(tmp_path / "f")
    assert source.turned_deg == CLOCKWISE[orientation]
    np.testing.assert_array_equal(next(source).image, cv2.imread(str(tmp_path / "f" / "0.jpg")))


@pytest.mark.parametrize("order", "<>")
def test_the_search_begins_with_the_focal_length_of_the_exif(tmp_path, order):
    jpeg = cv2.imencode(".jpg", SCENE)[1].tobytes()
    (tmp_path / "0.jpg").write_bytes(with_exif(jpeg, 1, order, 28))
    with open_source(tmp_path) as source:
        camera, prior = begin_camera(Track(str(tmp_path)), source, False)
    # On 36 x 24 mm of film, by the diagonal.
    np.testing.assert_allclose(camera.fx, 28 * np.hypot(64, 48) / np.hypot(36, 24))
    assert source.field_of_view_deg == pytest.approx(2 * np.degrees(np.arctan(32 / float(camera.fx))))
    assert prior == FROM_EXIF
    pillow = pytest.importorskip("PIL.Image")  # the twin
    with pillow.open(tmp_path / "0.jpg") as image:
        assert image.getexif().get_ifd(0x8769)[0xA405] == 28
    for end in range(12, len(with_exif(b"", 1, order, 28))):  # cut short anywhere
        assert read_exif(with_exif(b"\xff\xd8", 1, order, 28)[:end]).orientation == 1


def test_an_orientation_that_changes_midway_is_said_and_turns_nothing(tmp_path):
    save(tmp_path / "f", [1, 1, 3, 3, 6])
    with pytest.warns(SourceWarning, match=r"2\.jpg: the EXIF orientation changes from 1 to 3") as said:
        images = [frame.image for frame in open_source(tmp_path / "f")]
    assert sum("EXIF" in str(w.message) for w in said) == 1
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_images_of_16_bits_are_scaled_by_the_bits_in_use_once_for_all(tmp_path, bits):
    gray = [np.full((48, 64), level, np.uint8) for level in (60, 150, 30)]
    gray[1][0, 0] = 255
    for k, image in enumerate(gray):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image.astype(np.uint16) << (bits - 8))
    source = open_source(tmp_path, fps=1) if bits == 16 else None
    if source is None:
        with pytest.warns(SourceWarning, match=f"16 bits use only {bits} bits"):
            source = open_source(tmp_path, fps=1)
    for frame, image in zip(source, gray, strict=True):
        np.testing.assert_array_equal(frame.image, np.repeat(image[..., None], 3, axis=2))


@pytest.mark.parametrize("clockwise", [90, 180])
def test_videos_are_turned_as_their_metadata_say(tmp_path, clockwise):
    write_video(tmp_path / "a.mp4", [SCENE] * 3, 25.0)
    stored = next(open_source(tmp_path / "a.mp4")).image
    change_mp4(tmp_path / "a.mp4", clockwise)
    with pytest.warns(SourceWarning, match=f"turned by {clockwise} degrees"):
        source = open_source(tmp_path / "a.mp4")
    assert source.turned_deg == clockwise
    np.testing.assert_array_equal(next(source).image, np.rot90(stored, -clockwise // 90))


def test_a_field_of_view_heeds_pixels_that_are_no_squares(tmp_path):
    write_video(tmp_path / "a.mp4", [SCENE] * 3, 25.0)
    square = open_source(tmp_path / "a.mp4")
    change_mp4(tmp_path / "a.mp4", aspect=(64, 45))
    source = open_source(tmp_path / "a.mp4")
    assert (square.pixel_aspect, source.pixel_aspect) == (1, 64 / 45)
    camera, prior = begin_camera(Track(str(tmp_path / "a.mp4"), fov=60.0), source, live=False)
    assert prior is None
    assert float(camera.fx) == pytest.approx(32 / np.tan(np.radians(30)))
    assert float(camera.fy / camera.fx) == pytest.approx(64 / 45)


def test_a_calibration_of_the_stored_pixels_is_told_of_the_orientation(tmp_path, capsys):
    save(tmp_path / "f", [6] * 3)
    camera = {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    (tmp_path / "c.json").write_text(json.dumps(camera))
    with pytest.raises(SystemExit):
        main(["track", str(tmp_path / "f"), "--camera", str(tmp_path / "c.json"), "--out", str(tmp_path / "o")])
    said = capsys.readouterr().err
    assert "turned by a quarter" in said
    assert "orientation (EXIF or metadata) turns the images: give --turn-camera 90 if it was calibrated before" in said
    options = Track(str(tmp_path / "f"), camera=tmp_path / "c.json", input=_Input(turn_camera=90))
    with pytest.warns(SourceWarning, match="turned by 90"):
        source = open_source(tmp_path / "f")
    turned, _ = begin_camera(options, source, live=False)
    assert (turned.width, turned.height) == source.size


def interlaced_film(path, fields):
    """MPEG-2 of two fields a frame: a progressive film whose headers say that it is interlaced, top field first."""
    frames = [np.where(np.arange(a.shape[0])[:, None, None] % 2, b, a) for a, b in zip(fields[::2], fields[1::2])]  # noqa: B905
    h, w = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MPG2"), 25.0, (w, h))
    for frame in frames:
        writer.write(frame)
    writer.release()
    data = bytearray(path.read_bytes())
    for match in re.finditer(b"\0\0\1\xb5", bytes(data)):
        a = match.end()
        if data[a] >> 4 == 1:  # sequence extension
            data[a + 1] &= ~0x08
        if data[a] >> 4 == 8:  # picture coding extension
            data[a + 3] = (data[a + 3] | 0x80) & ~0x01
            data[a + 4] &= ~0x80
    path.write_bytes(data)


def test_interlaced_films_are_decoded_one_field_a_frame(tmp_path):
    # Gray: the encoder knows nothing of fields and mixes the colours of the two.
    scene = np.repeat(cv2.resize(SCENE, (320, 256))[..., :1], 3, axis=2)
    fields = [np.roll(scene, 16 * k, axis=1) for k in range(10)]
    interlaced_film(tmp_path / "a.mpg", fields)
    frames = list(open_source(tmp_path / "a.mpg"))
    assert [f.time_s for f in frames] == pytest.approx(np.arange(5) / 25)
    for frame, field in zip(frames, fields[::2], strict=True):
        error = np.abs(frame.image.astype(int) - field).mean()
        other = np.abs(frame.image.astype(int) - np.roll(field, 16, axis=1)).mean()
        assert error < 5
        assert error < other / 2


def test_without_pyav_a_film_of_one_colour_is_told_of_interlacing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    write_video(tmp_path / "a.mp4", [np.zeros((48, 64, 3), np.uint8)] * 3, 25.0)
    with pytest.warns(SourceWarning, match=r"interlaced.*jaxtri\[video\].*yadif"):
        open_source(tmp_path / "a.mp4")
