"""A whole run once more, from all that was seen: keyframes and points at once, then the frames between them.

Keyframes are frames between which the tracks have moved by `Settings.keyframe_flow`. Their poses and all points seen
from them are brought to maximum likelihood (`jaxtri.estimation.batch`), from what the recursive filter made of them.
Places that are seen again are then counted (`jaxtri.odometry.loops`), and all of it is brought there once more. A frame
between two keyframes is measured from the points as they are (`jaxtri.odometry.adjusted`).
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from jaxtri.errors import InputError, InputWarning
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.odometry.adjusted import Adjusted
from jaxtri.odometry.adjustment import FEWEST, stretch
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.poses import FramePose, trajectory
from jaxtri.odometry.settings import Status
from jaxtri.odometry.stretches import worlds
from jaxtri.odometry.structure import Points
from jaxtri.trajectory import Trajectory


@dataclass
class Refinement:
    """What all that was seen says of a run.

    Attributes:
        poses: One `FramePose` a frame; its `nis` is by the noise that was found, where that is more than the one
            assumed. A frame that the camera was not followed in is as it was.
        points: The scene; covariances of each point's own error, the poses given.
        keyframes: Numbers of the frames that were adjusted together with the points.
        statistics: Figures, as `run.json` has them.
    """

    poses: list[FramePose]
    points: Points
    keyframes: list[int]
    statistics: dict[str, object]

    def trajectory(self) -> Trajectory:
        """Camera poses, camera to world, one a frame."""
        return trajectory(self.poses, "none was refined")


def refine(odometry: Odometry, *, loops: bool = True, progress: bool = False) -> Refinement:
    """Bundle adjustment of a run: `Odometry(..., record=True)`, or `run.odometry` of `track(..., record=True)`.

    With `loops`, places that are seen again are counted, where the run was told of them (`Odometry.returns`): what has
    drifted on the way around comes back, and what was lost and found again is one. Where the camera was lost for good,
    each part is refined by itself. Its first pose stays, and so does its scale: the distance
    from there to the keyframe that is farthest from it. Covariances are with respect to these two, by the noise that is
    found where that is more than the one assumed. What the camera's calibration may be off by (`Settings.calibration`)
    is in them too; it is not estimated, since it looks too much like what features that drift do. That it changes on
    the way is another thing: where the camera is found to zoom an `InputWarning` says so, and frames are uncertain from
    there on. Raises `InputError` where no tracks were kept, `InitialisationError` where there is no pose.
    """
    if not odometry.record:
        raise InputError("nothing was recorded: ask for it by record=True")
    odometry.trajectory()  # takes in what is queued, and raises where there is none
    poses, points, chosen, parts = list(odometry.poses), [], [], []
    together = [part for frames in worlds(odometry) for part in _together(odometry, frames, loops, progress)]
    moved = np.broadcast_to(np.eye(4), (len(poses), 4, 4)).copy()  # the world of each frame, by what was refined before
    for frames, found in sorted(together, key=lambda part: part[0][0]):
        before = moved[frames[0] - 1] if frames[0] else np.eye(4)
        spans = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
        said: dict[str, object] = {"frames": [int(frames[0]), int(frames[-1])], "refined": found is not None}
        if found is None:
            for k in frames:
                poses[k] = _in(poses[k], before)
        else:
            zoom = found.zoom(odometry, progress) if odometry.zoom is None else None
            new = found.frames([poses[k] for k in frames])
            new = new if zoom is None else _zoomed(zoom, new, frames)
            old = [poses[span[-1]].T_camera_world for span in spans]
            for k, pose in zip(frames, new, strict=True):
                poses[k] = _in(pose, before)
            for span, then in zip(spans, old, strict=True):
                now = poses[span[-1]].T_camera_world
                assert then is not None
                assert now is not None
                moved[span[-1] :] = np.linalg.inv(then) @ now
            points.append(found.points(before))
            chosen += [int(k) for k in frames[found.keys]]
            ratio = None if zoom is None else [round(float(r), 4) for r in zoom.ratio[[0, -1]]]
            said |= {"zoom": ratio} | found.statistics
            said |= {} if len(spans) == 1 else {"spans": [[int(x[0]), int(x[-1])] for x in spans]}
        parts.append(said)
    rest = np.setdiff1d(np.arange(len(poses)), np.concatenate([frames for frames, _ in together]))
    for k in rest:
        poses[k] = _in(poses[k], moved[k])
    scene = _best(Points(*(np.concatenate(x) for x in zip(*points, strict=True)))) if points else odometry.points()
    return Refinement(poses, scene, sorted(chosen), {"parts": parts, "keyframes": len(chosen)})


def _together(
    odometry: Odometry, frames: np.ndarray, loops: bool, progress: bool
) -> list[tuple[np.ndarray, Adjusted | None]]:
    """What can be adjusted together of the frames of a world: all, or what lies between losses."""
    segment, keys, settings, noise = stretch(odometry, frames)
    found = Adjusted.of(settings, noise, odometry, segment, keys, loops, progress) if len(keys) >= FEWEST else None
    broken = [int(k) for k in segment.begins if k]
    if not broken or (found is not None and found.joined):
        return [(frames, found)]
    return [part for x in np.split(frames, broken) for part in _together(odometry, x, loops, progress)]


def _in(pose: FramePose, moved: np.ndarray) -> FramePose:
    """The pose in a world that has been moved."""
    T = pose.T_camera_world
    return pose if T is None else replace(pose, T_camera_world=T @ moved)


def _best(points: Points) -> Points:
    """Each track once, as it is known best: where it was cut it has several points."""
    order = np.argsort(np.trace(points.covariance, axis1=1, axis2=2), kind="stable")
    _, which = np.unique(points.ids[order], return_index=True)
    return Points(*(x[order[which]] for x in points))


def _zoomed(zoom: ZoomCurve, poses: list[FramePose], frames: np.ndarray) -> list[FramePose]:
    """Poses of `frames`, by a camera that is found to zoom."""
    times = np.array([p.time for p in poses])
    log = zoom.log(times)
    begun = int(np.argmax(np.abs(log) > np.interp(times, zoom.times_s, zoom.sd)))
    most = float(np.exp(log[np.argmax(np.abs(log))]))
    warnings.warn(
        f"the camera zooms from frame {frames[begun]} on, to {most:.2f} times the focal length of frame {frames[0]}, "
        "but is taken to have one, so that the path is wrong from there on: let it be followed, by --refine-camera "
        "beside --camera or --fov (track_uncalibrated)",
        InputWarning,
        stacklevel=3,
    )
    found = list(poses)
    for k in range(begun, len(poses)):
        status = Status.UNCERTAIN if poses[k].status is Status.TRACKING else poses[k].status
        found[k] = replace(poses[k], zoom=float(np.exp(log[k])), status=status)
    return found
