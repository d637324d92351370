"""The forms of calibration files: what each is known by, and how its cameras are read."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import tan
from typing import NamedTuple

from jaxtri.errors import CameraError
from jaxtri.formats import listed
from jaxtri.formats.entries import Entries, numbers, plain
from jaxtri.formats.intrinsics import (
    FX,
    INTRINSICS,
    MATRIX,
    Intrinsics,
    Size,
    check_unused,
    from_matrix,
    kind_of,
    looks_intrinsic,
    read_intrinsics,
    read_size,
)
from jaxtri.formats.parsing import Line
from jaxtri.geometry.lenses import BrownConrady, Fisheye

Cameras = dict[str, Callable[[], Intrinsics]]
"""The cameras of a file by their names; each is read when it is asked for."""


class Form(NamedTuple):
    """A form of calibration files that have names.

    Attributes:
        known_by: Whether entries are of this form, by what stands in them.
        cameras: The cameras of such entries, for images of a size, if that is known.
    """

    known_by: Callable[[Entries], bool]
    cameras: Callable[[Entries, Size], Cameras]


def cameras(source: Entries | list[Line], size: Size) -> Cameras:
    """The cameras of a file. Raises `CameraError` where it is of no known form."""
    if isinstance(source, list):
        return listed.cameras(source)
    form = _form(source)
    if form is not None:
        return form.cameras(source, size)
    if any(map(looks_intrinsic, source.names)):
        return {"": lambda: read_intrinsics(source)}  # says what is missing
    raise CameraError(
        f"holds no camera that is known: its entries are {', '.join(source.names[:8])}; write fx, fy, cx and cy"
    )


def _plain(entries: Entries, size: Size) -> Cameras:
    return {"": lambda: read_intrinsics(entries)}


def _nested(entries: Entries, size: Size) -> Cameras:
    """A camera a group: each looks after its own entries, and knows those around it."""

    def inner(name: str, group: Entries, form: Form) -> Cameras:
        def read(make: Callable[[], Intrinsics]) -> Callable[[], Intrinsics]:
            def checked() -> Intrinsics:
                found = make()
                check_unused(group, f" of {name}")
                return found

            return checked

        group.leave()
        found = form.cameras(group, size)
        return {".".join(filter(None, (name, more))): read(make) for more, make in found.items()}

    groups = [(name, group, _form(group)) for name, group in entries.groups()]
    return {
        key: make for name, group, form in groups if form is not None for key, make in inner(name, group, form).items()
    }


def _form(entries: Entries) -> Form | None:
    return next((form for form in FORMS if form.known_by(entries)), None)


def _is_nested(entries: Entries) -> bool:
    return any(_form(group) is not None for _, group in entries.groups())


def _is_orb(entries: Entries) -> bool:
    return any(group.has("fx") for name, group in entries.groups() if plain(name) in ("camera", "camera1"))


def _orb(entries: Entries, size: Size) -> Cameras:
    """ORB-SLAM 2 and 3: Camera.fx, or Camera1.fx and for the second camera Camera2.fx."""
    shared = entries.within("Camera")
    names = [name for name, group in entries.groups() if plain(name)[:6] == "camera" and group.has("fx")]

    def read(name: str) -> Intrinsics:
        for other in set(names) - {name}:
            entries.within(other).leave()
        return read_intrinsics(shared.within(name), model=("type",))

    return {name: partial(read, name) for name in names}


def _vins(entries: Entries, size: Size) -> Cameras:
    """CamOdoCal and VINS; a Kannala-Brandt lens counts its coefficients from k2."""

    def read() -> Intrinsics:
        inner = entries.within("distortion_parameters").within("projection_parameters")
        entries.find("fisheye")  # whether a mask is wanted
        models = [str(entry.value) for entry in entries.find("model_type")]
        if not models or kind_of(models[0]) is not Fisheye:
            return read_intrinsics(inner)
        names = ("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5")
        given = {name: inner.number(name) for name in names}
        if missing := [name for name, value in given.items() if value is None]:
            raise CameraError(f"{missing[0]} is missing in projection_parameters of {models[0]}")
        fx, fy, cx, cy, *k = (value for value in given.values() if value is not None)
        return Intrinsics(fx, fy, cx, cy, 0.0, Fisheye, tuple(k), *read_size(entries))

    return {"": read}


def _basalt_groups(entries: Entries) -> list[Entries]:
    groups = entries.within("value0").groups()
    return [group for name, group in groups if name.startswith("intrinsics.") and group.has("camera_type")]


def _basalt(entries: Entries, size: Size) -> Cameras:
    """Basalt: an entry a camera in intrinsics, its size in resolution."""
    groups = _basalt_groups(entries)

    def read(index: int) -> Intrinsics:
        for k in set(range(len(groups))) - {index}:
            groups[k].leave()
        sizes = [int(x) for x in entries.within("value0").numbers("resolution") or []]
        own = (sizes[2 * index], sizes[2 * index + 1]) if len(sizes) == 2 * len(groups) else (None, None)
        return read_intrinsics(groups[index].within("intrinsics"), size=own)

    return {f"cam{index}": partial(read, index) for index in range(len(groups))}


def _transforms(entries: Entries, size: Size) -> Cameras:
    """nerfstudio's and instant-ngp's transforms.json, which count from the corner of the first pixel."""

    def read() -> Intrinsics:
        angles = [entries.number(name) for name in ("camera_angle_x", "camera_angle_y")]
        if entries.has(*FX):
            found = read_intrinsics(entries)
            if found.lens is BrownConrady and any(found.coefficients[5:]):
                raise CameraError("k4 of a perspective camera is here the power of r8, which no lens has; calibrate")
            return found.from_corner()
        said = read_size(entries)
        w, h = said if None not in said else size
        if w is None or h is None or angles[0] is None:
            raise CameraError("camera_angle_x needs the size of the images; add w and h")
        f = 0.5 * w / tan(0.5 * angles[0])
        fy = f if angles[1] is None else 0.5 * h / tan(0.5 * angles[1])
        return Intrinsics(f, fy, 0.5 * w, 0.5 * h, width=w, height=h).from_corner()

    return {"": read}


def _open3d(entries: Entries, size: Size) -> Cameras:
    """Open3D, which writes its matrix column by column."""

    def read() -> Intrinsics:
        (entry, *_) = entries.find("intrinsic_matrix")
        m = numbers(entry, 9)
        by_columns = any(m[6:8]) and not (m[2] or m[5])
        values = [m[3 * column + row] for row in range(3) for column in range(3)] if by_columns else m
        fx, fy, cx, cy, skew = from_matrix(entry.name, values)
        return Intrinsics(fx, fy, cx, cy, skew, None, (), *read_size(entries))

    return {"": read}


def _projection(entries: Entries, name: str) -> tuple[float, float, float, float, float]:
    values = entries.numbers(name, count=12) or []
    return from_matrix(name, [values[k] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)])


def _kitti_odometry(entries: Entries, size: Size) -> Cameras:
    """KITTI's calib.txt: rectified cameras, the first of which is taken where all are alike."""
    every = [name for name in entries.names if re.fullmatch(r"P\d", name)]
    read = {name: lambda name=name: Intrinsics(*_projection(entries, name)) for name in every}
    for name in every:
        entries.find(name)
    return read


def _kitti_raw(entries: Entries, size: Size) -> Cameras:
    """KITTI's calib_cam_to_cam.txt: of each camera as it is, K_00, and rectified, P_rect_00; the size tells which."""

    def sized(name: str, found: Intrinsics) -> Intrinsics:
        w, h = entries.numbers(name, count=2) or (None, None)
        return replace(found, width=None if w is None else int(w), height=None if h is None else int(h))

    def rectified(number: str) -> Intrinsics:
        return sized(f"S_rect_{number}", Intrinsics(*_projection(entries, f"P_rect_{number}")))

    def raw(number: str) -> Intrinsics:
        fx, fy, cx, cy, skew = from_matrix(f"K_{number}", entries.numbers(f"K_{number}", count=9) or [])
        k = entries.numbers(f"D_{number}") or []
        return sized(f"S_{number}", Intrinsics(fx, fy, cx, cy, skew, BrownConrady, tuple(k)))

    read: Cameras = {}
    for name in entries.names:
        kind, _, number = name.rpartition("_")
        if kind in ("K", "P_rect"):
            read[name] = partial(raw if kind == "K" else rectified, number)
        if kind in ("K", "D", "S", "P_rect", "S_rect"):
            entries.find(name)
    return read


def _has_list(entries: Entries) -> bool:
    return entries.has(*INTRINSICS) and all(
        name.partition(".")[0].lower() != "intrinsics" for name, _ in entries.groups()
    )


FORMS = (
    Form(lambda e: e.has("projection_parameters"), _vins),
    Form(_is_orb, _orb),
    Form(lambda e: bool(_basalt_groups(e)), _basalt),
    Form(lambda e: e.has("fl_x", "camera_angle_x"), _transforms),
    Form(lambda e: e.has("intrinsic_matrix"), _open3d),
    Form(lambda e: any(re.fullmatch(r"P\d", name) for name in e.names) and not e.has(*FX, *MATRIX), _kitti_odometry),
    Form(lambda e: any(re.fullmatch(r"(K|P_rect)_\d\d", name) for name in e.names), _kitti_raw),
    # camera.json, OpenCV, ROS, EuRoC, RealSense: all that differs is how things are spelt.
    Form(lambda e: e.has(*FX, *MATRIX) or _has_list(e), _plain),
    # Kalibr, and whatever else has a camera a name.
    Form(_is_nested, _nested),
)
"""The first form that knows the entries reads them."""
