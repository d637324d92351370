"""Files that appear as a whole or not at all, JSON, and tables of numbers whose errors name the line."""

import dataclasses
import json
import math
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from jaxtyping import Float64

from jaxtri.errors import InputError

PathLike = str | os.PathLike[str]


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


def read_text(path: PathLike, error: type[InputError]) -> str:
    """The text of a file, or the given error that names it."""
    try:
        return Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror}") from cause


def read_rows(
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
    for number, line in enumerate(read_text(path, error).splitlines(), 1):
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


def check_rows(path: PathLike, lines: list[int], good: np.ndarray, message: str, error: type[InputError]) -> None:
    """Raise the error at the line of the first row that is not good."""
    if not good.all():
        raise error(f"{path}:{lines[int(np.argmin(good))]}: {message}")
