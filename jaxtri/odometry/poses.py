"""Poses of single frames on the host, and the trajectory that they make."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxlie import SE3

from jaxtri.errors import InitialisationError
from jaxtri.odometry.measuring import doubts
from jaxtri.odometry.settings import Report, Status
from jaxtri.trajectory import Trajectory

_as_matrix = jax.jit(SE3.as_matrix)


@dataclass
class FramePose:
    """One frame of the result.

    Attributes:
        time: Seconds.
        status: What the pose is worth.
        T_camera_world: (4, 4), world to camera, translation in scene units; None where there is no pose.
        covariance: (6, 6), of the pose's error exp(xi) T_camera_world, (linear, angular) in camera axes, scene
            units and radians; None where there is no pose.
        used: How many points agreed.
        nis: Normalised innovation squared of these points: 2 `used` is right. NaN where nothing was measured.
        measured: How many points were measured.
        parallax_deg: Median angle between the rays that the points used are known from; NaN where there is none.
        noise: Standard deviation that the points were taken to have, over the one assumed.
        zoom: Focal length over that of the first frame, where it is found to change though the camera is taken to have
            one; NaN elsewhere.
        start: Number of the start, from 0, in whose world and at whose scale the pose is.
        found: Frame in which the scene of an earlier start was found again after this one; None elsewhere.
    """

    time: float
    status: Status
    T_camera_world: np.ndarray | None = None
    covariance: np.ndarray | None = None
    used: int = 0
    nis: float = float("nan")
    measured: int = 0
    parallax_deg: float = float("nan")
    noise: float = 1.0
    zoom: float = float("nan")
    start: int = 0
    found: int | None = None

    @classmethod
    def of(cls, time: float, report: Report, start: int = 0) -> "FramePose":
        """The pose of a frame from what the filter reports of it."""
        said, status = report.diagnostics, Status(int(report.status))
        covariance = np.asarray(report.covariance, np.float64)
        counts, angle = (int(said.used), float(said.nis), int(said.measured)), math.degrees(report.parallax)
        return cls(time, status, pose_matrix(report.pose), covariance, *counts, angle, float(report.noise), start=start)

    @property
    def rotation_sd_deg(self) -> float:
        """Standard deviation of the rotation about the camera axis where it is largest; NaN where there is no pose."""
        return math.nan if self.covariance is None else math.degrees(np.sqrt(self.covariance.diagonal()[3:].max()))

    @property
    def position_sd(self) -> float:
        """Standard deviation of the position along the camera axis where it is largest, scene units; NaN without."""
        return math.nan if self.covariance is None else float(np.sqrt(self.covariance.diagonal()[:3].max()))

    @property
    def doubts(self) -> list[str]:
        """Why the frame is uncertain, in words; empty where it is not."""
        if self.status is not Status.UNCERTAIN:
            return []
        found = doubts(self.nis, self.used, self.measured, math.radians(self.rotation_sd_deg))
        words = {
            "its points fit {worse:.1f} times worse than their noise explains": found.misfit,
            "only {used} of {measured} points agree": found.minority,
            "its rotation is known to {sd:.1f} degrees": found.blurred,
            "the camera zooms, and has {zoom:.2f} times the focal length of the first frame": not math.isnan(self.zoom),
            "what was lost is found again in frame {found}: this is another place, or something that moved before the "
            "camera, and its scale is a guess": self.found is not None,
        }
        numbers = {
            "worse": math.sqrt(self.nis / (2 * self.used)) if self.used else math.nan,
            "used": self.used,
            "measured": self.measured,
            "sd": self.rotation_sd_deg,
            "zoom": self.zoom,
            "found": self.found,
        }
        return [word.format(**numbers) for word, true in words.items() if true]

    def scaled(self, scale: float) -> "FramePose":
        """The pose in other units of length."""
        if self.T_camera_world is None or self.covariance is None:
            return self
        T, s = self.T_camera_world.copy(), np.repeat([scale, 1.0], 3)
        T[:3, 3] *= scale
        return replace(self, T_camera_world=T, covariance=self.covariance * np.outer(s, s))


def pose_matrix(pose: SE3) -> np.ndarray:
    """The (4, 4) matrix of a pose, in double precision."""
    return np.asarray(_as_matrix(pose), np.float64)


def trajectory(poses: Sequence[FramePose], reason: str) -> Trajectory:
    """The trajectory of all frames, camera to world; a frame without a pose repeats its nearest neighbour's.

    Raises `InitialisationError`, with the reason, where no frame has a pose.
    """
    known = [i for i, p in enumerate(poses) if p.T_camera_world is not None]
    if not known:
        raise InitialisationError(f"no camera motion was found in {len(poses)} frames: {reason}")
    nearest = [known[int(np.argmin(np.abs(np.array(known) - i)))] for i in range(len(poses))]
    T = np.stack([poses[i].T_camera_world for i in nearest])  # pyright: ignore[reportArgumentType, reportCallIssue]
    C = np.stack([poses[i].covariance for i in nearest])  # pyright: ignore[reportArgumentType, reportCallIssue]
    R = np.swapaxes(T[:, :3, :3], 1, 2)
    world = np.tile(np.eye(4), (len(T), 1, 1))
    world[:, :3, :3] = R
    world[:, :3, 3] = 0.0 - np.einsum("tij,tj->ti", R, T[:, :3, 3])
    # exp(xi) T_camera_world moves the centre by -R' rho and turns R_world_camera by exp(-theta) on the right.
    J = np.zeros((len(T), 6, 6))
    J[:, :3, :3] = -R
    J[:, 3:, 3:] = -np.eye(3)
    times = np.array([p.time for p in poses])
    status = np.array([int(p.status) for p in poses])
    return Trajectory(times, world, J @ C @ np.swapaxes(J, 1, 2), status)
