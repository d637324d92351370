"""Calibration files of bare lines: COLMAP's cameras.txt, camera.txt of TUM-mono and DSO, one line, a matrix."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from jaxtri.errors import CameraError
from jaxtri.formats.entries import plain
from jaxtri.formats.intrinsics import Intrinsics, from_matrix
from jaxtri.formats.parsing import Line
from jaxtri.geometry.lenses import BrownConrady, ExtendedUnified, FieldOfView, Fisheye, Lens

# COLMAP's models: the number of focal lengths, the lens, and the number of its coefficients behind the centre.
_COLMAP: dict[str, tuple[int, type[Lens] | None, int]] = {
    "SIMPLE_PINHOLE": (1, None, 0),
    "PINHOLE": (2, None, 0),
    "SIMPLE_RADIAL": (1, BrownConrady, 1),
    "RADIAL": (1, BrownConrady, 2),
    "OPENCV": (2, BrownConrady, 4),
    "FULL_OPENCV": (2, BrownConrady, 8),
    "SIMPLE_RADIAL_FISHEYE": (1, Fisheye, 1),
    "RADIAL_FISHEYE": (1, Fisheye, 2),
    "OPENCV_FISHEYE": (2, Fisheye, 4),
    "FOV": (2, FieldOfView, 1),
    "EUCM": (2, ExtendedUnified, 2),
}

# DSO's models: the lens and the number of coefficients behind fx fy cx cy.
_DSO: dict[str, tuple[type[Lens] | None, int]] = {
    "pinhole": (None, 1),
    "fov": (FieldOfView, 1),
    "atan": (FieldOfView, 1),
    "radtan": (BrownConrady, 4),
    "equidistant": (Fisheye, 4),
    "kannalabrandt": (Fisheye, 4),
}

KNOWN = (
    "neither a JSON object nor YAML, OpenCV's XML, COLMAP's cameras.txt, DSO's camera.txt, "
    "or one line fx fy cx cy [k1 k2 p1 p2 [k3]]"
)


def cameras(lines: list[Line]) -> dict[str, Callable[[], Intrinsics]]:
    """The cameras of a text, by their names. Raises `CameraError` where it is of no known form."""
    if not lines:
        raise CameraError(f"holds nothing; it is {KNOWN}")
    first = lines[0].words
    if all(_is_colmap(line.words) for line in lines):
        return {line.words[0]: partial(_colmap, line) for line in lines}
    if len(lines) > 1 and len(lines[1].words) == 2 and all(word.isdecimal() for word in lines[1].words):
        return {"": lambda: _dso(lines[0], [int(word) for word in lines[1].words])}
    values = [_floats(line) for line in lines]
    if len(lines) == 1 and len(first) >= 4 and values[0]:
        return {"": lambda: _one_line(values[0])}
    if len(lines) in (3, 4) and all(len(row) in (3, 4) for row in values):
        return {"": lambda: Intrinsics(*from_matrix("the matrix", [x for row in values[:3] for x in row[:3]]))}
    raise CameraError(f"is {KNOWN}")


def _floats(line: Line, start: int = 0) -> list[float]:
    try:
        return [float(word) for word in line.words[start:]]
    except ValueError:
        return []


def _is_colmap(words: list[str]) -> bool:
    return len(words) > 4 and words[0].isdecimal() and words[1].replace("_", "").isalpha() and words[1].isupper()


def _colmap(line: Line) -> Intrinsics:
    number, model, w, h, *_ = line.words
    if model not in _COLMAP:
        raise CameraError(f"line {line.number}: COLMAP's model {model} is not read; known are {', '.join(_COLMAP)}")
    focals, lens, coefficients = _COLMAP[model]
    values, count = _floats(line, 4), focals + 2 + coefficients
    if len(values) != count or not (w.isdecimal() and h.isdecimal()):
        raise CameraError(f"line {line.number}: camera {number} has {len(values)} parameters; {model} has {count}")
    fx, fy = values[0], values[focals - 1]
    cx, cy, *k = values[focals:]
    return Intrinsics(fx, fy, cx, cy, 0.0, lens, tuple(k), int(w), int(h)).from_corner()


def _dso(line: Line, size: list[int]) -> Intrinsics:
    """Where the centre is below 1 all are shares of the size, counted from the corner of the first pixel."""
    named = plain(line.words[0]) if not line.words[0][-1:].isdigit() and line.words[0][-1:] != "." else ""
    values = _floats(line, 1 if named else 0)
    model = named or {5: "fov", 8: "radtan"}.get(len(values), "")
    if model not in _DSO or len(values) != 4 + _DSO[model][1]:
        raise CameraError(
            f"line {line.number}: {' '.join(line.words)[:100]!r} is no camera of DSO; known are FOV and Pinhole with 5 "
            "numbers, RadTan, EquiDistant and KannalaBrandt with 8"
        )
    lens, _ = _DSO[model]
    fx, fy, cx, cy, *k = values
    if model == "pinhole" or (lens is FieldOfView and k == [0]):
        if any(k):
            raise CameraError(f"line {line.number}: a Pinhole with a coefficient of {k[0]:g}; write FOV, or 0")
        lens, k = None, []
    found = Intrinsics(fx, fy, cx, cy, 0.0, lens, tuple(k), size[0], size[1])
    if cx < 1 and cy < 1:
        w, h = size
        return replace(found, fx=fx * w, fy=fy * h, cx=cx * w, cy=cy * h).from_corner()
    return found


def _one_line(values: list[float]) -> Intrinsics:
    fx, fy, cx, cy, *k = values
    if len(k) not in (0, 4, 5, 8, 12):
        raise CameraError(f"one line of {len(values)} numbers; expected fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]")
    return Intrinsics(fx, fy, cx, cy, 0.0, BrownConrady if k else None, tuple(k))
