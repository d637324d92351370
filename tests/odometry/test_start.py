"""Why there is no start: each reason says what was seen and a remedy, and is given only where it holds."""

import numpy as np
import pytest

from jaxtri import Camera, Odometry
from jaxtri.errors import InitialisationError
from jaxtri.odometry.start import Observations, Way

RNG = np.random.default_rng(0)
CAMERA = Camera.from_parameters(280, 280, 159.5, 119.5, width=320, height=240)


def observations(index, u, ids):
    none = np.full((len(ids), 2), np.nan)
    return Observations(index, float(index), u, ids >= 0, ids, none)


def test_a_track_that_has_ended_counts_as_far_as_it_was_followed():
    ids, u = np.arange(40), RNG.uniform(-0.5, 0.5, (40, 2))
    # Ten go along with the camera; the others move by .01 to .03 a frame, and none of these is left after frame 3.
    step = np.r_[np.zeros(10), np.linspace(0.01, 0.03, 30)]
    frames = [
        observations(k, u + k * step[:, None] * [1, 0], np.where((step > 0) & (k > 3), -1, ids)) for k in range(8)
    ]
    way, before = None, []
    for k in range(1, 8):
        way = Way.of(frames[: k + 1], way)
        before.append(way.flow)
    assert way is not None
    for each in (way, Way.of(frames, None)):
        np.testing.assert_allclose(each.length, 3 * step, atol=1e-15)
        np.testing.assert_array_equal(each.left, step == 0)
        np.testing.assert_allclose(each.flow, np.quantile(3 * step, 0.75) / 1.4, rtol=1e-12)
    # As long as all are left: the median, or the quartile over 1.4.
    each = max(np.median(step), np.quantile(step, 0.75) / 1.4)
    np.testing.assert_allclose(before[:3], [each, 2 * each, 3 * each], rtol=1e-12)
    # From another first frame nothing is kept.
    np.testing.assert_array_equal(Way.of(frames[4:], way).length[:10], 0)


def why(frames, ids):
    """The message of a run over (n, 2) pixels a frame, with the numbers of their tracks."""
    odometry = Odometry(CAMERA, capacity=512)
    for k, (pixels, numbers) in enumerate(zip(frames, ids, strict=True)):
        odometry.add(pixels, np.ones(len(pixels), bool), float(k), ids=numbers)
    with pytest.raises(InitialisationError) as raised:
        odometry.trajectory()
    message = str(raised.value)
    assert message.startswith(f"no camera motion was found in {len(frames)} frames: ")
    return message


def points(n):
    return RNG.uniform([10, 10], [310, 230], (n, 2))


def test_few_features_are_called_few():
    message = why([points(12)] * 4, [np.arange(12)] * 4)
    assert "only 12 features in frame 3, 20 are needed" in message
    assert "less parallax" not in message


def test_many_features_that_do_not_last_are_not_called_few():
    message = why([points(300) for _ in range(4)], [300 * k + np.arange(300) for k in range(4)])
    assert "only" not in message
    assert "of 300 features of frame 2 0 are left in frame 3, 45 are needed" in message
    assert "less parallax" not in message


def test_a_camera_that_hardly_moves_is_not_told_to_ask_for_less_parallax():
    still = points(300)
    message = why([still + 0.5 * k for k in range(4)], [np.arange(300)] * 4)
    assert "the flow since frame 0 is 0.7% of the image width, 3.5% needed" in message
    assert "longer sequence" in message
    assert "less parallax" not in message


def test_less_parallax_is_advised_where_parallax_is_short():
    a, u, frames = np.radians(1.0), np.column_stack([(points(300) - [159.5, 119.5]) / 280, np.ones(300)]), []
    for k in range(8):  # the camera only turns
        R = np.array([[np.cos(k * a), 0, np.sin(k * a)], [0, 1, 0], [-np.sin(k * a), 0, np.cos(k * a)]])
        x = u @ R.T
        frames.append(280 * x[:, :2] / x[:, 2:] + np.array([159.5, 119.5]) + RNG.normal(0, 0.2, (300, 2)))
    assert "--min-parallax" in why(frames, [np.arange(300)] * 8)


def test_a_zoom_on_a_tripod_is_no_motion():
    still, frames = points(300), []
    for k in range(30):
        frames.append((still - [159.5, 119.5]) * 1.015**k + [159.5, 119.5] + RNG.normal(0, 0.2, (300, 2)))
    message = why(frames, [np.arange(300)] * 30)
    assert "zoom" in message
    assert "less parallax" not in message


def test_a_motion_after_a_zoom_is_found():
    u, frames = np.column_stack([(points(300) - [159.5, 119.5]) / 280, np.ones(300)]), []
    X = u * RNG.uniform(2, 4, (300, 1))
    for k in range(24):
        f, Y = 280 * 1.015 ** min(k, 12), X - np.array([0.03 * max(k - 12, 0), 0.0, 0.0])
        frames.append(f * Y[:, :2] / Y[:, 2:] + [159.5, 119.5] + RNG.normal(0, 0.2, (300, 2)))
    odometry = Odometry(CAMERA, capacity=512)
    for k, pixels in enumerate(frames):
        odometry.add(pixels, np.ones(300, bool), float(k), ids=np.arange(300))
    odometry.finish()
    assert odometry.base_pair is not None
    assert odometry.base_pair[0] > 0  # the pairs of the first frame only zoom
