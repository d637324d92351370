"""Calibration files in and out: a camera of the images' size, whose numbers can be."""

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxtri.errors import CameraError, InputWarning
from jaxtri.formats.calibrations import Cameras, cameras
from jaxtri.formats.entries import Entries
from jaxtri.formats.files import PathLike, read_text, write_json
from jaxtri.formats.intrinsics import WORDS, Intrinsics, Size, check_unused
from jaxtri.formats.parsing import parse
from jaxtri.geometry.camera import Camera, same_aspect
from jaxtri.geometry.lenses import BrownConrady

# Least focal length as a share of the larger side: 157 degrees for a straight line to stay one, and less than any
# fisheye that sees all around it.
_LEAST, _LEAST_WIDE = 0.1, 0.05
_NEAR = 0.1  # share of a side up to which a principal point before its edge is counted from the middle
_UNLIKE = 3  # fx over fy: a field of an anamorphic video has 2.9


def read_camera(
    path: PathLike,
    *,
    width: int | None = None,
    height: int | None = None,
    scale: bool = False,
    turn_deg: int = 0,
) -> Camera:
    """Read a camera from the calibration file of most tools, known by what it holds and not by its name.

    camera.json (fx, fy, cx, cy and, if any, skew, width, height, model, distortion); OpenCV's YAML, XML and JSON;
    ROS's camera_info, as a file or as printed; Kalibr; EuRoC's sensor.yaml; ORB-SLAM 2 and 3; COLMAP's cameras.txt;
    KITTI, odometry and raw; TUM-mono and DSO; one line `fx fy cx cy [k1 k2 p1 p2 [k3]]`; transforms.json of nerfstudio
    and instant-ngp; Basalt; RealSense; Open3D; CamOdoCal and VINS.

    `width` and `height` are those of the images. Where the file has another size, `scale=True` scales the camera to
    images that were resized as a whole; `turn_deg` (90, 180 or 270, clockwise) turns it as they were turned. Of several
    cameras that differ, `FILE#NAME` takes one. Coefficients that are all zero are no distortion, unless the lens is a
    fisheye. Raises `CameraError` naming the file and the entry: for what is missing or cannot be, and for what looks
    like an intrinsic and is not understood.
    """
    file, name = _split(path)
    text = read_text(file, CameraError)
    size = (height, width) if turn_deg % 180 == 90 else (width, height)  # of the images before they were turned
    try:
        source = parse(text)
        found = _chosen(cameras(source, size), name, size)
        if isinstance(source, Entries):
            check_unused(source)
        return _of_size(found, *size, scale, turn_deg).turned(turn_deg)
    except CameraError as error:
        raise CameraError(f"{file}: {error}") from error


def write_camera(path: PathLike, camera: Camera) -> None:
    """Write camera.json, from which `read_camera` makes the same camera."""
    lens = camera.distortion
    entries = {
        "model": "pinhole" if lens is None else WORDS[type(lens)][0],
        **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "skew")},
        "width": camera.width,
        "height": camera.height,
        "distortion": [0.0] * 5 if lens is None else np.asarray(lens.coefficients, np.float64),
        "readout": None if camera.readout is None else np.asarray(camera.readout, np.float64),
    }
    write_json(path, {name: value for name, value in entries.items() if value is not None})


def _split(path: PathLike) -> tuple[PathLike, str]:
    file, _, name = os.fspath(path).rpartition("#")
    return (file, name) if file and not Path(path).exists() else (path, "")


def _chosen(found: Cameras, name: str, size: Size) -> Intrinsics:
    """The camera of that name; without one the only one, or the only one of this size."""
    if name:
        if name not in found:
            raise CameraError(f"has no camera {name}; there are {', '.join(found) or 'none'}")
        return found[name]()
    read = {key: make() for key, make in found.items()}
    fitting = {key: c for key, c in read.items() if (c.width, c.height) == size} or read
    if len(set(fitting.values())) > 1:
        names = list(fitting)
        some = ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
        raise CameraError(f"holds {len(names)} cameras that differ, {some}: choose one, as FILE#{names[0]}")
    return next(iter(fitting.values()))


def _of_size(found: Intrinsics, width: int | None, height: int | None, scale: bool, turn_deg: int) -> Camera:
    """The camera at the size of the images before their turn, after a look at its numbers at its own."""
    of_file = replace(found, width=found.width or width, height=found.height or height)
    camera = of_file.camera()
    if scale and None in (found.width, found.height):
        raise CameraError(
            "the size that it was calibrated at is not said, so it cannot be scaled; add width and height"
        )
    _check(of_file)
    w, h = of_file.width, of_file.height
    u, v = width or w, height or h
    if w is None or h is None or u is None or v is None or (w, h) == (u, v):
        return camera
    seen = f"it was calibrated at {w}x{h}, but the images are {u}x{v}"
    seen += f" before they were turned by {turn_deg} degrees" if turn_deg else ""
    if same_aspect((w, h), (u, v)):
        if scale:
            return camera.scaled(u, v)
        raise CameraError(
            f"{seen}: if they were resized, and not cropped, scale the camera by --scale-camera, or "
            "read_camera(..., scale=True)"
        )
    if same_aspect((w, h), (v, u)):
        if turn_deg % 180 == 90:
            raise CameraError(f"{seen}: its sides are those of the images already; leave out the turn")
        raise CameraError(
            f"{seen}: it is of the picture turned by a quarter, and the file does not say to which side. Turn the "
            "camera by --turn-camera 90 where the top of the picture that was calibrated is at the right of the "
            "images, by 270 where it is at their left (turn_deg of read_camera)"
            + ("" if (w, h) == (v, u) else "; and scale it, by --scale-camera, where they were not cropped")
        )
    raise CameraError(f"{seen}, of another aspect: they are cropped or stretched; calibrate for {u}x{v}")


def _check(c: Intrinsics) -> None:
    """Raise `CameraError` for numbers that no camera of such images has, with the likely cause."""
    w, h = c.width or 0, c.height or 0
    side = max(w, h) or 2 * max(abs(c.cx), abs(c.cy))
    least = _LEAST if c.lens in (None, BrownConrady) else _LEAST_WIDE
    small = min(c.fx, c.fy) < least * side
    if small or max(c.fx, c.fy) < 10:
        seen = f"fx is {c.fx:g} and fy {c.fy:g}" + (f", the image {w}x{h}" if w and h else "")
        if max(abs(c.cx), abs(c.cy)) <= 2:
            raise CameraError(
                f"{seen}: are they normalised by its size? multiply fx and cx by the width, fy and cy by the height"
            )
        raise CameraError(
            f"{seen}: focal lengths are in pixels; of millimetres, multiply by the width of the image in pixels and "
            "divide by that of the sensor in millimetres"
        )
    if not 1 / _UNLIKE < c.fx / c.fy < _UNLIKE:
        raise CameraError(f"fx is {c.fx:g}, but fy {c.fy:g}: no pixels are so oblong; is one mistyped?")
    outside = [(n, x / s) for n, x, s in (("cx", c.cx, w), ("cy", c.cy, h)) if s and not -0.5 <= x <= s - 0.5]
    if outside:
        (name, share), *_ = outside
        centre = f"the principal point ({c.cx:g}, {c.cy:g}) lies outside the image of {w}x{h}"
        seen = f"{name} is {getattr(c, name):g}: {centre}"
        if all(share < -_NEAR for _, share in outside):
            # Neither another size nor another origin puts it there: a part cut out of a larger picture may.
            warnings.warn(f"{seen}, as of a part that was cut out of a larger picture", InputWarning, stacklevel=4)
        elif share < 0:
            raise CameraError(f"{seen}; is it counted from the middle of the image? add half of its size")
        else:
            raise CameraError(f"{seen}; is it a calibration of another size?")
    if w and h and c.cx == 0 == c.cy:
        raise CameraError(
            "cx and cy are 0: the principal point is counted from the corner of the image, not its middle"
        )
