import contextlib
import struct
import threading

import cv2
import numpy as np
import pytest

from jaxtri.errors import ResolutionChangeError, TruncatedVideoError, TruncatedVideoWarning, VideoError
from jaxtri.vision.video import Frame, ahead, open_source, spool, write_video

# Most of the folders here have no times; `test_layouts.py` is about those.
pytestmark = pytest.mark.filterwarnings("ignore:.*(frames a second are assumed|of one colour)")


def images(count, size=(64, 48)):
    """Flat images whose gray level is their number, so that order survives compression."""
    return [np.full((size[1], size[0], 3), 20 * i, np.uint8) for i in range(count)]


@pytest.fixture
def folder(tmp_path):
    def make(count=3, where="seq", suffix="png"):
        (tmp_path / where).mkdir(parents=True, exist_ok=True)
        for i, image in enumerate(images(count)):
            cv2.imwrite(str(tmp_path / where / f"im{8 + i}.{suffix}"), image)
        return tmp_path / where

    return make


def grays(source):
    return [round(frame.image.mean() / 20) for frame in source]


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_written_video_reads_back(tmp_path, name):
    assert write_video(tmp_path / name, iter(images(6)), 10.0) == 6
    with open_source(tmp_path / name, strict=True) as source:
        assert (source.declared, source.size, source.fps) == (6, (64, 48), 10.0)
        frames = list(source)
    assert source.decoded == 6
    assert [f.index for f in frames] == list(range(6))
    assert [round(f.image.mean() / 20) for f in frames] == list(range(6))
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(6) / 10, atol=1e-6)
    np.testing.assert_allclose([f.time_s for f in open_source(tmp_path / name, fps=4)], np.arange(6) / 4)
    assert [p.name for p in tmp_path.iterdir()] == [name]  # no temporary file stays


@pytest.mark.parametrize("name", ["10:20:30.mp4", "file:a.mp4", "100%d_%s.mp4", "-a b.mp4", "\u00fcml\u00e4ut #1?.mp4"])
def test_any_name_opens_from_the_folder_that_it_is_in(tmp_path, monkeypatch, name):
    write_video(tmp_path / "a.mp4", images(4), 25.0)
    (tmp_path / "a.mp4").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert grays(open_source(name)) == [0, 1, 2, 3]
    assert write_video(f"of_{name}", images(3), 25.0) == 3
    assert grays(open_source(f"of_{name}")) == [0, 1, 2]


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(VideoError, match="no frames"):
        write_video(tmp_path / "a.mp4", [], 25.0)
    with pytest.raises(ResolutionChangeError, match="frame 2"):
        write_video(tmp_path / "a.mp4", [*images(2), *images(1, (32, 24))], 25.0)
    with pytest.raises(VideoError, match="codec"):
        write_video(tmp_path / "a.nonsense", images(2), 25.0)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_opened(tmp_path, folder):
    (tmp_path / "junk.mp4").write_bytes(b"no video" * 100)
    (tmp_path / "empty").mkdir()
    for source, message in [
        ("none.mp4", "no such file"),
        (tmp_path / "junk.mp4", "not a video"),
        (tmp_path / "empty", r"no images.*\.png"),
        (folder(1) / "im8.png", "single image"),
        (77, "camera 77"),
        ("77", "camera 77"),
    ]:
        with pytest.raises(VideoError, match=message):
            open_source(source)
    with pytest.raises(VideoError, match="fps"):
        open_source(tmp_path / "seq", fps=0.0)


def test_truncated_video(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (10, 48, 64, 3), dtype=np.uint8)  # bulky frames
    write_video(tmp_path / "whole.avi", noise, 25.0)
    data = (tmp_path / "whole.avi").read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(data[: len(data) // 2])
    with pytest.warns(TruncatedVideoWarning) as caught:
        count = sum(1 for _ in open_source(cut))
    assert 0 < count < 10
    assert f"{count} frames decoded of 10 declared" in str(caught[0].message)
    with pytest.raises(TruncatedVideoError, match="of 10 declared"):
        list(open_source(cut, strict=True))


def write_webm(path, images, milliseconds):
    """A WebM of VP8 key frames, which a lossy WebP file holds one of, each at a time of its own."""

    def element(number, content):
        content = content if isinstance(content, bytes) else content.to_bytes(max(1, (content.bit_length() + 7) // 8))
        return bytes.fromhex(number) + struct.pack(">Q", len(content) | 1 << 56) + content

    def join(*pairs):
        return b"".join(element(*pair) for pair in pairs)

    h, w = images[0].shape[:2]
    size, duration = join(("b0", w), ("ba", h)), struct.pack(">d", milliseconds[-1] + 33.0)
    track = join(("d7", 1), ("73c5", 1), ("83", 1), ("86", b"V_VP8"), ("23e383", 33_333_333), ("e0", size))
    body = element("1549a966", join(("2ad7b1", 1_000_000), ("4489", duration))) + element(
        "1654ae6b", element("ae", track)
    )
    for image, time in zip(images, milliseconds, strict=True):
        webp = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
        a = webp.index(b"VP8 ")
        frame = webp[a + 8 : a + 8 + struct.unpack_from("<I", webp, a + 4)[0]]
        body += element("1f43b675", element("e7", int(time)) + element("a3", b"\x81\0\0\x80" + frame))
    path.write_bytes(element("1a45dfa3", join(("4282", b"webm"), ("4287", 2), ("4285", 2))) + element("18538067", body))


def test_a_whole_film_of_variable_rate_is_whole_and_a_cut_one_is_not(tmp_path):
    steps = np.random.default_rng(1).choice([17, 33, 42, 67], 29)
    times = np.concatenate([[0], np.cumsum(steps)])
    write_webm(tmp_path / "whole.webm", np.random.default_rng(0).integers(0, 255, (30, 48, 64, 3), np.uint8), times)
    with open_source(tmp_path / "whole.webm", strict=True) as source:
        found = [frame.time_s for frame in source]
        assert source.declared != 30  # or this test shows nothing
    np.testing.assert_allclose(found, times / 1000, atol=1e-6)
    data = (tmp_path / "whole.webm").read_bytes()
    (tmp_path / "cut.webm").write_bytes(data[: len(data) * 3 // 4])
    with pytest.warns(TruncatedVideoWarning, match="ends early"):
        assert 10 < len(list(open_source(tmp_path / "cut.webm"))) < 30
    with pytest.raises(TruncatedVideoError):
        list(open_source(tmp_path / "cut.webm", strict=True))


def test_times_of_a_container_that_starts_over_increase(tmp_path):
    write_video(tmp_path / "a.ts", images(5), 25.0)
    (tmp_path / "twice.ts").write_bytes((tmp_path / "a.ts").read_bytes() * 2)
    times = [frame.time_s for frame in open_source(tmp_path / "twice.ts")]
    assert len(times) > 7
    np.testing.assert_allclose(np.diff(times), 0.04, atol=1e-6)


def test_folder_in_natural_order(folder):
    source = open_source(folder(4))  # im8, im9, im10, im11
    assert source.declared == 4
    assert grays(source) == [0, 1, 2, 3]
    assert grays(open_source(folder(4, "outer/frames", "jpg").parent)) == [0, 1, 2, 3]


def test_gray_and_16_bit_become_8_bit_bgr(tmp_path):
    ramp = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64) * 20
    cv2.imwrite(str(tmp_path / "0.png"), ramp)
    cv2.imwrite(str(tmp_path / "1.png"), (ramp >> 8).astype(np.uint8))
    for frame in open_source(tmp_path):
        np.testing.assert_array_equal(frame.image, np.repeat((ramp >> 8)[..., None], 3, axis=2))


def test_corrupt_image_is_skipped_or_raised(folder):
    path = folder(4, suffix="jpg")
    (path / "im9.jpg").write_bytes((path / "im9.jpg").read_bytes()[:-40])
    with pytest.warns(TruncatedVideoWarning, match=r"3 frames decoded of 4 declared.*im9\.jpg"):
        frames = list(open_source(path))
    assert [frame.index for frame in frames] == [0, 2, 3]  # the index still counts files
    with pytest.raises(TruncatedVideoError, match=r"im9\.jpg"):
        list(open_source(path, strict=True))
    for file in path.iterdir():
        file.write_bytes(b"")
    with pytest.raises(VideoError, match=r"no frame.*im8\.jpg"):
        open_source(path)


def test_change_of_resolution(folder):
    path = folder(3)
    cv2.imwrite(str(path / "im10.png"), images(1, (80, 60))[0])
    with pytest.raises(ResolutionChangeError, match=r"frame 2 is 80x60.*64x48"):
        list(open_source(path))


@pytest.mark.parametrize("beside", [True, False])
def test_timestamps(folder, beside):
    path = folder(3, "seq/frames")
    stamps = (path if beside else path.parent) / "timestamps.txt"
    stamps.write_text("# seconds\n5.5\n5.75\n6.5\n")
    assert [frame.time_s for frame in open_source(path.parent)] == [5.5, 5.75, 6.5]
    assert [frame.time_s for frame in open_source(path.parent, fps=2)] == [0, 0.5, 1]
    names = [f"{'' if beside else 'frames/'}im{i}.png" for i in (10, 9, 8)]
    stamps.write_text("".join(f"{i} {name}\n" for i, name in enumerate(names)))
    assert grays(open_source(path)) == [2, 1, 0]
    for text, message in [
        ("1\n2\n", "2 lines for 3 images"),
        ("1\n2\n2\n", r"txt:3: .*increase"),
        ("1\nx\n3\n", r"txt:2: 'x'"),
        ("1 a.png\n2 b.png\n3 c.png\n", r"names .*a\.png"),
    ]:
        stamps.write_text(text)
        with pytest.raises(VideoError, match=message):
            open_source(path)


def test_a_closed_source_has_ended(folder):
    source = open_source(folder(3))
    next(source)
    source.close()
    assert list(source) == []
    assert source.decoded == 1


def test_spooled_frames_come_back_with_their_times(tmp_path):
    image = np.full((48, 64, 3), 90, np.uint8)
    frames = [Frame(k, 0.1 * k + 0.05, image) for k in range(3)]
    assert [f.index for f in spool(frames, tmp_path / "frames")] == [0, 1, 2]
    with open_source(tmp_path / "frames") as source:
        again = list(source)
    np.testing.assert_allclose([f.time_s for f in again], [0.05, 0.15, 0.25])
    assert again[0].image.shape == (48, 64, 3)


def readers():
    return [thread for thread in threading.enumerate() if thread.name == "reads ahead"]


def test_frames_read_ahead_are_the_same_and_so_are_the_errors(folder, tmp_path):
    with open_source(folder(6)) as source:
        assert grays(ahead(source, depth=2)) == list(range(6))

    def broken():
        yield from (Frame(k, 0.1 * k, image) for k, image in enumerate(images(2)))
        raise VideoError("unplugged")

    with pytest.raises(VideoError, match="unplugged"):
        list(ahead(broken(), depth=1))
    assert not readers()


def test_whoever_leaves_early_leaves_no_thread_behind(folder):
    with open_source(folder(12)) as source:
        with contextlib.closing(ahead(source, depth=2)) as frames:
            assert next(frames).index == 0
        assert 1 <= source.decoded <= 5  # no more was read than was room for
    assert not readers()
