"""Stretches that a camera was followed over: frames, keyframes, and tracks cut for `jaxtri.estimation.batch`."""

from typing import NamedTuple

import numpy as np

from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.observing import normalise
from jaxtri.odometry.settings import Settings, Status
from jaxtri.odometry.slots import Slotted

# Keyframes of a block of each layer; a track that is seen in more than two of the last is cut. Places for looks in a
# chunk, so that what is worked out of it stays in a cache; and for chunks of a layer, at least: twice as many as most
# sequences of a few hundred frames need, so that they share what is compiled.
SIZES, PLACES, CHUNKS = (8, 32), 4096, 32
LEFT = 0.5  # share of a keyframe's tracks below which the next one is due: on a road most live for a few frames only


def segments(odometry: Odometry) -> list[tuple[int, int]]:
    """First frame, and the one after the last, of each stretch that the camera was followed over."""
    if odometry.base_pair is None:
        return []
    poses = odometry.poses
    again = {p.frame for p in odometry.found} | {k for k, p in enumerate(poses[1:], 1) if p.start != poses[k - 1].start}
    starts = sorted({odometry.base_pair[0]} | {k for k in again if poses[k].T_camera_world is not None})
    ends = [*starts[1:], len(poses)]
    return [
        (start, next((k for k in range(start, end) if poses[k].status in (Status.LOST, Status.INITIALISING)), end))
        for start, end in zip(starts, ends, strict=True)
    ]


def worlds(odometry: Odometry) -> list[np.ndarray]:
    """Frames (t,) that the camera was followed over in one world, at one scale, for each start."""
    found: dict[int, list[np.ndarray]] = {}
    for first, end in segments(odometry):
        found.setdefault(odometry.poses[first].start, []).append(np.arange(first, end))
    return [np.concatenate(frames) for frames in found.values()]


class Segment(NamedTuple):
    """The frames of a world: their numbers (t,), normalised points (t, n, 2), which are seen, numbers of the tracks."""

    frames: np.ndarray
    u: np.ndarray
    seen: np.ndarray
    ids: np.ndarray
    T: np.ndarray  # (t, 4, 4) world to camera, as it was
    times: np.ndarray  # in frames
    measured: np.ndarray  # (t,) frames whose pose comes from what they show
    places: np.ndarray  # (t,) frames that are seen again, or see one
    begins: np.ndarray  # (f,) places of frames in which the camera was found again

    @classmethod
    def of(cls, odometry: Odometry, frames: np.ndarray, *, moving: bool = False) -> "Segment":
        """Of frames of a run, as it recorded them; with what was taken to move by itself only where that is asked."""
        recorded = odometry.tracks
        tracks: list[Slotted] = [recorded[k] for k in frames]
        dtype = odometry.settings.sigma.dtype  # pyright: ignore[reportOptionalMemberAccess]
        poses = [odometry.poses[k] for k in frames]
        cameras = (odometry.camera_at(p.time) for p in poses)
        u = np.stack([np.asarray(normalise(c, t.pixels.astype(dtype))) for c, t in zip(cameras, tracks, strict=True)])
        seen = np.stack([t.visible & (moving | ~t.moving) for t in tracks]) & np.isfinite(u).all(axis=2)
        T = np.stack([p.T_camera_world for p in poses])  # pyright: ignore[reportArgumentType, reportCallIssue]
        times = np.array([p.time for p in poses]) / (odometry.frame_time or 1.0)
        measured = np.array([p.status.measured for p in poses])
        begins = np.flatnonzero(np.isin(frames, [p.frame for p in odometry.found]))
        places = np.isin(frames, [k for at, found in odometry.returns.items() for k in (at, found.frame)])
        places[begins] = True
        for k in begins[begins > 0]:
            places[:k][np.flatnonzero(measured[:k])[-1:]] = True
        return cls(
            frames,
            np.where(seen[..., None], u, 0.0),
            seen,
            np.where(seen, np.stack([t.ids for t in tracks]), -1),
            T,
            times,
            measured,
            places & measured,
            begins,
        )


def keyframes(settings: Settings, segment: Segment) -> np.ndarray:
    """Frames between which the tracks have moved, with the first, the last, and places that are seen again."""
    flow, common = float(settings.keyframe_flow), float(settings.keyframe_common)
    keys, way = [0], np.zeros(segment.seen.shape[1])
    for k in range(1, len(segment.u)):
        key = keys[-1]
        both = (segment.ids[k] == segment.ids[key]) & segment.seen[k]
        way[both] = np.linalg.norm(segment.u[k][both] - segment.u[key][both], axis=1)
        few = both.sum() < max(common, LEFT * segment.seen[key].sum())
        # Each as far as it was followed: what goes along with the camera stays in the picture longest.
        if segment.places[k] or (segment.measured[k] and (few or np.median(way[segment.seen[key]]) > flow)):
            keys.append(k)
            way[:] = 0
    last = len(segment.u) - 1
    return np.array(keys if keys[-1] == last else [*keys, last])


class Pieces(NamedTuple):
    """Tracks cut where a layer of chunks cannot hold them, or where they are not seen, and where each piece went.

    Attributes:
        layers: (observed, mask, begin, chunks) of each layer, as `jaxtri.estimation.layers.Layer` has them.
        ids: (p,) number of the track of each piece.
        layer, chunk, column: (p,) where it went.
        key, slot, piece: (o,) keyframe, slot and piece of each look.
    """

    layers: list[tuple[np.ndarray, ...]]
    ids: np.ndarray
    layer: np.ndarray
    chunk: np.ndarray
    column: np.ndarray
    key: np.ndarray
    slot: np.ndarray
    piece: np.ndarray

    @classmethod
    def of(cls, segment: Segment, keys: np.ndarray) -> "Pieces":
        """Those of the tracks that two keyframes in a row see."""
        places, last = room(len(keys)), SIZES[-1]
        key, slot = np.nonzero(segment.seen[keys])
        ids = segment.ids[keys][key, slot]
        order = np.lexsort((key, ids))
        key, slot, ids = key[order], slot[order], ids[order]
        begins = np.r_[True, (np.diff(ids) != 0) | (np.diff(key) != 1)]
        block = np.minimum(key // last, places // last - 2)
        cut = (key // last - block[begins][np.cumsum(begins) - 1]) // 2
        begins |= np.r_[False, np.diff(cut) != 0]
        piece = np.cumsum(begins) - 1
        kept = np.bincount(piece)[piece] > 1
        key, slot, ids, piece = key[kept], slot[kept], ids[kept], np.unique(piece[kept], return_inverse=True)[1]
        first, count = np.flatnonzero(np.r_[True, np.diff(piece) != 0]), np.bincount(piece)
        begin, end = key[first], key[first + count - 1]
        layer, chunk, column = np.full(len(first), -1), np.zeros(len(first), int), np.zeros(len(first), int)
        layers = []
        for number, b in enumerate(SIZES):
            block = np.minimum(begin // b, places // b - 2)
            here = np.flatnonzero((layer < 0) & (end < b * (block + 2)))
            here = here[np.argsort(block[here], kind="stable")]
            n = PLACES // (2 * b)
            held = np.bincount(block[here], minlength=places // b)  # tracks that begin in each block
            chunks = -(-held // n)
            within = np.arange(len(here)) - np.repeat(np.cumsum(held) - held, held)
            layer[here], column[here] = number, within % n
            chunk[here] = np.repeat(np.cumsum(chunks) - chunks, held) + within // n
            count = chunks.sum()
            c = max(CHUNKS, 1 << (int(count) - 1).bit_length())
            starts = np.zeros(c, np.int32)
            starts[:count] = np.repeat(b * np.arange(len(chunks)), chunks)
            observed, mask = np.zeros((c, 2, 2 * b, n), segment.u.dtype), np.zeros((c, 2 * b, n), bool)
            look = layer[piece] == number
            at = chunk[piece[look]]
            mask[at, key[look] - starts[at], column[piece[look]]] = True
            layers.append((observed, mask, starts, np.asarray(count, np.int32)))
        found = cls(layers, ids[first], layer, chunk, column, key, slot, piece)
        filled = zip(found.observed(segment.u[keys]), layers, strict=True)
        return found._replace(layers=[(observed, *rest) for observed, (_, *rest) in filled])

    def observed(self, u: np.ndarray) -> list[np.ndarray]:
        """The first entry of each of the `layers`, of other points (k, n, 2) of the keyframes."""
        found = [np.zeros_like(layer[0]) for layer in self.layers]
        for number, (observed, (_, _, begin, _)) in enumerate(zip(found, self.layers, strict=True)):
            here = self.layer[self.piece] == number
            piece, key = self.piece[here], self.key[here]
            chunk = self.chunk[piece]
            observed[chunk, :, key - begin[chunk], self.column[piece]] = u[key, self.slot[here]]
        return found

    def each(self, of_layers: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        """Of each piece, (p, *shape), what stands in arrays (c, *shape, n)."""
        found = np.zeros((len(self.ids), *shape), of_layers[0].dtype)
        for number, x in enumerate(of_layers):
            here = self.layer == number
            found[here] = x[self.chunk[here], ..., self.column[here]]
        return found

    def looks(self, of_layers: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        """Of each look, (o, *shape), what stands in arrays (c, 2 b, *shape, n)."""
        found = np.zeros((len(self.key), *shape), of_layers[0].dtype)
        for number, x in enumerate(of_layers):
            here = self.layer[self.piece] == number
            piece, begin = self.piece[here], self.layers[number][2]
            found[here] = x[self.chunk[piece], self.key[here] - begin[self.chunk[piece]], ..., self.column[piece]]
        return found


def room(keyframes: int) -> int:
    """Places for so many: two of the largest blocks, or more, of which there are four numbers to each doubling."""
    blocks = max(2, -(-keyframes // SIZES[-1]))
    step = 1 << max(0, blocks.bit_length() - 3)
    return SIZES[-1] * step * -(-blocks // step)
