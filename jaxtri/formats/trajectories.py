"""Trajectory files: TUM, KITTI, EuRoC; read by the names of their columns, or by what their lines look like."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from jaxtri.errors import TrajectoryError, TrajectoryWarning
from jaxtri.formats.files import PathLike, atomic_write, check_rows, read_text
from jaxtri.formats.times import UNIT_NAMES, read_timestamps, stamp_unit
from jaxtri.trajectory import Trajectory

_DIGITS = "%.15g"  # what a double keeps of any decimal number


@dataclass(frozen=True)
class _Form:
    """Where the columns t, x, y, z, qx, qy, qz, qw stand, and the unit of t; None to tell it by the stamps."""

    meaning: str
    columns: tuple[int, ...]
    unit: float | None = None
    width: int | None = None  # of a line; None for at least as many as are named


_TUM = _Form("timestamp tx ty tz qx qy qz qw", (0, 1, 2, 3, 4, 5, 6, 7), width=8)
_EUROC = _Form("timestamp [ns], px, py, pz, qw, qx, qy, qz", (0, 1, 2, 3, 5, 6, 7, 4))
_KITTI = _Form("the rows of [R p]", tuple(range(12)), width=12)


@dataclass(frozen=True)
class _Table:
    """The lines of a file, split; `head` is the line before them if it names every column that is needed."""

    path: PathLike
    head: _Form | None
    commas: bool
    lines: list[int]
    rows: list[list[str]]

    def stamps(self) -> Float64[np.ndarray, " t"]:
        return self.values((0,))[1][:, 0]

    def values(self, columns: Sequence[int], form: _Form | None = None) -> tuple[list[int], np.ndarray]:
        """Line numbers and finite or NaN values of the columns; a line that is not of the form is an error."""
        found = []
        for number, row in zip(self.lines, self.rows, strict=True):
            try:
                values = [float(row[k]) for k in columns]
            except (ValueError, IndexError):
                values = []
            if not values or (form and form.width and len(row) != form.width):
                expected = f"expected {len(columns)} numbers ({form.meaning if form else 'timestamp'})"
                raise TrajectoryError(f"{self.path}:{number}: {expected}, got {' '.join(row)[:200]!r}")
            found.append(values)
        return self.lines, np.asarray(found, np.float64).reshape(-1, len(columns))


def read_trajectory(path: PathLike) -> Trajectory:
    """Read a trajectory in TUM's, KITTI's or EuRoC's format, separated by blanks, tabs, commas or semicolons.

    A line of names before the data says which column is which, and the unit of the stamps. Without, eight columns
    are TUM's (seconds, q x y z w) unless commas separate them and the stamps are nanoseconds (EuRoC's, q w x y z);
    more than eight and commas are EuRoC's; twelve without commas are KITTI's, which has no times.

    Lines that hold NaN, or the time stamp of the line before, are left out, and a `TrajectoryWarning` counts them;
    another says where TUM's stamps are not seconds and are converted. Raises `TrajectoryError`, with the line where
    there is one.
    """
    table = _table(path)
    columns = len(table.rows[0]) if table.rows else 0
    if table.head is None and columns == 12 and not table.commas:
        return _kitti(table)
    if table.head is None and columns != 8 and not (columns > 8 and table.commas):
        first = " ".join(table.rows[0]) if table.rows else ""
        raise TrajectoryError(
            f"{path}: no known trajectory format: expected lines of 8 numbers ({_TUM.meaning}: TUM), 12 numbers "
            f"({_KITTI.meaning}: KITTI), or at least 8 separated by commas ({_EUROC.meaning}: EuRoC), or a first line "
            f"that names the columns; got {first[:80]!r}"
        )
    euroc = table.commas and (columns > 8 or stamp_unit(_finite(table.stamps())) == 1e-9)
    return _posed(table, _EUROC if euroc else _TUM)


def read_tum(path: PathLike) -> Trajectory:
    """Read `timestamp tx ty tz qx qy qz qw` (seconds, camera to world); as `read_trajectory` otherwise."""
    return _posed(_table(path), _TUM)


def read_euroc(path: PathLike) -> Trajectory:
    """Read EuRoC's ground truth `timestamp [ns], p xyz, q wxyz, ...`; what follows is left out.

    The poses are those of the sensor that the file describes: in EuRoC's own
    `state_groundtruth_estimate0` that is the body, not a camera. As `read_trajectory` otherwise.
    """
    return _posed(_table(path), _EUROC)


def read_kitti(path: PathLike, times: Float[np.ndarray, " t"] | None = None) -> Trajectory:
    """Read the first three rows of each camera-to-world pose, row after row in one line.

    The file holds no `times` (seconds); without them they are the numbers of the lines, and `frames` says so. Lines
    of NaN are left out with a `TrajectoryWarning`. Raises `TrajectoryError`.
    """
    return _kitti(_table(path), times)


def read_pair(estimate: PathLike, reference: PathLike, times: PathLike | None = None) -> tuple[Trajectory, Trajectory]:
    """Read two trajectories that are to be compared, with times for KITTI's files where they are to be had.

    `times` is a file with the time of every line of a KITTI file. Without it, where one of the two has times and the
    other is KITTI's, a `times.txt` of the same length is used that lies beside the file, one folder above, or where
    KITTI's own is (`sequences/NN/times.txt` of `poses/NN.txt`); a `TrajectoryWarning` says so. Raises
    `TrajectoryError`, also where `times` fits neither.
    """
    paths = estimate, reference
    found = [read_trajectory(path) for path in paths]
    bare = [k for k in (0, 1) if found[k].frames is not None]
    if times is not None:
        stamps = read_timestamps(times)
        fitting = [k for k in bare if found[k].frames == len(stamps)]
        if not fitting:
            counts = ", ".join(f"{paths[k]} has {found[k].frames} lines" for k in bare)
            raise TrajectoryError(f"{times} has {len(stamps)} times, and {counts or 'neither file is in KITTI format'}")
        for k in fitting:
            found[k] = _at(found[k], stamps)
    elif len(bare) == 1:
        k = bare[0]
        path = Path(paths[k])
        places = (path.parent, path.parent.parent, path.parent.parent / "sequences" / path.stem)
        for file in (place / "times.txt" for place in places):
            if file.is_file() and len(stamps := read_timestamps(file)) == found[k].frames:
                _warn(f"{path}: KITTI's format has no times; those of {file} are used")
                found[k] = _at(found[k], stamps)
                break
    return found[0], found[1]


def write_tum(path: PathLike, trajectory: Trajectory, header: str = _TUM.meaning) -> None:
    """Write `timestamp tx ty tz qx qy qz qw`, after `header` as comment lines."""
    q = _rotation().from_matrix(trajectory.rotations).as_quat(canonical=True)
    _write_rows(path, header, " ", "%.9f", trajectory.times, np.hstack([trajectory.positions, q]))


def write_euroc(path: PathLike, trajectory: Trajectory, header: str = _EUROC.meaning) -> None:
    """Write `timestamp [ns], p xyz, q wxyz`, after `header` as comment lines."""
    q = _rotation().from_matrix(trajectory.rotations).as_quat(canonical=True, scalar_first=True)
    nanoseconds = np.rint(trajectory.times * 1e9)
    _write_rows(path, header, ",", "%d", nanoseconds, np.hstack([trajectory.positions, q]))


def write_kitti(path: PathLike, trajectory: Trajectory) -> None:
    """Write the first three rows of each camera-to-world pose in one line; the times are lost."""
    Rp = trajectory.T_world_camera[:, :3].reshape(-1, 12)
    _write_rows(path, "", " ", _DIGITS, Rp[:, 0], Rp[:, 1:])


def _table(path: PathLike) -> _Table:
    head, lines, rows, separator = None, [], [], None
    for number, line in enumerate(read_text(path, TrajectoryError).splitlines(), 1):
        data, _, comment = line.partition("#")
        data = data.strip().rstrip(",;")
        if data and not rows:
            separator = next((s for s in ";," if s in data), None)
            if not any(map(_is_number, data.split(separator))):
                data, comment = "", data
        if data:
            lines.append(number)
            rows.append([field.strip() for field in data.split(separator)])
        elif comment and not rows:
            head = _named(comment) or head
    return _Table(path, head, separator is not None, lines, rows)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


_SECONDS = {"s": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}  # by the first letter of a unit


def _named(head: str) -> _Form | None:
    """The form that a line of names describes, if it names all that a pose needs."""
    head = head.strip().lstrip("#%").strip()
    words = re.split(r"\s*[,;]\s*", head) if re.search("[,;]", head) else re.sub(r"\s+(?=[\[(])", "", head).split()
    columns: dict[str, int] = {}
    unit = None
    for k, word in enumerate(words):
        name, _, brackets = re.sub(r"[\])]$", "", word.lower()).replace("(", "[").partition("[")
        name = name.strip()
        if re.search(r"time|stamp", name) or name in ("t", "ts"):
            said = re.fullmatch(r"([mun]?|milli|micro|nano)s(ec\w*)?", brackets or name.rpartition("_")[2])
            if "t" not in columns and said:
                letter = "u" if said[1] == "micro" else said[1][:1]
                unit = _SECONDS[letter or "s"]
            columns.setdefault("t", k)
        elif quaternion := re.fullmatch(r"(?:q\w*?|.*(?:quat|orient|rot).*?)[_.]?([xyzw])", name):
            columns.setdefault("q" + quaternion[1], k)
        elif position := re.fullmatch(r"(?:p|t|p_\w*?|.*(?:pos|trans).*?)?[_.]?([xyz])", name):
            columns.setdefault(position[1], k)
    needed = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
    if not all(key in columns for key in needed):
        return None
    return _Form(" ".join(words), tuple(columns[key] for key in needed), unit)


def _posed(table: _Table, form: _Form) -> Trajectory:
    """Poses of a file with stamps and quaternions in `form`, or as the names of its columns say."""
    if not table.rows:
        raise TrajectoryError(f"{table.path}: holds no data; expected lines of {form.meaning}")
    shape = table.head or form
    lines, v = table.values(shape.columns, shape)
    lines, v = _without(table.path, lines, v, ~np.isfinite(v).all(1), "hold NaN")
    unit = shape.unit
    if unit is None:
        whole = form is _EUROC and all(re.fullmatch(r"[+-]?\d+", row[shape.columns[0]]) for row in table.rows)
        unit = 1e-9 if whole else stamp_unit(v[:, 0])
        if unit != (1e-9 if form is _EUROC else 1.0):
            _warn(f"{table.path}: its time stamps look like {UNIT_NAMES[unit]} and are read as such")
    v[:, 0] /= round(1 / unit)
    lines, v = _without(table.path, lines, v, np.diff(v[:, 0], prepend=-np.inf) == 0, "repeat the time stamp before")
    return _trajectory(table.path, lines, v[:, 0], v[:, 1:4], v[:, 4:])


def _kitti(table: _Table, times: Float[np.ndarray, " t"] | None = None) -> Trajectory:
    if not table.rows:
        raise TrajectoryError(f"{table.path}: holds no data; expected lines of {_KITTI.meaning}")
    lines, v = table.values(_KITTI.columns, _KITTI)
    n, numbers = len(v), np.arange(float(len(v)))
    bad = ~np.isfinite(v).all(1)
    lines, v = _without(table.path, lines, v, bad, "hold NaN")
    Rp = v.reshape(-1, 3, 4)
    rigid = np.abs(np.cross(Rp[:, 0, :3], Rp[:, 1, :3]) - Rp[:, 2, :3]).max(1) < 1e-3
    check_rows(table.path, lines, rigid, "the left 3x3 is no rotation", TrajectoryError)
    bottom = np.broadcast_to([0.0, 0, 0, 1], (len(v), 1, 4))
    found = Trajectory(numbers[~bad], np.concatenate([Rp, bottom], 1), frames=n)
    return found if times is None else _at(found, np.asarray(times))


def _at(numbered: Trajectory, times: np.ndarray) -> Trajectory:
    """The same poses at the times of their lines."""
    if len(times) != numbered.frames:
        raise TrajectoryError(f"there are {len(times)} times for {numbered.frames} lines in KITTI format")
    return Trajectory(times[numbered.times.astype(int)], numbered.T_world_camera)


def _without(path, lines, v, bad, reason) -> tuple[list[int], np.ndarray]:
    """What is left of lines and values; a warning counts the bad ones."""
    if bad.all():
        raise TrajectoryError(f"{path}: all of its {len(bad)} lines {reason}")
    if bad.any():
        _warn(
            f"{path}: {bad.sum()} of {len(bad)} lines {reason} and are left out, line {lines[int(bad.argmax())]} first"
        )
    return [n for n, b in zip(lines, bad, strict=True) if not b], v[~bad]


def _warn(message: str) -> None:
    warnings.warn(message, TrajectoryWarning, stacklevel=2)


def _finite(x: np.ndarray) -> np.ndarray:
    return x[np.isfinite(x)]


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
