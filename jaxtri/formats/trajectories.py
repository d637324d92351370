"""Trajectory files: TUM, KITTI, EuRoC; read by what the first line looks like."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxtri.errors import TrajectoryError
from jaxtri.formats.files import PathLike, atomic_write, check_rows, read_rows, read_text
from jaxtri.trajectory import Trajectory

_DIGITS = "%.15g"  # what a double keeps of any decimal number


def read_trajectory(path: PathLike) -> Trajectory:
    """Read a trajectory in the format that its first line of data looks like: TUM, KITTI or EuRoC.

    Raises `TrajectoryError`, with the line where there is one.
    """
    data = (line.split("#")[0].strip() for line in read_text(path, TrajectoryError).splitlines())
    first = next(filter(None, data), "")
    if "," in first:
        return read_euroc(path)
    readers = {8: read_tum, 12: read_kitti}
    columns = len(first.split())
    if columns not in readers:
        raise TrajectoryError(
            f"{path}: no known trajectory format: expected lines of 8 numbers ({_TUM}: TUM), 12 numbers "
            f"({_KITTI}: KITTI) or at least 8 separated by commas (EuRoC), got {first[:80]!r}"
        )
    return readers[columns](path)


_TUM = "timestamp tx ty tz qx qy qz qw"
_KITTI = "the rows of [R p]"
_EUROC = "timestamp [ns], px, py, pz, qw, qx, qy, qz"


def read_tum(path: PathLike) -> Trajectory:
    """Read `timestamp tx ty tz qx qy qz qw` (seconds, camera to world). Raises `TrajectoryError`."""
    lines, v = read_rows(path, 8, _TUM, TrajectoryError)
    return _trajectory(path, lines, v[:, 0], v[:, 1:4], v[:, 4:])


def read_euroc(path: PathLike) -> Trajectory:
    """Read EuRoC's ground truth `timestamp [ns], p xyz, q wxyz, ...`; what follows is left out.

    The poses are those of the sensor that the file describes: in EuRoC's own
    `state_groundtruth_estimate0` that is the body, not a camera. Raises `TrajectoryError`.
    """
    lines, v = read_rows(path, 8, _EUROC, TrajectoryError, separator=",", more=True)
    return _trajectory(path, lines, v[:, 0] / 1e9, v[:, 1:4], v[:, [5, 6, 7, 4]])


def read_kitti(path: PathLike, times: Float[np.ndarray, " t"] | None = None) -> Trajectory:
    """Read the first three rows of each camera-to-world pose, row after row in one line.

    The file holds no `times` (seconds); without them they are the frame numbers. Raises `TrajectoryError`.
    """
    lines, v = read_rows(path, 12, _KITTI, TrajectoryError)
    Rp = v.reshape(-1, 3, 4)
    rigid = np.abs(np.cross(Rp[:, 0, :3], Rp[:, 1, :3]) - Rp[:, 2, :3]).max(1) < 1e-3
    check_rows(path, lines, rigid, "the left 3x3 is no rotation", TrajectoryError)
    bottom = np.broadcast_to([0.0, 0, 0, 1], (len(v), 1, 4))
    return Trajectory(np.arange(float(len(v))) if times is None else times, np.concatenate([Rp, bottom], 1))


def write_tum(path: PathLike, trajectory: Trajectory, header: str = _TUM) -> None:
    """Write `timestamp tx ty tz qx qy qz qw`, after `header` as comment lines."""
    q = _rotation().from_matrix(trajectory.rotations).as_quat(canonical=True)
    _write_rows(path, header, " ", "%.9f", trajectory.times, np.hstack([trajectory.positions, q]))


def write_euroc(path: PathLike, trajectory: Trajectory, header: str = _EUROC) -> None:
    """Write `timestamp [ns], p xyz, q wxyz`, after `header` as comment lines."""
    q = _rotation().from_matrix(trajectory.rotations).as_quat(canonical=True, scalar_first=True)
    nanoseconds = np.rint(trajectory.times * 1e9)
    _write_rows(path, header, ",", "%d", nanoseconds, np.hstack([trajectory.positions, q]))


def write_kitti(path: PathLike, trajectory: Trajectory) -> None:
    """Write the first three rows of each camera-to-world pose in one line; the times are lost."""
    Rp = trajectory.T_world_camera[:, :3].reshape(-1, 12)
    _write_rows(path, "", " ", _DIGITS, Rp[:, 0], Rp[:, 1:])


_DIGITS = "%.15g"  # what a double keeps of any decimal number


def _trajectory(path, lines, times, positions, q) -> Trajectory:
    """From quaternions x y z w."""
    check_rows(path, lines[1:], np.diff(times) > 0, "timestamps must increase strictly", TrajectoryError)
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    check_rows(path, lines, np.abs(norm[:, 0] - 1) < 1e-2, "the quaternion is not of length 1", TrajectoryError)
    T = np.zeros((len(q), 4, 4))
    T[:, :3, :3] = _rotation().from_quat(q).as_matrix()
    T[:, :3, 3] = positions
    T[:, 3, 3] = 1
    return Trajectory(times, T)


def _rotation() -> Any:
    from scipy.spatial.transform import Rotation  # here: a fifth of the time that importing the package takes

    return Rotation


def _write_rows(path, header, separator, first_format, first, rest) -> None:
    with atomic_write(path) as file:
        file.writelines(f"# {line}\n" for line in header.splitlines())
        for a, row in zip(first, rest, strict=True):
            file.write(separator.join([first_format % a, *(_DIGITS % value for value in row)]) + "\n")
