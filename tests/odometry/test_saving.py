"""A run that is kept in a file goes on as if it had never stopped."""

import copy
import pickle

import jax
import numpy as np
import pytest
from tracks import CAPACITY, sideways

from jaxtri import Odometry, Recording, StartSettings, load
from jaxtri.errors import InputError
from jaxtri.odometry.settings import Base, Status

FIRST, SECOND = sideways(20), sideways(30, seed=5)


def frames():
    """A sequence whose lens is covered from frame 20 to 23: tracking, lost, started anew."""
    pixels = np.concatenate([FIRST.pixels, SECOND.pixels])
    visible = np.concatenate([FIRST.visible, SECOND.visible])
    visible[20:24] = False
    ids = np.repeat(np.arange(2), [20, 30])[:, None] * CAPACITY + np.arange(CAPACITY)
    return list(zip(pixels, visible, np.arange(50.0), ids, strict=True))


def feed(odometry, part):
    for pixels, visible, time, ids in part:
        odometry.add(pixels, visible, float(time), ids=ids)
    return odometry


def begin(base=Base.TRACKS):
    return Odometry(FIRST.camera, base=base, start=StartSettings.of(base, lag=4), record=True)


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def whole():
    odometry = feed(begin(), frames())
    odometry.finish()
    assert [odometry.poses[k].status for k in (10, 21, 30)] == [Status.TRACKING, Status.LOST, Status.TRACKING]
    return odometry


def equal(a, b):
    """All that two odometries say, to the last bit."""
    for p, q in zip(a.poses, b.poses, strict=True):
        assert (p.time, p.status, p.used) == (q.time, q.status, q.used)
        np.testing.assert_array_equal(p.T_camera_world, q.T_camera_world)
        np.testing.assert_array_equal(p.covariance, q.covariance)
    same(a.points(), b.points())
    same(a.recording(), b.recording())
    for name in ("base_pair", "starts", "scale_unknown_from", "keyframes", "changes", "status"):
        assert getattr(a, name) == getattr(b, name), name


# Before any frame, before a start, while one is worked out, after it, followed, lost, started anew.
@pytest.mark.parametrize("stop", [0, 2, 5, 7, 15, 22, 35])
def test_an_odometry_goes_on_bit_for_bit(stop, whole, tmp_path):
    first = feed(begin(), frames()[:stop])
    first.save(tmp_path / "half.npz")
    second = feed(Odometry.load(tmp_path / "half.npz"), frames()[stop:])
    second.finish()
    equal(second, whole)
    # What was saved goes on, too: saving has changed nothing.
    feed(first, frames()[stop:]).finish()
    equal(first, whole)


def test_a_start_that_is_worked_out_is_begun_again(tmp_path, whole):
    at = next(k for k in range(50) if feed(begin(), frames()[: k + 1])._search is not None)
    odometry = feed(begin(), frames()[: at + 1])
    for copied in (pickle.loads(pickle.dumps(odometry)), copy.deepcopy(odometry)):
        feed(copied, frames()[at + 1 :]).finish()
        equal(copied, whole)


@pytest.mark.parametrize("base", [Base.INHERIT, Base.PAPER])
def test_single_pairs_go_on_bit_for_bit(base, tmp_path):
    whole = feed(begin(base), frames()[:20])
    first = feed(begin(base), frames()[:12])
    first.save(tmp_path / "half.npz")
    equal(feed(Odometry.load(tmp_path / "half.npz"), frames()[12:20]), whole)


def test_a_recording_comes_back_and_says_where_it_began(tmp_path, whole):
    recording = whole.recording()
    recording.save(tmp_path / "recording.npz")
    back = Recording.load(tmp_path / "recording.npz")
    assert jax.tree.structure(back) == jax.tree.structure(recording)
    same(back, recording)
    assert int(recording.origin) == whole.base_pair[0]
    with pytest.raises(InputError, match="holds a Recording, not a Odometry"):
        Odometry.load(tmp_path / "recording.npz")
    assert isinstance(load(tmp_path / "recording.npz"), Recording)
