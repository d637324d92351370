"""Calibration files: camera.json, OpenCV's YAML, XML and JSON, ROS's camera_info."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtri.errors import CameraError
from jaxtri.formats.files import PathLike, read_text
from jaxtri.geometry.camera import BrownConrady, Camera, Fisheye

NEITHER = "neither a JSON object nor OpenCV or ROS calibration YAML or XML"

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
        return _camera(_entries(read_text(path, CameraError)), width, height)
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
        raise ValueError(NEITHER) from error
    if not isinstance(entries, dict):
        raise ValueError(NEITHER)
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
