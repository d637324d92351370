"""Feature tracks of a frame, brought into the slots that the filters keep them in."""

from typing import NamedTuple

import numpy as np

from jaxtri.errors import InputError


class Slotted(NamedTuple):
    """The tracks of one frame, a slot each; what stands in a slot that is not visible counts nothing."""

    pixels: np.ndarray  # (c, 2) float64
    visible: np.ndarray  # (c,) bool
    ids: np.ndarray  # (c,) int64, -1 where nothing is visible
    quality: np.ndarray  # (c, 2) forward-backward error in pixels, smaller eigenvalue of the patch; NaN if unknown
    moving: np.ndarray  # (c,) bool, found to move by itself


def place(held: np.ndarray, ids: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The slot (n,) of every row of a frame that is `seen`, -1 for the others; see `slotted`.

    A track keeps its slot from frame to frame; a new one takes the slot of its own row where that is free, else the
    next free one. `held` (c,) are the tracks that were in the slots of the frame before, -1 where there was none.
    """
    capacity, slot = len(held), np.full(len(ids), -1)
    rows = np.flatnonzero(seen)
    order = np.argsort(held)
    at = order[np.searchsorted(held, ids[rows], sorter=order).clip(max=capacity - 1)]
    stays = held[at] == ids[rows]
    slot[rows[stays]] = at[stays]
    free = np.ones(capacity, bool)
    free[at[stays]] = False
    new = rows[~stays]
    own = new[new < capacity]
    own = own[free[own]]
    slot[own], free[own] = own, False
    new = new[slot[new] < 0]
    room = np.flatnonzero(free)
    if len(new) > len(room):
        raise InputError(
            f"{len(rows)} tracks are visible, and there is room for {capacity}: give Odometry a larger capacity"
        )
    slot[new] = room[: len(new)]
    return slot


def slotted(
    held: np.ndarray, pixels: np.ndarray, visible: np.ndarray, ids: np.ndarray, quality: np.ndarray | None
) -> Slotted:
    """The rows of a frame in slots, those alone that are visible and finite.

    Raises `InputError` where two visible rows have one number, or where there are more of them than slots.
    """
    seen = visible & np.isfinite(pixels).all(axis=1)
    if len(np.unique(ids[seen])) < seen.sum():
        numbers, count = np.unique(ids[seen], return_counts=True)
        raise InputError(f"ids: two visible tracks have the number {numbers[count > 1][0]}; give each its own")
    slot = place(held, ids, seen)
    rows, slots = np.flatnonzero(seen), slot[seen]
    capacity = len(held)
    found = Slotted(
        np.zeros((capacity, 2)),
        np.zeros(capacity, bool),
        np.full(capacity, -1),
        np.full((capacity, 2), np.nan),
        np.zeros(capacity, bool),
    )
    found.pixels[slots], found.visible[slots], found.ids[slots] = pixels[rows], True, ids[rows]
    if quality is not None:
        found.quality[slots] = quality[rows]
    return found


def slots(ids: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The slot (m,) of each of some tracks, by the numbers of those in all slots (c,); -1 where it is in none."""
    if not len(ids):
        return np.full(len(numbers), -1)
    order = np.argsort(ids, kind="stable")
    at = order[np.searchsorted(ids, numbers, sorter=order).clip(max=len(ids) - 1)]
    return np.where(ids[at] == numbers, at, -1)
