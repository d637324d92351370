"""What a run keeps of its tracks and base pairs, so that it can be done again as a pure function: `jaxtri.replay`."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxlie import SO3

from jaxtri.geometry.camera import Camera
from jaxtri.odometry.observing import late_s, steadied
from jaxtri.odometry.replay import Recording
from jaxtri.odometry.slots import Slotted
from jaxtri.odometry.start import BasePair
from jaxtri.vision.places import Returns


@dataclass
class Recorder:
    """The tracks of a run, and its base pairs up to where the camera is lost.

    Attributes:
        on: Tracks are kept.
        tracks: Of all frames so far, in slots.
        pairs: Base pairs of the segments: the first, and once the camera is lost those that followed it.
        lost: Frame in which the camera was lost first; None before.
        returns: Of the frames in which tracks of earlier ones were found again.
    """

    on: bool
    tracks: list[Slotted] = field(default_factory=list)
    pairs: list[BasePair] = field(default_factory=list)
    lost: int | None = None
    returns: dict[int, Returns] = field(default_factory=dict)
    _steady: list[np.ndarray] = field(default_factory=list, repr=False)

    def take(self, tracks: Slotted, returns: Returns | None) -> None:
        """The next frame."""
        if self.on:
            if returns is not None:
                self.returns[len(self.tracks)] = returns
            self.tracks.append(tracks)

    def steady(self, camera: Camera, frame_time: float) -> list[Slotted]:
        """The tracks so far; of a camera whose shutter rolls, as they would be at the times of the frames."""
        if camera.readout is None:
            return self.tracks
        if len(self._steady) < len(self.tracks):
            points = [(k, t.pixels, np.where(t.visible, t.ids, -1)) for k, t in enumerate(self.tracks)]
            late = [late_s(camera, t.pixels, np.float64) / frame_time for t in self.tracks]
            self._steady = steadied(points, late)
        both = zip(self.tracks, self._steady, strict=True)
        return [tracks._replace(pixels=pixels) for tracks, pixels in both]

    def judge(self, frame: int, moving: np.ndarray) -> None:
        """Which tracks (c,) of a frame move by themselves."""
        if self.on:
            self.tracks[frame] = self.tracks[frame]._replace(moving=moving)

    def stop(self, frame: int, begun: list[BasePair]) -> None:
        """The camera is lost in this frame, at the latest; `begun` are the base pairs since the first."""
        if self.lost is None:
            self.pairs, self.lost = [*self.pairs, *begun], frame
        self.lost = min(self.lost, frame)
        self.pairs = [p for p in self.pairs if p.last <= self.lost]

    def recording(self, begun: list[BasePair], dt: Callable[[int], float], *, inherit: bool, dtype: Any) -> Recording:
        """All of it as arrays; `begun` are base pairs that are not in `pairs` yet, `dt` that of a frame."""
        pairs = [*self.pairs, *begun]
        end = len(self.tracks) if self.lost is None else self.lost + 1
        origin, kept = pairs[0].first, self.tracks[pairs[0].first : end]
        ends = [*(p.last for p in pairs[1:]), origin + len(kept) - 1]
        measured = [np.arange(p.second + 1, end + 1) - origin for p, end in zip(pairs, ends, strict=True)]
        frames = np.full((len(pairs), max(1, *map(len, measured))), -1)
        for row, those in zip(frames, measured, strict=True):
            row[: len(those)] = those
        pixels, visible, ids, quality, _ = (np.stack(x) for x in zip(*kept, strict=True))
        return Recording(
            jnp.asarray(pixels, dtype),
            jnp.asarray(visible),
            jnp.asarray(ids),
            jnp.asarray(quality, dtype),
            jnp.asarray([dt(origin + k) for k in range(len(kept))], dtype),
            jnp.asarray([p.first - origin for p in pairs]),
            jnp.asarray([p.second - origin for p in pairs]),
            jnp.asarray(frames),
            jnp.stack([p.found.translation for p in pairs]),
            SO3(jnp.stack([p.found.rotation.wxyz for p in pairs])),
            jnp.asarray(np.stack([p.inside for p in pairs])),
            jnp.asarray([p.noise for p in pairs], dtype),
            jnp.asarray(origin),
            inherit=inherit,
        )
