"""Starting: a base pair of two frames, the frames between them filled in, and one frame held."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxtri.estimation import zoom
from jaxtri.estimation.two_view import TwoView
from jaxtri.geometry.pose import compose, identity
from jaxtri.odometry import track_pairs
from jaxtri.odometry.settings import Report, Settings, StartSettings
from jaxtri.vision.hypotheses import FARTHER, GATE, SHARES, Hypothesis, hypotheses
from jaxtri.vision.places import Returns

# Hypotheses up to RIVAL_SHARE times the cost of the best, and RIVAL_MORE, explain the pair about equally well. Before a
# plane the two poses cost the same; the margin keeps noise from deciding between them.
RIVAL_SHARE, RIVAL_MORE = 1.5, 50
BETWEEN = 3  # frames between the pair that decide among rivals: few, since each costs a step of the filter
TRUNCATED = 16.0  # squared Mahalanobis distance, at four sigmas, from which all transferred points cost the same
AGREEING = 0.4  # share of the common tracks that must agree on one motion: with fewer another one may explain more

init_tracks = jax.jit(track_pairs.init)
step_tracks = jax.jit(track_pairs.step)


@dataclass(frozen=True)
class Observations:
    """The tracks of one frame, in slots.

    Attributes:
        index: Number of the frame in the run.
        time: Seconds.
        u: (n, 2) normalised image points.
        visible: (n,) slots that hold a point.
        ids: (n,) number of the track in each slot.
        quality: (n, 2) forward-backward error in pixels, and smaller eigenvalue of the patch.
        returns: Which of them are tracks of earlier frames, where that was found.
        late: (n,) frames from the time of this one to that at which each was exposed, where the shutter rolls.
    """

    index: int
    time: float
    u: np.ndarray
    visible: np.ndarray
    ids: np.ndarray
    quality: np.ndarray
    returns: Returns | None = None
    late: np.ndarray | None = None

    def in_frames(self, unit: float) -> "Observations":
        """With the times of its points in frames of so many seconds, where they were in seconds."""
        return replace(self, late=None if self.late is None else self.late / unit)

    def common(self, other: "Observations") -> np.ndarray:
        """Slots that hold the same track in both frames."""
        return self.visible & other.visible & (self.ids == other.ids)


class Way(NamedTuple):
    """How far the tracks of a first frame have gone since, each as long as it was followed.

    Attributes:
        first: The frame.
        last: Number of the frame up to which they were followed.
        length: (n,) in normalised image units.
        left: (n,) tracks that are still followed.
    """

    first: Observations
    last: int
    length: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, frames: list[Observations], before: "Way | None") -> "Way":
        """From the first of `frames`, in a row, to the last; `before` is that up to one of these, where it fits."""
        first, now = frames[0], frames[-1]
        if before is None or before.first.index != first.index:
            before = cls(first, first.index, np.zeros(len(first.ids)), first.visible)
        length = before.length.copy()
        for frame in frames[len(frames) - (now.index - before.last) :]:  # none is left out between them
            common = first.common(frame)
            length[common] = np.linalg.norm(frame.u[common] - first.u[common], axis=1)
        return cls(first, now.index, length, first.common(now))

    @property
    def flow(self) -> float:
        """The length that half of those that are left exceed; or a quarter of all 1.4 times, if that is more.

        What goes along with the camera, a car ahead, stays in the picture longest, and tells of no motion.
        """
        left, quarter = self.length[self.left], np.quantile(self.length[self.first.visible], SHARES[1])
        return max(float(np.median(left)) if len(left) else 0.0, float(quarter) / FARTHER)


class Start(NamedTuple):
    """A base pair, or the reason why there is none yet.

    Attributes:
        found: The relative pose of the pair, None where there is none yet.
        reason: Why there is none, for a person to read; empty where there is one.
        over: Whether a pair from its first frame shows no motion at all, so that it is better sought from the last.
    """

    found: Hypothesis | None
    reason: str
    over: bool = False


class BasePair(NamedTuple):
    """A base pair and what its pose comes from.

    Attributes:
        first: Number of its first frame.
        second: Number of its second frame.
        last: Number of the last frame that the pair before it measured.
        found: The relative pose of the two.
        inside: (n,) tracks that agree with it.
        noise: Standard deviation of the tracks over the assumed one, as the frames between the two have shown it.
    """

    first: int
    second: int
    last: int
    found: TwoView
    inside: np.ndarray
    noise: float = 1.0


def find(settings: Settings, start: StartSettings, frames: list[Observations]) -> Start:
    """Relative pose of the first and the last of `frames`, or why it has to wait.

    Where several hypotheses explain the pair about equally well (before a plane there are two), the frames in between
    decide: the hypothesis wins whose points are found there where the transfer puts them.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    if common.sum() < start.points:
        return Start(None, _few(start, first, last))
    threshold = float(settings.epipolar_gate)
    found = hypotheses(
        first.u, last.u, common, settings.sigma, threshold, eight_point=start.eight_point, poselib=start.poselib
    )
    if not found:
        return Start(
            None, "no essential matrix fits the tracks: the frames show no single rigid scene; check their order"
        )
    spread = np.linspace(0, len(frames) - 1, BETWEEN + 2).round()[1:-1]
    between = [frames[int(k)] for k in spread if 0 < k < len(frames) - 1]
    rivals = [h for h in found if h.cost < RIVAL_SHARE * found[0].cost + RIVAL_MORE]
    if between and len(rivals) > 1:
        rivals.sort(key=lambda h: h.cost + _transfer_cost(settings, h, first, last, between))
    best = rivals[0]
    if best.inside.sum() < max(start.points, AGREEING * common.sum()):
        agreeing = f"only {int(best.inside.sum())} of {int(common.sum())} tracks agree on one motion"
        return Start(None, f"{agreeing}: too much of the picture moves, or the calibration is wrong; check it first")
    if not best.parallax_deg >= start.parallax_deg:
        seen = f"the parallax is {best.parallax_deg:.2f} degrees, {start.parallax_deg:g} are needed"
        remedy = "give a longer sequence with sideways motion, or ask for less parallax (--min-parallax)"
        return Start(None, f"{seen}: the camera all but turns on the spot, or the scene is far away; {remedy}")
    if not start.eight_point:  # the paper's way, two frames in a row, knows no such doubt
        turned = zoom.fit(first.u, last.u, common, float(settings.sigma))
        if zoom.explains(turned, best.cost, GATE**2):
            return Start(None, _zoomed(turned.scale), over=True)
    return Start(best, "")


def too_slow(start: StartSettings, flow: float, first: Observations) -> str:
    """Why there is no start yet where the picture has hardly moved since `first`."""
    seen = f"the flow since frame {first.index} is {flow:.1%} of the image width, {start.flow:.1%} needed"
    return f"{seen}: the camera stands still or moves slowly; give a longer sequence, in which the flow adds up"


def short_lived(start: StartSettings, first: Observations, now: Observations) -> str:
    """Why there is no start yet where too few tracks last from `first` to `now`."""
    if first.index == now.index:
        return "there is only one frame yet"
    seen = int(now.visible.sum())
    if seen < start.points:
        return (
            f"only {seen} features in frame {now.index}, {start.points} are needed: it is blurred, dark or without "
            "texture; film with more light and a shorter exposure"
        )
    return _few(start, first, now)


def _few(start: StartSettings, first: Observations, now: Observations) -> str:
    had, left = int(first.visible.sum()), int(first.common(now).sum())
    least = max(start.points, math.ceil(start.common * had))
    return (
        f"of {had} features of frame {first.index} {left} are left in frame {now.index}, {least} are needed: the "
        "picture changes too fast, or has too little contrast; give frames that follow each other more closely, or "
        "brighter ones"
    )


def _zoomed(scale: float) -> str:
    return (
        f"the picture only turns, and grows {scale:.3g} times, as of a lens that zooms, or of a camera that moves "
        "straight towards a flat scene: neither shows depth; cut the clip where the zoom ends, or give one with "
        "sideways motion"
    )


def _transfer_cost(
    settings: Settings, h: Hypothesis, first: Observations, last: Observations, between: list[Observations]
) -> float:
    """Truncated squared distances of the points transferred to the frames between the pair."""
    pose = compose(h.pose.rotation, h.pose.translation)
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(h.inside)
    state = init_tracks(settings, *arrays, pose, world=identity(settings.sigma.dtype))
    cost, before = 0.0, first.index
    for frame in between:
        visible = first.common(frame) & h.inside
        state, report = hold(settings, state, frame, visible, float(frame.index - before))
        found = np.asarray(report.diagnostics.distance)
        distance = np.where(found < TRUNCATED, found, TRUNCATED)
        measured = visible & np.asarray(state.tracks.usable)
        cost += float(distance[measured].sum()) + TRUNCATED * float((visible & ~measured).sum())
        before = frame.index
    return cost


def fill(
    settings: Settings, frames: list[Observations], two_view: TwoView, world: SE3, dt: list[float]
) -> tuple[track_pairs.State, list[tuple[Observations, Report]]]:
    """Set up the tracker on the first and last of `frames`, whose relative pose is given, and run it over them.

    `world` is the pose of the first frame, `dt` the time of each other frame since the one before, in frames. Returns
    the state at the last frame, and the reports of all frames but the first.
    """
    first, last = frames[0], frames[-1]
    common = first.common(last)
    pose = compose(two_view.rotation, two_view.translation)
    arrays = jnp.asarray(first.u), jnp.asarray(last.u), jnp.asarray(common)

    def over(noise: float) -> tuple[track_pairs.State, list[tuple[Observations, Report]]]:
        state, reports = init_tracks(settings, *arrays, pose, world=world, noise=noise), []
        for frame, elapsed in zip(frames[1:], dt, strict=True):
            state, report = hold(settings, state, frame, first.common(frame) & common, elapsed)
            reports.append((frame, report))
        return state, reports

    once = over(1.0)
    noise = max(float(report.noise) for _, report in once[1])
    # Where the frames between show more noise than is assumed, once more: the points of the pair have it, too.
    return once if noise == 1 else over(noise)


def hold(
    settings: Settings, state: track_pairs.State, frame: Observations, visible: np.ndarray, dt: float
) -> tuple[track_pairs.State, Report]:
    """One frame measured with the tracks as they are: none begins, no keyframe is made."""
    nothing = np.zeros(len(visible), bool)
    return step_tracks(settings, state, frame.u, visible, nothing, dt, hold=np.True_, quality=frame.quality)
