"""Found again: states of the filter at places that were left, to go on from where tracks of theirs come back.

A state is kept whenever more than half of the points of the last one are gone, and where the camera is about to be
lost. Tracks that come back are the points that it knew: from them the camera's pose follows, and the filter goes on
from that state as if nothing had been between, in the same world, at the same scale.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxtri.odometry import track_pairs
from jaxtri.odometry.followers import Follower, TrackPairs
from jaxtri.odometry.measuring import FARTHEST
from jaxtri.odometry.poses import FramePose
from jaxtri.odometry.settings import Report, Settings, Status
from jaxtri.odometry.slots import slots
from jaxtri.odometry.start import Observations, step_tracks
from jaxtri.odometry.structure import Structure
from jaxtri.vision.hypotheses import resection
from jaxtri.vision.places import Returns

GONE = 0.5  # share of a place's points that are left, below which the next state is kept
MOST = 64  # states that are kept; where there are more, every other one of the older half is forgotten
TRIED = 3  # states that are tried for a frame

_recalled = jax.jit(track_pairs.recalled)


class Place(NamedTuple):
    """A state of the filter.

    Attributes:
        frame: After which it was.
        start: Number of the start whose world it is in.
        state: All that was known.
        known: (n,) number of the track whose point is known in each slot, -1 where none is.
    """

    frame: int
    start: int
    state: track_pairs.State
    known: np.ndarray


class Found(NamedTuple):
    """The camera found again.

    Attributes:
        frame: In which it is.
        place: Frame whose state is gone on from.
        since: The first frame that is not in the world of that state.
        points: How many of its points agree.
    """

    frame: int
    place: int
    since: int
    points: int


@dataclass
class Places:
    """The places of a run, in order."""

    kept: list[Place] = field(default_factory=list)

    def see(self, frame: int, start: int, follower: Follower, *, last: bool = False) -> None:
        """Keep the state after a frame where one is due, or where it may be the `last` good one."""
        if not isinstance(follower, TrackPairs):
            return
        now = Place(
            frame, start, follower.state, np.where(np.asarray(follower.state.tracks.usable), follower.known, -1)
        )
        if self.kept and not last:
            before = self.kept[-1].known
            if np.isin(before[before >= 0], now.known).sum() >= GONE * (before >= 0).sum():
                return
        self.kept.append(now)
        if len(self.kept) > MOST:
            self.kept = self.kept[: MOST // 2 : 2] + self.kept[MOST // 2 :]

    def forget(self, frame: int) -> None:
        """Those from a frame on."""
        self.kept = [p for p in self.kept if p.frame < frame]

    def find(
        self, settings: Settings, frame: Observations, fewest: int, before: int
    ) -> tuple[Place, TrackPairs, Report] | None:
        """The filter that goes on in a frame from the place that most of what has returned belongs to.

        Of the places of starts `before` a number. None where fewer than so many points agree with one pose, or its
        numbers do not hold together.
        """
        if frame.returns is None:
            return None
        places = [p for p in self.kept if p.start < before]
        counts = [np.isin(frame.returns.before, p.known).sum() for p in places]
        for which in np.argsort(counts, kind="stable")[: -TRIED - 1 : -1]:
            if counts[which] < fewest:
                break
            found = _found(settings, places[which], frame, frame.returns, fewest)
            if found is not None:
                return places[which], *found
        return None


def _found(
    settings: Settings, place: Place, frame: Observations, returns: Returns, fewest: int
) -> tuple[TrackPairs, Report] | None:
    now, before = slots(frame.ids, returns.now), slots(place.known, returns.before)
    both = (now >= 0) & (before >= 0)
    now, before = now[both], before[both]
    X = np.asarray(place.state.tracks.base.point, np.float64)[before]
    near = X[:, 3] > FARTHEST
    seen = resection(X[near, :3] / X[near, 3:], frame.u[now[near]].astype(np.float64), float(settings.epipolar_gate))
    if seen is None or seen[1].sum() < fewest:
        return None
    n = len(frame.ids)
    source, kept = np.full(n, -1), np.zeros(n, bool)
    source[now], kept[now] = before, True
    source[source < 0] = np.setdiff1d(np.arange(n), before)
    pose = SE3.from_matrix(jnp.asarray(seen[0], frame.u.dtype))
    state = _recalled(place.state, source, kept, pose)
    fresh = frame.visible & ~kept
    state, report = step_tracks(
        settings, state, frame.u, frame.visible, fresh, 1.0, hold=np.False_, quality=frame.quality, late=frame.late
    )
    if Status(int(report.status)) is not Status.TRACKING or int(report.diagnostics.used) < fewest:
        return None
    known = np.where(frame.visible, frame.ids, -1)
    return TrackPairs(settings, state, known, Structure(settings)), report


def mark_apart(poses: list[FramePose], start: int, found: int) -> int:
    """Call uncertain what was followed since a world was left, now that it is found again; the first such frame."""
    since = 1 + max(k for k, p in enumerate(poses) if p.start == start and p.T_camera_world is not None)
    for pose in poses[since:]:
        if pose.status.measured:
            pose.status, pose.found = Status.UNCERTAIN, found
    return since
