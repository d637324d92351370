"""Folders as data sets lay them out: which images, in which order, at which times."""

import warnings

import cv2
import numpy as np
import pytest

from jaxtri.errors import SourceWarning, VideoError
from jaxtri.vision.video import open_source

N = 5
NS = 1_403_636_579_763_555_584 + 50_000_000 * np.arange(N)


def save(folder, names):
    """Images whose gray level is their place in the list."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((24, 32, 3), 20 * k, np.uint8))


def read(folder, **options):
    """Gray levels and times; no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frames = list(open_source(folder, **options))
    return [round(f.image.mean() / 20) for f in frames], np.array([f.time_s for f in frames])


def lines(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{row}\n" for row in rows))


def euroc(to):
    save(to / "mav0/cam0/data", [f"{s}.png" for s in NS])
    lines(to / "mav0/cam0/data.csv", ["#timestamp [ns],filename", *(f"{s},{s}.png" for s in NS)])
    lines(to / "mav0/imu0/data.csv", ["#timestamp [ns],w_RS_S_x [rad s^-1]", "1403636579758555392,-0.1"])
    return ("mav0/cam0", "mav0/cam0/data", "mav0", "."), NS / 1e9


def tum(to):
    times = 1305031102.175304 + np.arange(N) / 30
    for sensor in ("rgb", "depth"):
        save(to / sensor, [f"{t:.6f}.png" for t in times])
        lines(to / f"{sensor}.txt", ["# timestamp filename", *(f"{t:.6f} {sensor}/{t:.6f}.png" for t in times)])
    return (".", "rgb"), np.round(times, 6)


def kitti(to):
    save(to / "image_0", [f"{k:06d}.png" for k in range(N)])
    lines(to / "times.txt", [f"{0.1035 * k:e}" for k in range(N)])
    return (".", "image_0"), 0.1035 * np.arange(N)


def kitti_raw(to):
    save(to / "image_02/data", [f"{k:010d}.png" for k in range(N)])
    lines(to / "image_02/timestamps.txt", [f"2011-09-26 23:59:59.{600 + 100 * k:03d}000123" for k in range(4)])
    with (to / "image_02/timestamps.txt").open("a") as file:
        file.write("2011-09-27 00:00:00.000000123\n")
    return (".", "image_02", "image_02/data"), 1317081599.6 + 0.1 * np.arange(N)


def nanoseconds(to):
    save(to / "frames", [f"{k}.png" for k in range(N)])
    lines(to / "timestamps.txt", [f"{s} frames/{k}.png" for k, s in enumerate(NS)])
    return (".", "frames"), NS / 1e9


def names_alone(to):
    save(to / "ns", [f"left-{s}.png" for s in NS])
    return ("ns",), NS / 1e9


def seconds_by_name(to):
    save(to / "s", ["0.0.png", "0.05.png", "0.1.png", "0.15.png", "1.2.png"])
    return ("s",), [0, 0.05, 0.1, 0.15, 1.2]


LAYOUTS = (euroc, tum, kitti, kitti_raw, nanoseconds, names_alone, seconds_by_name)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda f: f.__name__)
def test_data_sets_are_read_with_their_times(tmp_path, layout):
    places, times = layout(tmp_path)
    for place in places:
        order, found = read(tmp_path / place)
        assert order == list(range(N))
        np.testing.assert_allclose(found, times, rtol=0, atol=2e-6)
        np.testing.assert_allclose(read(tmp_path / place, fps=10)[1], np.arange(N) / 10)  # a given rate counts more


def test_of_several_cameras_one_has_to_be_given(tmp_path):
    for k in (0, 1):
        save(tmp_path / f"mav0/cam{k}/data", ["0.png"])
    with pytest.raises(VideoError, match=r"2 cameras \(cam0/data, cam1/data\)"):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["times.txt", "data.csv", "data.txt"])
def test_a_list_that_does_not_fit_names_both_counts(tmp_path, name):
    save(tmp_path / "data", [f"{k}.png" for k in range(N)])
    lines(tmp_path / name, [f"{k},{k}.png" for k in range(3)])
    with pytest.raises(VideoError, match="3 lines for 5 images"):
        open_source(tmp_path)


def test_a_missing_number_is_a_frame_of_time(tmp_path):
    save(tmp_path / "gap", [f"im{k:03d}.png" for k in (7, 8, 11, 12, 14)])
    save(tmp_path / "tenth", [f"{k}_left.png" for k in (10, 20, 50, 60)])  # every tenth of a film
    np.testing.assert_allclose(read(tmp_path / "gap", fps=10)[1], [0, 0.1, 0.4, 0.5, 0.7])
    np.testing.assert_allclose(read(tmp_path / "tenth", fps=10)[1], [0, 0.1, 0.4, 0.5])
    with pytest.warns(SourceWarning, match=r"25 frames a second are assumed.*--fps") as said:
        frames = list(open_source(tmp_path / "gap"))
    assert len(said) == 1
    np.testing.assert_allclose([f.time_s for f in frames], [0, 0.04, 0.16, 0.2, 0.28])


def test_names_that_are_no_times_are_not_taken_for_any(tmp_path):
    save(tmp_path / "versions", [f"v1.{k}.png" for k in (1, 2, 9, 10, 11)])  # 1.1 is not 1.10
    save(tmp_path / "dates", [f"2024013110205812{k}.png" for k in range(N)])
    save(tmp_path / "two", [f"{k}_{k}.png" for k in range(N)])
    for place in ("versions", "dates", "two"):
        assert read(tmp_path / place, fps=10)[0] == list(range(N))
        with pytest.warns(SourceWarning):
            open_source(tmp_path / place)
