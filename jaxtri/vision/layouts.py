"""Where a folder has its images and their times: as data sets lay them out, or by the names of the files."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxtri.errors import VideoError
from jaxtri.formats.times import read_stamped, stamp_unit

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""The files of a folder that count as frames; case does not matter."""

# Where images are looked for below a folder that has none: the first kind of which there is any. Ours; EuRoC's cam0 and
# KITTI's raw image_00; TUM's; a whole sequence of EuRoC or KITTI.
_BELOW = ("frames", "data", "rgb", "images", "mav0", "cam[0-9]*", "image_[0-9]*")
_DEEP = 3  # folders down to the images of a whole sequence: mav0/cam0/data

# Lists of times beside the images or one folder above. A list of the last two kinds must name images.
_LISTS = ("timestamps.txt", "times.txt", "data.csv", "{folder}.txt")

_NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
_STEP = 1e-4, 1e4  # seconds between frames: outside, the numbers in their names are no times
_STAMP = 1e11  # whole numbers from here on are stamps, or nothing; below they count frames


@dataclass(frozen=True)
class Layout:
    """The images of a folder in order.

    Attributes:
        home: The folder that holds them.
        files: Paths of the images.
        times: Seconds, as a list says or as the files are named; None where neither does.
        numbers: Numbers of the frames, the first of them 0, a missing one left out; None where the files have none.
    """

    home: Path
    files: list[Path]
    times: list[float] | None
    numbers: list[int] | None


def lay_out(folder: Path) -> Layout:
    """Find the images of a folder and their times.

    Raises VideoError where there are no images, those of several cameras, or a list of times that does not fit them.
    """
    home = _home(folder, _DEEP)
    if home is None:
        looked = ", ".join(word.replace("[0-9]*", "N") for word in _BELOW)
        raise VideoError(f"{folder}: no images here or in {looked} below it ({', '.join(IMAGE_SUFFIXES)})")
    files, values = _in_order(_images(home))
    times, numbers = _named(values)
    for place in (home, home.parent):
        for name in _LISTS:
            path = place / name.format(folder=home.name)
            if path.is_file() and (found := _listed(path, files, must_name=name not in _LISTS[:2])):
                listed, times = found
                return Layout(home, listed, times, numbers if listed == files else None)
    return Layout(home, files, times, numbers)


def _images(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]


def _home(folder: Path, deep: int) -> Path | None:
    """The folder that holds the images, this one or one below."""
    if _images(folder):
        return folder
    for word in _BELOW if deep else ():
        inside = sorted(p for p in folder.glob(word) if p.is_dir())
        homes = [home for p in inside if (home := _home(p, deep - 1))]
        if len(homes) > 1:
            names = ", ".join(str(home.relative_to(folder)) for home in homes)
            raise VideoError(f"{folder} holds the images of {len(homes)} cameras ({names}): give the folder of one")
        if homes:
            return homes[0]
    return None


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]


def _in_order(files: list[Path]) -> tuple[list[Path], list[str] | None]:
    """The files sorted, and the one number in which their names differ; None where they differ otherwise.

    Natural order ("2" before "10"), but for decimal fractions: 0.05 stands before 0.1.
    """
    files = sorted(files, key=_natural)
    split = [_NUMBER.split(path.stem) for path in files]
    if len(files) < 2 or len({tuple(parts[::2]) for parts in split}) > 1:
        return files, None
    varying = [k for k in range(1, len(split[0]), 2) if len({parts[k] for parts in split}) > 1]
    if len(varying) != 1:
        return files, None
    words = {path: parts[varying[0]] for path, parts in zip(files, split, strict=True)}
    if any("." in word for word in words.values()):
        if len({float(word) for word in words.values()}) < len(files):  # 1.1 and 1.10: no fractions
            return files, None
        files.sort(key=lambda path: float(words[path]))
    return files, [words[path] for path in files]


def _named(words: list[str] | None) -> tuple[list[float] | None, list[int] | None]:
    """The times in seconds, or the numbers of the frames, that files are named by."""
    if words is None:
        return None, None
    values = np.array([float(word) for word in words])
    fractions = any("." in word for word in words)
    if not (np.diff(values) > 0).all():
        return None, None
    if fractions or values[-1] >= _STAMP:
        times = values / round(1 / stamp_unit(values))
        likely = _STEP[0] <= np.median(np.diff(times)) <= _STEP[1]
        return (times.tolist() if likely else None), None
    whole = [int(word) - int(words[0]) for word in words]
    # Every tenth frame of a film is a film: it is the gaps in the numbers that count.
    step = math.gcd(*whole)
    return None, [number // step for number in whole]


def _listed(path: Path, images: list[Path], must_name: bool) -> tuple[list[Path], list[float]] | None:
    """Images and times of a list; None if it is none of images where it must be."""
    if must_name and not any(suffix in path.read_text(errors="replace").lower() for suffix in IMAGE_SUFFIXES):
        return None
    lines, times, names = read_stamped(path, VideoError)
    named = all(names) and not all(_NUMBER.fullmatch(name) for name in names)
    if len(lines) != len(images):
        raise VideoError(f"{path} has {len(lines)} lines for {len(images)} images in {images[0].parent}")
    if named:
        # EuRoC names the images within its folder `data`, others from where the list stands.
        folders = [path.parent, images[0].parent]
        found = [next((f for d in folders if (f := d / name).is_file()), None) for name in names]
        if missing := [name for name, file in zip(names, found, strict=True) if file is None]:
            raise VideoError(f"{path} names {missing[0]}, which does not exist ({len(missing)} missing in all)")
        images = [file for file in found if file is not None]
    return images, times.tolist()
