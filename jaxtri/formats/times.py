"""Time stamps: files of them, and the units and forms that they come in."""

import re
from collections.abc import Sequence
from datetime import datetime

import numpy as np
from jaxtyping import Float, Float64

from jaxtri.errors import InputError
from jaxtri.formats.files import PathLike, check_rows, read_text

# Seconds in a unit, and the longest step that is believed in it where the stamps are whole numbers: a camera's
# nanoseconds since it was switched on, read as seconds, would lie years apart.
_UNITS = ((1.0, 4e3), (1e-3, 10.0), (1e-6, 2.0), (1e-9, np.inf))
_LATEST = 1e10  # seconds since 1970, the year 2286: larger numbers are not seconds
UNIT_NAMES = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}

_DATE = r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(?:\.\d*)?Z?"
_LINE = re.compile(rf"({_DATE}|[^\s,;]+)[\s,;]*(.*)")
_SEEN = "a time in seconds, whole nanoseconds, or a date YYYY-MM-DD hh:mm:ss"


def stamp_unit(stamps: Float[np.ndarray, " t"]) -> float:
    """Seconds in one unit of time stamps that do not say it: 1, 1e-3, 1e-6 or 1e-9, by their size and their step."""
    last, step = np.abs(stamps).max(initial=0), np.median(np.diff(stamps)) if len(stamps) > 1 else 0.0
    if last < _LATEST and (stamps != np.rint(stamps)).any():
        return 1.0
    return next((u for u, longest in _UNITS if last * u < _LATEST and step * u < longest), _UNITS[-1][0])


def parse_stamps(words: Sequence[str]) -> Float64[np.ndarray, " t"]:
    """Seconds of time stamps as they are written: numbers of one unit, or dates (UTC). NaN for what is neither."""
    if words and re.fullmatch(_DATE, words[0]):
        return np.array([_date(word) for word in words])
    values = np.array([_number(word) for word in words])
    known = values[np.isfinite(values)]
    # Divided, not multiplied: 1e-9 is no number of the binary system, and 1e9 is.
    return values / round(1 / stamp_unit(known))


def read_stamped(path: PathLike, error: type[InputError]) -> tuple[list[int], Float64[np.ndarray, " t"], list[str]]:
    """Line numbers, seconds, and what follows each stamp (a file name, or nothing) of a file, a line a frame.

    A line of names before the first stamp is passed over. Numbers that count up by one before the stamps (TUM's
    monocular sequences) are no stamps. Raises `error` at the line of the first stamp that is none or does not
    increase.
    """
    lines, words, rest = [], [], []
    for number, line in enumerate(read_text(path, error).splitlines(), 1):
        found = _LINE.match(line.split("#")[0].strip())
        if found:
            lines.append(number)
            words.append(found[1])
            rest.append(found[2].strip())
    if words[1:] and np.isnan(_number(words[0])) and re.match(r"#?[a-z_]", words[0], re.IGNORECASE):
        lines, words, rest = lines[1:], words[1:], rest[1:]
    if not words:
        raise error(f"{path}: holds no data; expected lines of {_SEEN}")
    inner = [_LINE.match(r) for r in rest]
    if all(word.isdecimal() for word in words) and all(m and not np.isnan(_number(m[1])) for m in inner):
        counts = np.array(words, float)
        if (np.diff(counts) == 1).all():
            words, rest = [m[1] for m in inner if m], [""] * len(words)
    times = parse_stamps(words)
    for number, word, time in zip(lines, words, times, strict=True):
        if not np.isfinite(time):
            raise error(f"{path}:{number}: {word!r} is not {_SEEN}")
    check_rows(path, lines[1:], np.diff(times) > 0, "time stamps must increase strictly", error)
    return lines, times, rest


def read_timestamps(path: PathLike) -> Float64[np.ndarray, " t"]:
    """Read the first column of a file of time stamps in seconds (file names and so on may follow).

    Whole milli-, micro- and nanoseconds are told by their size, and dates (KITTI's raw data) count from 1970.
    Raises `InputError` with the line of the first that is none or does not increase.
    """
    return read_stamped(path, InputError)[1]


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        return np.nan
    return value if np.isfinite(value) else np.nan


def _date(word: str) -> float:
    if not re.fullmatch(_DATE, word):
        return np.nan
    whole, _, fraction = word.removesuffix("Z").partition(".")
    try:
        return datetime.fromisoformat(whole + "+00:00").timestamp() + float(f"0.{fraction or 0}")
    except ValueError:  # the 31st of June
        return np.nan
