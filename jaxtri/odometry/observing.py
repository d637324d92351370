"""A frame as it is given, checked, and as the filters take it."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtri.checks import ArrayOrList, booleans, numbers, pixel_points
from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.slots import Slotted, slotted
from jaxtri.odometry.start import Observations
from jaxtri.vision.places import Returns

normalise = jax.jit(lambda camera, pixels: camera.to_normalised(pixels))


def late_s(camera: Camera, pixels: np.ndarray, dtype: Any) -> np.ndarray:
    """Seconds (n,) from the time of a frame to that at which pixels (n, 2) are exposed."""
    return np.asarray(camera.late(jnp.asarray(pixels, dtype)))


class Rows(NamedTuple):
    """The tracks of a frame, a row each: pixels (n, 2), visible (n,), ids (n,), quality (n, 2), what has returned."""

    pixels: np.ndarray
    visible: np.ndarray
    ids: np.ndarray
    quality: np.ndarray | None
    returns: Returns | None

    @classmethod
    def of(
        cls,
        pixels: ArrayOrList,
        visible: ArrayOrList,
        ids: ArrayOrList | None,
        quality: ArrayOrList | None,
        returns: Returns | None,
    ) -> "Rows":
        """As they are given to `Odometry.add`. Raises `InputError` where a shape or a kind of numbers does not fit."""
        z = numbers("pixels", pixels, ("n", 2))
        seen = booleans("visible", visible, (len(z),))
        rows = np.arange(len(z)) if ids is None else numbers("ids", ids, (len(z),), np.int64)
        known = None if quality is None else numbers("quality", quality, (len(z), 2))
        if len(rows) and rows[seen].min(initial=0) < 0:
            raise InputError(f"ids: {rows[seen].min()} is negative; number the tracks from 0")
        if returns is not None:
            now = numbers("returns.now", returns.now, ("m",), np.int64)
            before = numbers("returns.before", returns.before, (len(now),), np.int64)
            returns = Returns(now, before, numbers("returns.pixels", returns.pixels, (len(now), 2)), returns.frame)
        return cls(z, seen, rows, known, returns)


def observed(
    index: int,
    time: float,
    before: float | None,
    rows: Rows,
    held: np.ndarray,
    camera: Camera,
    unit: float,
    dtype: Any,
) -> tuple[Observations, Slotted]:
    """The frame, whose time has to be after that `before`, in the slots that `held` (c,) these tracks.

    `unit` are the seconds of a frame.
    """
    if before is None:
        pixel_points("pixels", rows.pixels[rows.visible])
    if not math.isfinite(time) or (before is not None and not time > before):
        known = " is no number of seconds" if before is None else f" does not follow {before}"
        raise InputError(f"frame {index}: its time {time}{known}")
    if rows.returns is not None and not 0 <= rows.returns.frame < index:
        raise InputError(f"returns.frame is {rows.returns.frame} in frame {index}; give one before it")
    tracks = slotted(held, rows.pixels, rows.visible, rows.ids, rows.quality)
    u = np.asarray(normalise(camera, tracks.pixels.astype(dtype)))
    tracks = tracks._replace(visible=tracks.visible & np.isfinite(u).all(axis=1))
    quality = tracks.quality.astype(dtype)
    late = None if camera.readout is None else late_s(camera, tracks.pixels, dtype) / unit
    return Observations(index, float(time), u, tracks.visible, tracks.ids, quality, rows.returns, late), tracks


def at_frame_times(frames: list[Observations]) -> list[Observations]:
    """Frames with each point where it would have been at the time of its frame; as they are where no shutter rolls."""
    late = [f.late for f in frames if f.late is not None]
    if not late:
        return frames
    points = [(f.index, f.u, np.where(f.visible, f.ids, -1)) for f in frames]
    return [replace(f, u=u, late=None) for f, u in zip(frames, steadied(points, late), strict=True)]


def steadied(points: list[tuple[int, np.ndarray, np.ndarray]], late: list[np.ndarray]) -> list[np.ndarray]:
    """Points (n, 2) where they would have been at the time of their frame, which they are `late` for, in frames.

    `points` are the number of each frame, what is seen in it, and the numbers of the tracks, -1 where there is none.
    Each goes back by its own flow, the mean of that from the frame before and that to the one after, where both see it.
    """
    between = []
    for (k, a, one), (m, b, two), before, after in zip(points, points[1:], late, late[1:], strict=False):
        both = (one == two) & (one >= 0)
        time = np.where(both, m - k + after - before, 1.0)
        between.append((np.where(both[:, None], (b - a) / time[:, None], 0.0), both))
    none = np.zeros_like(points[0][1]), np.zeros(len(points[0][2]), bool)
    found = []
    for (_, z, _), (back, one), (on, two), delay in zip(points, [none, *between], [*between, none], late, strict=True):
        flow = (back + on) / np.maximum(one.astype(int) + two, 1)[:, None]
        found.append((z - delay[:, None] * flow).astype(z.dtype))
    return found
