"""A start on the host: a base pair among the frames that wait, the filter that goes on from it, the frames it fills."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxtri.estimation.two_view import scaled
from jaxtri.geometry.pose import identity
from jaxtri.odometry.followers import Follower, SinglePair, TrackPairs
from jaxtri.odometry.poses import FramePose, pose_matrix
from jaxtri.odometry.settings import Base, Report, Settings, StartSettings, Status
from jaxtri.odometry.start import BasePair, Observations, Start, fill, find, hold
from jaxtri.odometry.track_pairs import State


class Before(NamedTuple):
    """What is known from before the camera was lost.

    Attributes:
        T_camera_world: Its last pose, world to camera.
        depth: How deep the scene was.
        start: Number of the start to come.
    """

    T_camera_world: np.ndarray
    depth: float
    start: int


class Begun(NamedTuple):
    """A start: its base pair, the filter that goes on from it, and the poses of the frames that waited for it."""

    pair: BasePair
    follower: Follower
    poses: dict[int, FramePose]


def begin(
    settings: Settings,
    start: StartSettings,
    base: Base,
    waiting: list[Observations],
    passed: list[Observations],
    dt: Callable[[int], float],
    before: Before | None,
) -> Begun | Start:
    """The filter from the first and the last of the frames that wait; or why it has to wait.

    The frames between, and the `passed` ones before them, are filled in. `dt` is the time of a frame since the one
    before, in frames.
    """
    searched = find(settings, start, waiting)
    if searched.found is None:
        return searched
    pose, (first, *_, last) = searched.found.pose, waiting
    world = identity(pose.translation.dtype)
    if before is not None:
        world = SE3.from_matrix(jnp.asarray(before.T_camera_world, pose.translation.dtype))
        state, _ = fill(settings, [first, last], pose, world, [1.0])
        pose = scaled(pose, before.depth / float(state.depth))  # the scene as deep as it was: a guess
    state, reports = fill(settings, waiting, pose, world, [dt(f.index) for f in waiting[1:]])
    noise = float(reports[0][1].noise)
    poses = {first.index: FramePose(first.time, Status.TRACKING, pose_matrix(world), np.zeros((6, 6)))}
    reports = [*reports, *_backwards(settings, passed, first, state, world)]
    poses |= {f.index: FramePose.of(f.time, report) for f, report in reports}
    if before is not None:
        poses = {k: replace(pose, start=before.start) for k, pose in poses.items()}
        poses[min(poses)].status = Status.RESTARTED
    if base is Base.TRACKS:
        follower: Follower = TrackPairs.after(settings, state, last, first.common(last))
    else:
        follower = SinglePair.after(settings, start, base, waiting, pose, world)
    pair = BasePair(first.index, last.index, first.index, searched.found.pose, searched.found.inside, noise)
    return Begun(pair, follower, poses)


def _backwards(
    settings: Settings, passed: list[Observations], first: Observations, state: State, world: SE3
) -> Iterator[tuple[Observations, Report]]:
    """Frames that waited before the first base frame, newest first, as far as its tracks reach."""
    mean = eqx.tree_at(lambda m: (m.pose, m.twist), state.belief.mean, (world, jnp.zeros_like(state.belief.mean.twist)))
    state = state._replace(belief=eqx.tree_at(lambda b: b.mean, state.belief, mean))
    for frame in reversed(passed):
        state, report = hold(settings, state, frame, first.common(frame), 1.0)
        if not Status(int(report.status)).measured:
            return
        yield frame, report
