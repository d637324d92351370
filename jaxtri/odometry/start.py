"""Starting: a base pair of two frames, the frames between them filled in, and one frame held."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxtri.estimation.two_view import TwoView
from jaxtri.geometry.pose import compose, identity, shear
from jaxtri.odometry import track_pairs
from jaxtri.odometry.settings import Report, Settings, StartSettings
from jaxtri.vision.hypotheses import Hypothesis, hypotheses

init_tracks = jax.jit(track_pairs.init)
step_tracks = jax.jit(track_pairs.step)


@dataclass(frozen=True)
class Observations:
    """The tracks of one frame, normalised, in slots."""

    index: int
    time: float
    u: np.ndarray  # (n, 2)
    visible: np.ndarray  # (n,)
    ids: np.ndarray  # (n,)
    quality: np.ndarray  # (n, 2) forward-backward error in pixels, smaller eigenvalue of the patch

    def common(self, other: "Observations") -> np.ndarray:
        """Slots that hold the same track in both frames."""
        return self.visible & other.visible & (self.ids == other.ids)


class Start(NamedTuple):
    """A base pair, or the reason why there is none yet."""

    found: Hypothesis | None
    reason: str


class BasePair(NamedTuple):
    """A base pair: its frames, the last one that the pair before it measured, and what its pose comes from."""

    first: int
    second: int
    last: int
    found: TwoView
    inside: np.ndarray  # (n,)


def find(settings: Settings, start: StartSettings, frames: list[Observations]) -> Start:
    """Relative pose of the first and the last of `frames`, or why it has to wait.

    Of the hypotheses that explain the pair about equally well (before a plane there are two) the frames
    between decide, by how well the transfer reaches them.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    if common.sum() < start.points:
        return Start(None, f"only {int(common.sum())} tracks are common to two frames, {start.points} are needed")
    threshold = float(settings.epipolar_gate)
    found = hypotheses(
        first.u, last.u, common, settings.sigma, threshold, eight_point=start.eight_point, poselib=start.poselib
    )
    if not found:
        return Start(None, "no essential matrix fits the tracks")
    between = [frames[int(k)] for k in np.linspace(0, len(frames) - 1, 5).round()[1:-1] if 0 < k < len(frames) - 1]
    rivals = [h for h in found if h.cost < 1.5 * found[0].cost + 50]
    if between and len(rivals) > 1:
        rivals.sort(key=lambda h: h.cost + _transfer_cost(settings, h, first, last, between))
    best = rivals[0]
    if best.inside.sum() < max(start.points, 0.4 * common.sum()):
        return Start(None, f"only {int(best.inside.sum())} of {int(common.sum())} tracks agree on one motion")
    if not best.parallax_deg >= start.parallax_deg:
        return Start(None, f"the parallax is {best.parallax_deg:.2f} degrees, {start.parallax_deg:g} are needed")
    return Start(best, "")


def _transfer_cost(
    settings: Settings, h: Hypothesis, first: Observations, last: Observations, between: list[Observations]
) -> float:
    """Truncated squared distances of the points transferred to the frames between the pair."""
    pose = compose(h.pose.rotation, h.pose.translation)
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(h.inside)
    state = init_tracks(
        settings, *arrays, pose, jnp.zeros((6, 6), settings.sigma.dtype), world=identity(settings.sigma.dtype)
    )
    cost, before = 0.0, first.index
    for frame in between:
        visible = first.common(frame) & h.inside
        state, report = hold(settings, state, frame, visible, float(frame.index - before))
        distance = np.where(np.asarray(report.diagnostics.distance) < 16, report.diagnostics.distance, 16.0)
        measured = visible & np.asarray(state.tracks.usable)
        cost += float(distance[measured].sum()) + 16.0 * float((visible & ~measured).sum())
        before = frame.index
    return cost


def fill(
    settings: Settings, frames: list[Observations], two_view: TwoView, world: SE3, dt: list[float]
) -> tuple[track_pairs.State, list[tuple[Observations, Report]]]:
    """Set up the tracker on the first and last of `frames`, whose relative pose is given, and run it over them.

    Reports of all frames but the first, whose pose is `world`.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    pose = compose(two_view.rotation, two_view.translation)
    J = shear(two_view.translation)
    covariance = J @ two_view.covariance @ J.T
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(common)
    state = init_tracks(settings, *arrays, pose, covariance, world=world)
    reports = []
    for frame, elapsed in zip(frames[1:], dt, strict=True):
        state, report = hold(settings, state, frame, first.common(frame) & common, elapsed)
        reports.append((frame, report))
    return state, reports


def hold(
    settings: Settings, state: track_pairs.State, frame: Observations, visible: np.ndarray, dt: float
) -> tuple[track_pairs.State, Report]:
    """One frame measured with the tracks as they are: none begins, no keyframe is made."""
    nothing = np.zeros(len(visible), bool)
    return step_tracks(settings, state, frame.u, visible, nothing, dt, hold=np.True_, quality=frame.quality)
