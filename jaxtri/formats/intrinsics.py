"""The intrinsics of one camera from its entries, in all spellings that are known, and nothing half read."""

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtri.errors import CameraError
from jaxtri.formats.entries import Entries, is_group, numbers, plain
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady, DoubleSphere, ExtendedUnified, FieldOfView, Fisheye, Lens


@dataclass(frozen=True)
class Intrinsics:
    """What a file says of a camera, in plain numbers.

    Attributes:
        fx: Focal length along the rows of the image, pixels.
        fy: Focal length along its columns, pixels.
        cx: Column of the principal point, pixels; the centre of the first pixel is 0.
        cy: Row of the principal point, pixels.
        skew: Skew of the axes, pixels.
        lens: Model of the lens, None for a pinhole.
        coefficients: Of the lens, in its own order.
        width: Of the image in pixels, None where it is not said.
        height: Of the image in pixels, None where it is not said.
        readout: Seconds of a shutter that rolls: of the rows, or of the columns and the rows.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    lens: type[Lens] | None = None
    coefficients: tuple[float, ...] = ()
    width: int | None = None
    height: int | None = None
    readout: tuple[float, ...] = ()

    def from_corner(self) -> "Intrinsics":
        """The same of a file that counts from the corner of the first pixel, whose centre is at one half."""
        return replace(self, cx=self.cx - 0.5, cy=self.cy - 0.5)

    def camera(self) -> Camera:
        """Raises `CameraError` for numbers that no camera can have."""
        # A Brown-Conrady lens that does nothing is none; a fisheye of zeros is no pinhole.
        lens = None if self.lens is BrownConrady and not any(self.coefficients) else self.lens
        distortion = None if lens is None else lens.from_coefficients(self.coefficients)
        size = {"width": self.width, "height": self.height}
        centre, lens = (self.cx, self.cy), {"skew": self.skew, "distortion": distortion}
        camera = Camera.from_parameters(self.fx, self.fy, *centre, **lens, **size)  # pyright: ignore[reportArgumentType]
        return camera.rolling(*(0.0, *self.readout)[-2:]) if self.readout else camera


# By the quantity: the names that files and tools have for it.
FX = ("fx", "fl_x", "fu", "focal_x", "focal_length_x")
FY = ("fy", "fl_y", "fv", "focal_y", "focal_length_y")
CX = ("cx", "ppx", "pu", "u0", "principal_point_x")
CY = ("cy", "ppy", "pv", "v0", "principal_point_y")
SKEW = ("skew",)
MATRIX = ("camera_matrix", "K", "mtx", "intrinsics_matrix", "K_matrix", "camera_intrinsics")
INTRINSICS = ("intrinsics",)
COEFFICIENTS = (
    *("distortion", "distortion_coefficients", "distortion_coeffs", "distortion_coefs", "distortion_params"),
    *("distortion_parameters", "dist_coefficients", "dist_coeffs", "dist_coeff", "dist_coefs", "dist_coef"),
    *("dist", "D", "coeffs", "coefficients"),
)
MODEL = ("model", "camera_model", "model_type", "camera_type", "lens_model")
DISTORTION_MODEL = ("distortion_model", "dist_model", "distortion_type")
FISHEYE = ("fisheye_model", "is_fisheye", "fisheye")
WIDTH = ("width", "image_width", "img_width", "w")
HEIGHT = ("height", "image_height", "img_height", "h")
SIZE = ("resolution", "camera_resolution", "image_resolution", "image_size", "img_size")

# The first word of a lens is the one that is written.
WORDS: dict[type[Lens], tuple[str, ...]] = {
    BrownConrady: (
        *("brown_conrady", "plumb_bob", "radtan", "opencv_radtan", "radial-tangential", "rational_polynomial", "brown"),
        *("pinhole_radtan", "pinhole-radtan8", "radtan8", "pinhole_full", "full_opencv", "simple_radial", "radial"),
        *("thin_prism", "modified_brown_conrady", "inverse_brown_conrady"),
    ),
    Fisheye: (
        *("fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kannala_brandt8", "kb4", "kb8"),
        *("equidistant", "equi", "pinhole-equi", "pinhole-equidistant"),
    ),
    FieldOfView: ("fov", "pinhole-fov", "field_of_view", "ftheta", "atan"),
    DoubleSphere: ("double_sphere", "ds", "ds-none"),
    ExtendedUnified: ("eucm", "extended_unified", "ucm", "omni", "eucm-none", "omni-none"),
}
OPEN = ("pinhole", "opencv", "perspective", "simple_pinhole", "rectified", "none", "null", "")  # coefficients decide
KINDS = {plain(word): kind for kind, words in WORDS.items() for word in words} | dict.fromkeys(map(plain, OPEN))

_SIZES = {plain(name) for name in (*WIDTH, *HEIGHT, *SIZE)}
_KNOWN = {
    plain(name): name
    for names in (
        FX,
        FY,
        CX,
        CY,
        MATRIX,
        INTRINSICS,
        COEFFICIENTS,
        MODEL,
        DISTORTION_MODEL,
        FISHEYE,
        SIZE,
        WIDTH,
        HEIGHT,
    )
    for name in names
    if len(name) >= 5
}
_SHORT = re.compile(
    r"[fc][xy]|fl[xy]|f[uv]|pp[xy]|[uv]0|m[uv]|[kdps]\d\d?|[kdf]|xi|alpha|beta|omega|gamma\d|tau[xy]?|skew|mtx"
)
_LONG = re.compile(r"distort|^dist(co|par|mod|$)|coef|intrinsic|^focal|^principal|fisheye|model$|^camera(mat|angle)")
_ABOUT = re.compile(r"(stddev|std|errors?|deviations?|uncertaint(y|ies)|covariances?|variances?|mm)$")


def looks_intrinsic(name: str) -> bool:
    """Whether a name is that of an intrinsic, of a lens or of its coefficients, or nearly so; not of their errors."""
    word = plain(name)
    if _ABOUT.search(word) or word in _SIZES:
        return False
    return bool(_SHORT.fullmatch(word) or _LONG.search(word) or closest(name))


def closest(name: str) -> str | None:
    """The known name that this one is, or is a misspelling of, if any."""
    word = plain(name)
    swapped = [known for known in _KNOWN if sorted(known) == sorted(word)]
    near = swapped or difflib.get_close_matches(word, _KNOWN, 1, 0.88)
    return _KNOWN[near[0]] if near else None


def check_unused(entries: Entries, more: str = "") -> None:
    """Raise `CameraError` naming the first entry that looks like an intrinsic and was not used."""
    name = next(entries.unused(looks_intrinsic), None)
    if name is None:
        return
    meant = closest(name.rpartition(".")[2])
    advice = (
        f"rename it {meant}" if meant and plain(meant) != plain(name.rpartition(".")[2]) else "write it as camera.json"
    )
    raise CameraError(
        f"{name} is not understood beside the other entries{more}; {advice}, or remove it if it says nothing"
    )


Size = tuple[int | None, int | None]


def read_intrinsics(entries: Entries, *, model: Sequence[str] = (), size: Size | None = None) -> Intrinsics:
    """The camera of these entries. `model` are further names of the model's entry, `size` is one that stands elsewhere.

    Raises `CameraError` naming the entry that is missing, wrong or not understood.
    """
    lens, word = _lens(entries, (*MODEL, *model))
    own: list[float] = []  # coefficients that stand before the focal lengths, as Kalibr has them
    found: dict[str, tuple[float, float, float, float, float]] = {}
    for entry in entries.find(*INTRINSICS) if entries.has(*INTRINSICS) else ():
        values = numbers(entry)
        if len(values) == 9:
            found[entry.name] = from_matrix(entry.name, values)
            continue
        before = {DoubleSphere: 2, ExtendedUnified: 1 if word == "omni" else 2}.get(lens, 0) if lens else 0
        if len(values) != before + 4:
            raise CameraError(
                f"{entry.name} is {values}; expected {before + 4} numbers for the model {word or 'pinhole'}"
            )
        own, (fx, fy, cx, cy) = values[:before], values[before:]
        found[entry.name] = (fx, fy, cx, cy, 0.0)
    for entry in entries.find(*MATRIX):
        found[entry.name] = from_matrix(entry.name, numbers(entry, 9))
    if not found or entries.has(*FX):
        values = [entries.number(*names) for names in (FX, FY, CX, CY)]
        for name, value in zip(("fx", "fy", "cx", "cy"), values, strict=True):
            if value is None:
                raise CameraError(f"{name} is missing; add it, in pixels (or camera_matrix, 3x3)" + _strange(entries))
        fx, fy, cx, cy = (value for value in values if value is not None)
        found["fx fy cx cy"] = (fx, fy, cx, cy, entries.number(*SKEW) or 0.0)
    (name, first), *others = found.items()
    for other, values in others:
        if any(abs(a - b) > 1e-6 * max(1, abs(a)) for a, b in zip(first, values, strict=True)):
            raise CameraError(f"{name} and {other} disagree; remove the wrong one")
    fx, fy, cx, cy, skew = first
    coefficients = _coefficients(entries, lens, word, own)
    if word == "omni":
        # Mei's camera of the mirror's xi is the unified one of alpha = xi / (1 + xi), its lengths by 1 + xi shorter.
        (xi,) = coefficients
        fx, fy, coefficients = fx / (1 + xi), fy / (1 + xi), [xi / (1 + xi), 1.0]
    _whole_sensor(entries)
    readout = tuple(entries.numbers("readout") or ())
    if len(readout) > 2:
        raise CameraError(f"readout is {list(readout)}; expected the seconds of the rows, or of columns and rows")
    kind = lens or BrownConrady, tuple(coefficients)
    return Intrinsics(fx, fy, cx, cy, skew, *kind, *(size or read_size(entries)), readout)


def from_matrix(name: str, values: Sequence[float]) -> tuple[float, float, float, float, float]:
    """fx, fy, cx, cy, skew of a 3x3 matrix, row by row. Raises `CameraError` where it is transposed or none."""
    if not any(values):
        raise CameraError(f"{name} is all zeros, as of a camera that was not calibrated; calibrate it")
    fx, skew, cx, below, fy, cy, *last = values
    if any(last[:2]) and not (cx or cy):
        raise CameraError(
            f"{name} has the centre below the diagonal ({last[0]:g}, {last[1]:g}): it is stored column by column; "
            "transpose it"
        )
    if below or any(last[:2]) or last[2] != 1:
        raise CameraError(f"{name} is {list(values)}; expected fx skew cx, 0 fy cy, 0 0 1")
    return fx, fy, cx, cy, skew


def read_size(entries: Entries) -> Size:
    """Width and height, None where they are not said. Raises `CameraError` where they are no sizes."""
    pair = None
    entries = entries.within(*SIZE)
    if entries.has(*SIZE) or not entries.has(*WIDTH):
        pair = entries.numbers(*SIZE, count=2)
    sides = []
    for index, names in enumerate((WIDTH, HEIGHT)):
        value = entries.number(*names)
        if pair is not None and value not in (None, pair[index]):
            raise CameraError(
                f"{names[0]} is {value:g}, but the resolution is {pair[0]:g}x{pair[1]:g}; remove the wrong one"
            )
        value = pair[index] if pair is not None else value
        if value is not None and not (value > 0 and value % 1 == 0):
            raise CameraError(f"{names[0]} is {value}; it must be a positive whole number of pixels")
        sides.append(None if value is None else int(value))
    return sides[0], sides[1]


def kind_of(word: str) -> type[Lens] | None:
    """The lens of a model's name, None where its coefficients decide. Raises `CameraError` for a name not known."""
    if plain(word) not in KINDS:
        known = ", ".join(("pinhole", *(name for words in WORDS.values() for name in words[:2])))
        raise CameraError(f"model {word!r} is unknown; known are {known}")
    return KINDS[plain(word)]


def _lens(entries: Entries, model: Sequence[str]) -> tuple[type[Lens] | None, str]:
    """The lens that the entries name, and its word; where they name none, None."""
    kinds: dict[type[Lens], str] = {}
    none = False
    named = [(entry, True) for entry in entries.find(*model)]
    for entry, of_camera in [*named, *((entry, False) for entry in entries.find(*DISTORTION_MODEL))]:
        # What follows in brackets, or after another mark, is a remark.
        word = re.split(r"[(,;:]", str(entry.value))[0].strip()
        word = re.sub(r"^(rs2_)?distortion[._]", "", word, flags=re.IGNORECASE)
        kind = kind_of(word)
        if kind is not None:
            kinds[kind] = word
        elif plain(word) == "none" and not of_camera:
            none = True
    for entry in entries.find(*FISHEYE):
        if str(entry.value).lower() in ("1", "true", "1.0"):
            kinds[Fisheye] = entry.name
        elif str(entry.value).lower() not in ("0", "false", "0.0"):
            raise CameraError(f"{entry.name} is {entry.value!r}; expected 1 or 0")
    if len(kinds) > 1:
        raise CameraError(f"the models {' and '.join(kinds.values())} at once are not read")
    kind, word = next(iter(kinds.items()), (None, "none" if none else ""))
    return kind, plain(word)


def _coefficients(entries: Entries, lens: type[Lens] | None, word: str, own: list[float]) -> list[float]:
    """Of the lens, in its order: those given already, one list, or one by one under their names."""
    by_name = _named(entries.within(*COEFFICIENTS), lens, word)
    listed = [(e.name, numbers(e)) for e in entries.find(*COEFFICIENTS) if not is_group(e.value)]
    options = [(name, values) for name, values in (("intrinsics", own), ("k1 ...", by_name), *listed) if values]
    values = options[0][1] if options else []
    for name, other in options[1:]:
        if _trimmed(other) != _trimmed(values) and any(other):
            raise CameraError(f"{options[0][0]} and {name} disagree; remove the wrong one")
    what = options[0][0] if options else "distortion"
    kind = lens or BrownConrady
    length = len(kind.names) if kind is not BrownConrady else 14
    values = [*values[:length], *_trimmed(values[length:])]
    if not all(abs(v) < float("inf") for v in values):
        raise CameraError(f"{what} is {values}; its coefficients must be finite")
    if word == "none" and any(values):
        raise CameraError(f"{what} is {values}, but the distortion model is none; remove one of the two")
    if word == "inversebrownconrady" and any(values):
        raise CameraError(
            "inverse_brown_conrady undistorts where the other models distort: only zeros are read; calibrate"
        )
    if word == "modifiedbrownconrady" and any(values[2:4]):
        raise CameraError("modified_brown_conrady with tangential coefficients (p1 p2) is not read; calibrate")
    if kind is BrownConrady:
        if any(values) and len(values) not in (1, 2, 4, 5, 8, 12, 14):
            raise CameraError(f"{what} has {len(values)} coefficients; OpenCV's are 4, 5, 8 or 12: k1 k2 p1 p2 k3 ...")
    elif not values:
        raise CameraError(
            f"the coefficients of a {kind.__name__} are missing: add distortion, {' '.join(kind.names)}"
            + _strange(entries)
        )
    if kind is ExtendedUnified and word == "ucm":
        values = [*values[:1], 1.0]
    # What the model cannot be is said by the lens itself.
    kind.from_coefficients([0.5, 1.0] if word == "omni" else values)
    return values


def _named(entries: Entries, lens: type[Lens] | None, word: str) -> list[float]:
    """Coefficients one by one; none are left out between them."""
    names = (lens or BrownConrady).names
    names = {"omni": ("xi",), "ucm": ("alpha",)}.get(word, names)
    given = {name: value for name in names if (value := entries.number(name)) is not None}
    if lens is Fisheye:
        strange = {n: v for n in BrownConrady.names if n not in names and (v := entries.number(n)) is not None}
        if any(strange.values()):
            raise CameraError(
                f"a fisheye has k1 to k4 and no {' '.join(n for n in strange)}: no tangential coefficients"
            )
    if lens is None and "k4" in given and not ({"p1", "k5"} & set(given)):
        raise CameraError("k1 to k4 alone are a fisheye's: add model, fisheye; or p1 and p2")
    for name in given:
        series = [n for n in names if n[0] == name[0]]
        before = series[: series.index(name)] if name[0] == "k" else series
        if missing := [n for n in before if n not in given]:
            raise CameraError(f"{name} is given, but {missing[0]} is missing; add it, 0 if it is none")
    last = max((names.index(name) for name in given), default=-1)
    values = [given.get(name, 0.0) for name in names[: last + 1]]
    if lens in (None, BrownConrady):
        length = next((n for n in (0, 4, 5, 8, 12) if n >= len(values)), 12)
        values += [0.0] * (length - len(values))
    return values


def _trimmed(values: Sequence[float]) -> list[float]:
    """Without the zeros at the end."""
    last = max((k for k, v in enumerate(values) if v != 0), default=-1)
    return list(values[: last + 1])


def _whole_sensor(entries: Entries) -> None:
    """Raise `CameraError` where a camera_info message is of a part of the sensor, or of binned pixels."""
    binning = [entries.number(name) or 0 for name in ("binning_x", "binning_y")]
    roi = entries.within("roi")
    offset = [roi.number(name) or 0 for name in ("x_offset", "y_offset")] if roi is not entries else []
    if max(binning) > 1 or any(offset):
        raise CameraError(
            "binning or roi is set: the intrinsics are of the whole sensor; calibrate the images as they come"
        )


def _strange(entries: Entries) -> str:
    names = list(entries.unused(looks_intrinsic))
    return f"; {', '.join(names[:5])} is not understood" if names else ""
