"""The slots that tracks are kept in: whatever the order and number of the rows, a track stays where it is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtri.errors import InputError
from jaxtri.odometry.slots import place, slotted

CAPACITY = 8
FRAMES = st.lists(st.lists(st.integers(0, 20), unique=True, max_size=CAPACITY), min_size=1, max_size=6)


def frame(ids):
    """Pixels that tell which track they are of."""
    ids = np.asarray(ids, np.int64)
    return np.stack([ids, ids + 0.5], axis=1).astype(float), ids


@settings(deadline=None, max_examples=200)
@given(FRAMES, st.randoms())
def test_a_track_keeps_its_slot_and_rows_may_come_in_any_order(frames, random):
    held = np.full(CAPACITY, -1)
    for ids in frames:
        pixels, numbers = frame(ids)
        found = slotted(held, pixels, np.ones(len(ids), bool), numbers, None)
        assert sorted(found.ids[found.visible]) == sorted(ids)
        np.testing.assert_array_equal(found.pixels[found.visible, 0], found.ids[found.visible])
        assert (found.ids[~found.visible] == -1).all()
        for track in set(ids) & set(held[held >= 0]):
            assert found.ids.tolist().index(track) == held.tolist().index(track)
        order = random.sample(range(len(ids)), len(ids))
        again = slotted(held, pixels[order], np.ones(len(ids), bool), numbers[order], None)
        stayed = np.isin(again.ids, held[held >= 0])
        np.testing.assert_array_equal(again.ids[stayed], found.ids[stayed])
        held = found.ids


def test_a_new_track_takes_its_own_row_where_that_is_free():
    held = np.array([7, -1, -1, 9])
    np.testing.assert_array_equal(place(held, np.array([9, 1, 2]), np.ones(3, bool)), [3, 1, 2])
    np.testing.assert_array_equal(place(held, np.array([5, 9, 7, 6]), np.ones(4, bool)), [1, 3, 0, 2])


def test_what_is_not_finite_or_not_visible_is_not_there():
    pixels, ids = frame([0, 1, 2])
    pixels[1] = np.nan
    quality = np.arange(6.0).reshape(3, 2)
    found = slotted(np.full(4, -1), pixels, np.array([True, True, False]), ids, quality)
    np.testing.assert_array_equal(found.ids, [0, -1, -1, -1])
    np.testing.assert_array_equal(found.quality[0], [0, 1])
    assert np.isnan(found.quality[1:]).all()


def test_too_many_tracks_and_double_numbers_are_named():
    pixels, ids = frame(range(5))
    with pytest.raises(InputError, match="5 tracks are visible, and there is room for 4"):
        slotted(np.full(4, -1), pixels, np.ones(5, bool), ids, None)
    with pytest.raises(InputError, match="two visible tracks have the number 3"):
        slotted(np.full(8, -1), pixels, np.ones(5, bool), np.array([0, 1, 3, 3, 4]), None)
    hidden = np.array([True, True, True, False, True])
    assert slotted(np.full(8, -1), pixels, hidden, np.array([0, 1, 3, 3, 4]), None).visible.sum() == 4
