"""A whole run over recorded tracks as a pure function of camera and settings: for its gradient.

What a driver decided on the way (which frames are base frames, when a segment ends, which tracks agreed on a start)
is fixed in a `Recording`; all arithmetic is done again, from the pixels: normalisation, two-view starts, filters, the
hand-over of pose and scale from segment to segment. Starts are re-estimated from what was found then, and their
derivatives are those of the implicit function theorem.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.estimation.two_view import TwoView, refine
from jaxtri.filters.scan import checkpointed
from jaxtri.formats.archive import Archived
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.pose import compose
from jaxtri.odometry import single_pair, track_pairs
from jaxtri.odometry.settings import Report, Settings


class Recording(eqx.Module, Archived):
    """Feature tracks in slots, from the first base frame on, and the base pairs of all segments, in order.

    A single pair per run, as `tracks` needs it, is a recording of one segment. Frames count from the first one here.

    Attributes:
        pixels: (t, n, 2) image points.
        visible: (t, n) which slots hold a track.
        ids: (t, n) number of the track in each slot.
        quality: (t, n, 2) forward-backward error in pixels and smaller eigenvalue of the patch; NaN where unknown.
        dt: (t,) time since the frame before, in frames.
        first: (s,) first frame of each base pair.
        second: (s,) second frame of each base pair.
        frames: (s, l) frames that each pair then measures, in order; -1 fills up.
        translation: (s, 3) about the relative pose of each pair, of unit length.
        rotation: (s,) the same of its rotation.
        inside: (s, n) tracks that each relative pose is estimated from.
        noise: (s,) of the tracks at each start, over `Settings.sigma`.
        origin: Frame of the run that is frame 0 here: the first base frame.
        inherit: Restarts take frames already tracked, else consecutive ones (static).
    """

    pixels: Float[Array, "t n 2"]
    visible: Bool[Array, "t n"]
    ids: Int[Array, "t n"]
    quality: Float[Array, "t n 2"]
    dt: Float[Array, " t"]
    first: Int[Array, " s"]
    second: Int[Array, " s"]
    frames: Int[Array, "s l"]
    translation: Float[Array, "s 3"]
    rotation: SO3
    inside: Bool[Array, "s n"]
    noise: Float[Array, " s"]
    origin: Int[Array, ""]
    inherit: bool = eqx.field(static=True, default=False)

    def normalised(self, camera: Camera) -> Float[Array, "t n 2"]:
        """The points seen, normalised; where nothing is visible that of the first one that is."""
        flat, seen = self.pixels.reshape(-1, 2), self.visible.reshape(-1)
        flat = jnp.where(seen[:, None], flat, flat[jnp.argmax(seen)])
        return camera.to_normalised(flat).reshape(self.pixels.shape)

    def until(self, frame: int) -> "Recording":
        """The first frames only, at least the first base pair. Host only."""
        frame = max(frame, int(self.second[0]) + 1)
        kept = np.flatnonzero(np.asarray(self.second) < frame)
        frames = np.where(np.asarray(self.frames) < frame, np.asarray(self.frames), -1)[kept]
        length = max(int((frames >= 0).sum(axis=1).max(initial=0)), 1)
        cut = {name: getattr(self, name)[:frame] for name in ("pixels", "visible", "ids", "quality", "dt")}
        cut |= {name: getattr(self, name)[kept] for name in ("first", "second", "translation", "inside", "noise")}
        rotation = SO3(self.rotation.wxyz[kept])
        return replace(self, **cut, rotation=rotation, frames=jnp.asarray(frames[:, :length]))

    def start(self, settings: Settings, u: Float[Array, "t n 2"]) -> TwoView:
        """The relative pose of the first base pair, of unit length."""
        T, R = self.translation[0], SO3(self.rotation.wxyz[0])
        return refine(T, R, u[self.first[0]], u[self.second[0]], self.inside[0], settings.sigma)


# Compiled as a whole: operation by operation its gradient would take many minutes to compile.
@partial(jax.jit, static_argnames="block")
def tracks(camera: Camera, settings: Settings, recording: Recording, *, block: int = 1) -> Report:
    """The run of `jaxtri.track_pairs`, from a window of keyframes: reports of all frames after the first, (t - 1,)."""
    u = recording.normalised(camera)
    view = recording.start(settings, u)
    ids, visible, second = recording.ids, recording.visible, recording.second[0]
    common = visible[0] & visible[second] & (ids[0] == ids[second])
    pose = compose(view.rotation, view.translation)
    state = track_pairs.init(settings, u[0], u[second], common, pose, noise=recording.noise[0])
    # Up to the second base frame only the pair's tracks are measured; what else is there begins after it.
    at = jnp.arange(1, len(ids))[:, None]
    same = visible[:-1] & visible[1:] & (ids[1:] == ids[:-1])
    same = jnp.where(at == second + 1, common & visible[1:] & (ids[1:] == ids[second]), same)
    hold = at <= second
    seen = jnp.where(hold, common & visible[1:] & (ids[1:] == ids[0]), visible[1:])
    fresh = ~hold & seen & ~same
    frames = (u[1:], seen, fresh, recording.dt[1:])
    return track_pairs.filter(settings, state, *frames, hold=hold[:, 0], quality=recording.quality[1:], block=block)[1]


@partial(jax.jit, static_argnames="block")
def pairs(camera: Camera, settings: Settings, recording: Recording, *, block: int = 1) -> Report:
    """The run of `jaxtri.single_pair`, one base pair for all tracks: reports (s, l) of the frames of each segment.

    Where a segment is shorter the rest are empty: nothing measured, the last pose.
    """
    u = recording.normalised(camera)
    visible, ids, dtype = recording.visible, recording.ids, u.dtype

    def common(a: Array, b: Array) -> Array:
        return visible[a] & visible[b] & (ids[a] == ids[b])

    def begin(a: Array, b: Array, view: TwoView, placement: single_pair.Placement) -> single_pair.State:
        return single_pair.init(settings, u[a], u[b], common(a, b), view, placement, (b - a).astype(dtype))

    def follow(carry: tuple, frame: Array) -> tuple[tuple, Report]:
        state, known, before = carry
        active = frame >= 0
        at = jnp.maximum(frame, 0)
        new, report = single_pair.step(
            settings, state, u[at], visible[at], ids[at] != known, recording.dt[at], quality=recording.quality[at]
        )
        after, idle = (new, (report.pose, report.covariance)), (state, before)
        state, (pose, covariance) = jax.tree.map(lambda a, b: jnp.where(active, a, b), after, idle)
        diagnostics = jax.tree.map(lambda x: jnp.where(active, x, 0), report.diagnostics)
        report = report._replace(pose=pose, covariance=covariance, diagnostics=diagnostics)
        return (state, known, (pose, covariance)), report

    def segment(carry: tuple, k: Array) -> tuple[tuple, Report]:
        state, poses, covariances = carry
        b, frames = recording.second[k], recording.frames[k]
        pose, covariance = single_pair.world_pose(state)
        (state, *_), reports = checkpointed(follow, (state, ids[b], (pose, covariance)), frames, block)
        frames = jnp.where(frames >= 0, frames, len(u))  # beyond the end nothing is written
        if not recording.inherit:
            poses, covariances = poses.at[b].set(pose.parameters()), covariances.at[b].set(covariance)
        poses = poses.at[frames].set(reports.pose.parameters(), mode="drop")
        covariances = covariances.at[frames].set(reports.covariance, mode="drop")
        # On to the next pair; after the last one its own once more, and nothing comes of it.
        k = jnp.minimum(k + 1, len(recording.first) - 1)
        a, b = recording.first[k], recording.second[k]
        pair = single_pair.Pair(u[a], u[b], common(a, b), SE3(poses[a]).normalize(), covariances[a])
        if recording.inherit:
            view, placement = single_pair.inherited(settings, state, pair)
        else:
            guess = recording.translation[k], SO3(recording.rotation.wxyz[k])
            found = refine(*guess, u[a], u[b], recording.inside[k], settings.sigma)
            view, placement, _ = single_pair.consecutive(settings, state, pair, found)
        return (begin(a, b, view, placement), poses, covariances), reports

    placement = single_pair.origin(dtype)
    state = begin(recording.first[0], recording.second[0], recording.start(settings, u), placement)
    poses = jnp.broadcast_to(placement.pose.parameters(), (len(u), 7))
    carry = (state, poses, jnp.zeros((len(u), 6, 6), dtype))
    return checkpointed(segment, carry, jnp.arange(len(recording.first)))[1]


def negative_log_likelihood(camera: Camera, recording: Recording, report: Report) -> Float[Array, ""]:
    """Of the pixels of a replayed run, per coordinate measured; robust updates as `jaxtri.ekf.Diagnostics` has them.

    A point that the gate leaves out counts as drawn evenly from the image, so that a fit cannot gain by leaving out
    what it explains badly. A density of pixels: it can be compared, and so fitted, between cameras.
    """
    said, pixels = report.diagnostics, recording.pixels
    at = jnp.arange(1, len(pixels)) if said.used.ndim == 1 else jnp.maximum(recording.frames, 0)
    # By the projection's derivative: that of its inverse, `undistort`, could not be differentiated once more.
    u = recording.normalised(camera)[at]
    log_det = -jnp.linalg.slogdet(jax.vmap(jax.jacfwd(camera.to_pixels))(u.reshape(-1, 2)))[1].reshape(u.shape[:-1])
    width = 2 * camera.cx if camera.width is None else jnp.asarray(camera.width)
    height = 2 * camera.cy if camera.height is None else jnp.asarray(camera.height)
    outside = (said.measured - said.used).astype(pixels.dtype)
    total = jnp.sum(said.log_likelihood) + jnp.sum(jnp.where(said.weights > 0, log_det, 0.0))
    total = total - jnp.sum(outside) * jnp.log((width * height).astype(pixels.dtype))
    return -total / (2 * jnp.maximum(jnp.sum(said.measured), 1).astype(pixels.dtype))
