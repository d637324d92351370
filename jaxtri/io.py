"""Files in and out: cameras, time stamps, trajectories (TUM, KITTI, EuRoC), point clouds, JSON."""

import dataclasses
import json
import math
import os
import re
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from jaxtyping import Float, Float64, Shaped, UInt8

from jaxtri.errors import CameraError, InputError, TrajectoryError
from jaxtri.geometry.camera import BrownConrady, Camera, Fisheye
from jaxtri.trajectory import Trajectory

PathLike = str | os.PathLike[str]

_BROWN = ("plumb_bob", "radtan", "opencv_radtan", "radial-tangential", "rational_polynomial", "brown_conrady")
_FISHEYE = ("fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "equidistant")
_PINHOLE = ("pinhole", "opencv", "none")


def read_camera(path: PathLike, *, width: int | None = None, height: int | None = None) -> Camera:
    """Read a camera from JSON, OpenCV's calibration YAML, XML or JSON, or ROS camera_info YAML.

    JSON: fx, fy, cx, cy and, if any, skew, width, height, distortion, model, distortion_model. Others:
    camera_matrix, distortion_coefficients, image_width, image_height, distortion_model. Coefficients that
    are all zero are no distortion, unless the model is a fisheye. `width` and `height` are for files without
    them. Raises `CameraError` naming the file and the key.
    """
    try:
        return _camera(_entries(_read_text(path, CameraError)), width, height)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error


def _camera(entries: Mapping[str, Any], width: int | None, height: int | None) -> Camera:
    def number(key, default=None):
        value = entries.get(key, default)
        if value is None:
            raise CameraError(f"{key} is missing; add it, in pixels (or camera_matrix, 3x3)")
        return _numbers(key, value, 1)[0]

    matrix = entries.get("cameramatrix", entries.get("k"))
    if matrix is not None:
        fx, skew, cx, _, fy, cy, *_ = _numbers("camera_matrix", matrix, 9)
    else:
        fx, fy, cx, cy, skew = (*map(number, ("fx", "fy", "cx", "cy")), number("skew", 0.0))

    # The first word: what follows in brackets is a remark.
    words = [re.findall(r"[\w-]+", str(entries.get(key, "none"))) for key in ("model", "distortionmodel")]
    models = [word[0].lower() if word else "none" for word in words]
    known = (*_PINHOLE, *_BROWN, *_FISHEYE)
    for model in models:
        if model not in known:
            raise CameraError(f"model {model!r} is unknown; known are {', '.join(known)}")
    key = next((k for k in ("distortion", "distortioncoefficients", "distcoeffs", "d") if k in entries), None)
    coefficients = [] if key is None else _numbers(key, entries[key])
    if not all(map(math.isfinite, coefficients)):
        raise CameraError(f"{key} is {coefficients}; its coefficients must be finite")
    distortion = None
    if any(model in _FISHEYE for model in models):
        distortion = Fisheye.from_coefficients(coefficients)
    elif any(coefficients):
        distortion = BrownConrady.from_coefficients(coefficients)

    size = {"width": width, "height": height}
    for name, given in size.items():
        value = entries.get(name, entries.get("image" + name))
        if value is not None:
            stored = number(name if name in entries else "image" + name)
            if not (stored > 0 and stored % 1 == 0):
                raise CameraError(f"{name} is {stored}; it must be a positive whole number of pixels")
            if given not in (None, stored):
                raise CameraError(
                    f"{name} is {stored:g}, but {given} was asked for; calibrate for that size or "
                    "multiply fx, fy, cx, cy by the ratio"
                )
            size[name] = int(stored)
    return Camera.from_parameters(fx, fy, cx, cy, skew=skew, distortion=distortion, **size)


def _entries(text: str) -> dict[str, Any]:
    """The top-level entries, keys in lower case without underscores."""
    try:
        entries = json.loads(text) if text.lstrip().startswith("{") else _opencv_entries(text)
    except ValueError as error:
        raise CameraError(f"cannot be parsed: {error}") from error
    return {key.lower().replace("_", ""): value for key, value in entries.items()}


def _opencv_entries(text: str) -> dict[str, Any]:
    import cv2  # here only, since nothing else needs its YAML parser

    if not text.lstrip().startswith(("%YAML", "<?xml")):
        # ROS leaves out the head that OpenCV insists on.
        text = "%YAML:1.0\n" + ("" if text.lstrip().startswith("---") else "---\n") + text

    def value(node):
        if node.isMap():
            return {key: value(node.getNode(key)) for key in node.keys()}  # noqa: SIM118 (not a dict)
        if node.isSeq():
            return [value(node.at(i)) for i in range(node.size())]
        return node.string() if node.isString() else node.real() if node.isReal() or node.isInt() else None

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        entries = value(storage.root())
    except (cv2.error, SystemError) as error:
        raise ValueError(f"OpenCV: {error}") from error
    if not isinstance(entries, dict):
        raise ValueError("neither a JSON object nor OpenCV or ROS calibration YAML or XML")
    return entries


def _numbers(key: str, value: Any, count: int | None = None) -> list[float]:
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        numbers = np.asarray(value, np.float64).ravel().tolist()
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or value is None or (count is not None and len(numbers) != count):
        raise CameraError(f"{key} is {value!r}; expected {count or 'a list of'} number{'s' * (count != 1)}")
    return numbers


def read_timestamps(path: PathLike) -> Float64[np.ndarray, " t"]:
    """Read the first column, seconds, of a file of time stamps (file names and so on may follow).

    Raises `InputError` with the line of the first that is not a finite number or does not increase.
    """
    lines, values = _rows(path, 1, "seconds", InputError, more=True)
    _check(path, lines[1:], np.diff(values[:, 0]) > 0, "time stamps must increase strictly", InputError)
    return values[:, 0]


def read_trajectory(path: PathLike) -> Trajectory:
    """Read a trajectory in the format that its first line of data looks like: TUM, KITTI or EuRoC.

    Raises `TrajectoryError`, with the line where there is one.
    """
    data = (line.split("#")[0].strip() for line in _read_text(path, TrajectoryError).splitlines())
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
    lines, v = _rows(path, 8, _TUM, TrajectoryError)
    return _trajectory(path, lines, v[:, 0], v[:, 1:4], v[:, 4:])


def read_euroc(path: PathLike) -> Trajectory:
    """Read EuRoC's ground truth `timestamp [ns], p xyz, q wxyz, ...`; what follows is left out.

    The poses are those of the sensor that the file describes: in EuRoC's own
    `state_groundtruth_estimate0` that is the body, not a camera. Raises `TrajectoryError`.
    """
    lines, v = _rows(path, 8, _EUROC, TrajectoryError, separator=",", more=True)
    return _trajectory(path, lines, v[:, 0] / 1e9, v[:, 1:4], v[:, [5, 6, 7, 4]])


def read_kitti(path: PathLike, times: Float[np.ndarray, " t"] | None = None) -> Trajectory:
    """Read the first three rows of each camera-to-world pose, row after row in one line.

    The file holds no `times` (seconds); without them they are the frame numbers. Raises `TrajectoryError`.
    """
    lines, v = _rows(path, 12, _KITTI, TrajectoryError)
    Rp = v.reshape(-1, 3, 4)
    rigid = np.abs(np.cross(Rp[:, 0, :3], Rp[:, 1, :3]) - Rp[:, 2, :3]).max(1) < 1e-3
    _check(path, lines, rigid, "the left 3x3 is no rotation", TrajectoryError)
    bottom = np.broadcast_to([0.0, 0, 0, 1], (len(v), 1, 4))
    return Trajectory(np.arange(float(len(v))) if times is None else times, np.concatenate([Rp, bottom], 1))


def write_tum(path: PathLike, trajectory: Trajectory, header: str = _TUM) -> None:
    """Write `timestamp tx ty tz qx qy qz qw`, after `header` as comment lines."""
    q = _quaternions(trajectory.rotations)
    _write_rows(path, header, " ", "%.9f", trajectory.times, np.hstack([trajectory.positions, q]))


def write_euroc(path: PathLike, trajectory: Trajectory, header: str = _EUROC) -> None:
    """Write `timestamp [ns], p xyz, q wxyz`, after `header` as comment lines."""
    q = _quaternions(trajectory.rotations)[:, [3, 0, 1, 2]]
    nanoseconds = np.rint(trajectory.times * 1e9)
    _write_rows(path, header, ",", "%d", nanoseconds, np.hstack([trajectory.positions, q]))


def write_kitti(path: PathLike, trajectory: Trajectory) -> None:
    """Write the first three rows of each camera-to-world pose in one line; the times are lost."""
    Rp = trajectory.T_world_camera[:, :3].reshape(-1, 12)
    _write_rows(path, "", " ", _DIGITS, Rp[:, 0], Rp[:, 1:])


def write_ply(
    path: PathLike,
    points: Shaped[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None = None,
    extra: Mapping[str, Shaped[np.ndarray, " n"]] | None = None,
) -> None:
    """Write a point cloud as binary PLY: positions, colours (RGB) and named scalars, as 32-bit floats."""
    columns = {name: np.asarray(points)[:, i] for i, name in enumerate("xyz")}
    fields = [(name, "<f4", "float") for name in columns]
    if colours is not None:
        names = ("red", "green", "blue")
        columns |= {name: colours[:, i] for i, name in enumerate(names)}
        fields += [(name, "u1", "uchar") for name in names]
    for name, value in (extra or {}).items():
        if not name.isidentifier() or name in columns:
            raise InputError(f"PLY property {name!r}: a name must be one new word (not x, red, ...)")
        columns[name] = np.asarray(value)
        fields.append((name, "<f4", "float"))
    vertices = np.empty(len(points), [(name, kind) for name, kind, _ in fields])
    for name, value in columns.items():
        if value.shape != vertices.shape:
            raise InputError(f"PLY property {name!r} has shape {value.shape}; expected {vertices.shape}")
        vertices[name] = value
    properties = "".join(f"property {kind} {name}\n" for name, _, kind in fields)
    with atomic_write(path, "wb") as file:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
        file.write(head.encode("ascii"))
        file.write(vertices.tobytes())


def write_json(path: PathLike, obj: Any) -> None:
    """Write dictionaries, lists, dataclasses, arrays and numbers as JSON; what is not finite becomes null."""

    def plain(x):
        if hasattr(x, "tolist"):  # NumPy's and JAX's arrays and scalars
            return plain(x.tolist())
        if dataclasses.is_dataclass(x) and not isinstance(x, type):
            return {field.name: plain(getattr(x, field.name)) for field in dataclasses.fields(x)}
        if isinstance(x, Mapping):
            return {str(key): plain(value) for key, value in x.items()}
        if isinstance(x, list | tuple):
            return [plain(value) for value in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    with atomic_write(path) as file:
        json.dump(plain(obj), file, indent=1, allow_nan=False)
        file.write("\n")


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Give a temporary name beside `path`, with its suffix, that becomes `path` when the block succeeds.

    After an exception `path` is what it was and the temporary file is gone. Makes the folder if needed.
    Raises `InputError` if the block wrote nothing.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not `tempfile`: its files are readable by their owner alone, and would stay so.
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise InputError(f"{path}: nothing was written; does the writer know {path.suffix!r} files?")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_write(path: PathLike, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file that appears under `path` as a whole when the block succeeds, or not at all."""
    encoding, newline = (None, None) if mode == "wb" else ("utf-8", "\n")
    with atomic_path(path) as temporary, open(temporary, mode, encoding=encoding, newline=newline) as file:
        yield file


_DIGITS = "%.15g"  # what a double keeps of any decimal number


def _read_text(path: PathLike, error: type[InputError]) -> str:
    try:
        return Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror}") from cause


def _rows(
    path: PathLike,
    columns: int,
    meaning: str,
    error: type[InputError],
    *,
    separator: str | None = None,
    more: bool = False,
) -> tuple[list[int], Float64[np.ndarray, "t columns"]]:
    """The line numbers of the data, and its first columns."""
    lines, rows = [], []
    for number, line in enumerate(_read_text(path, error).splitlines(), 1):
        fields = line.split("#")[0].strip().split(separator)
        if fields in ([], [""]):
            continue
        try:
            row = [float(field) for field in fields[: columns if more else None]]
        except ValueError:
            row = []
        if len(row) != columns or not all(map(math.isfinite, row)):
            number_word = "number" if columns == 1 else "numbers"
            raise error(f"{path}:{number}: expected {columns} finite {number_word} ({meaning}), got {line[:200]!r}")
        lines.append(number)
        rows.append(row)
    if not rows:
        raise error(f"{path}: holds no data; expected lines of {meaning}")
    return lines, np.asarray(rows, np.float64)


def _check(path: PathLike, lines: list[int], good: np.ndarray, message: str, error: type[InputError]) -> None:
    if not good.all():
        raise error(f"{path}:{lines[int(np.argmin(good))]}: {message}")


def _trajectory(path, lines, times, positions, q) -> Trajectory:
    """From quaternions x y z w, which are normalised."""
    _check(path, lines[1:], np.diff(times) > 0, "timestamps must increase strictly", TrajectoryError)
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    _check(path, lines, np.abs(norm[:, 0] - 1) < 1e-2, "the quaternion is not of length 1", TrajectoryError)
    x, y, z, w = (q / norm).T
    T = np.zeros((len(q), 4, 4))
    T[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1)
    T[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1)
    T[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1)
    T[:, :3, 3] = positions
    T[:, 3, 3] = 1
    return Trajectory(times, T)


def _quaternions(R: Float64[np.ndarray, "t 3 3"]) -> Float64[np.ndarray, "t 4"]:
    """Quaternions x y z w with w >= 0. Bar-Itzhack 2000: no branches on the size of the elements."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.reshape(-1, 9).T
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    q = np.linalg.eigh(np.moveaxis(K, -1, 0))[1][:, :, -1]
    return np.where(q[:, 3:] < 0, -q, q)


def _write_rows(path, header, separator, first_format, first, rest) -> None:
    with atomic_write(path) as file:
        file.writelines(f"# {line}\n" for line in header.splitlines())
        for a, row in zip(first, rest, strict=True):
            file.write(separator.join([first_format % a, *(_DIGITS % value for value in row)]) + "\n")
