"""Named entries of a calibration file, however they are spelt, with a memory of which were used."""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from jaxtri.errors import CameraError

Path = tuple[str | int, ...]


def plain(name: str) -> str:
    """A name without case, underscores, dots and hyphens: imageWidth and image_width are one."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


class Entry(NamedTuple):
    """What stands in the file under one name.

    Attributes:
        name: The name as it is written, with those of the entries around it.
        value: A number, a text, a list or a mapping.
    """

    name: str
    value: Any


class Entries:
    """A mapping, and those around it to look names up in, the nearest first.

    All views of one file share what was used, so that `unused` can tell what nobody has asked for.
    """

    def __init__(self, tree: Mapping[str, Any]) -> None:
        self._scopes: list[tuple[Path, Mapping[str, Any]]] = [((), tree)]
        self._used: set[Path] = set()

    def _inner(self, path: Path, tree: Mapping[str, Any]) -> "Entries":
        inner = Entries(tree)
        inner._scopes, inner._used = [(path, tree), *self._scopes], self._used
        return inner

    def _hits(self, names: tuple[str, ...], scopes: int | None = None) -> Iterator[tuple[Path, Any]]:
        wanted = set(map(plain, names))
        for path, tree in self._scopes[:scopes]:
            hits = [((*path, key), value) for key, value in tree.items() if plain(key) in wanted]
            if hits:
                yield from hits
                return

    @property
    def names(self) -> list[str]:
        """The names of the mapping itself, as they are written."""
        return list(self._scopes[0][1])

    def has(self, *names: str) -> bool:
        """Whether one of the names stands in the mapping itself, not around it, and holds something."""
        return any(value not in (None, "") for _, value in self._hits(names, 1))

    def find(self, *names: str) -> list[Entry]:
        """What stands under any of the names in the nearest mapping that has one; it counts as used."""
        hits = list(self._hits(names))
        self._used |= {path for path, _ in hits}
        return [Entry(spelt(path), value) for path, value in hits if value not in (None, "")]

    def within(self, *names: str) -> "Entries":
        """The mapping that stands under one of the names, or these entries themselves where there is none."""
        for path, value in self._hits(names):
            if is_group(value):
                return self._inner(path, value)
        return self

    def groups(self) -> Iterator[tuple[str, "Entries"]]:
        """The mappings that stand in this one, alone or in lists, and their names."""
        path, tree = self._scopes[0]
        for key, value in tree.items():
            if is_group(value):
                yield str(key), self._inner((*path, key), value)
            elif isinstance(value, list):
                for index, item in enumerate(value):
                    if is_group(item):
                        yield f"{key}.{index}", self._inner((*path, key, index), item)

    def leave(self) -> None:
        """Count the mapping as used: another one was chosen, or it looks after itself."""
        self._used.add(self._scopes[0][0])

    def number(self, *names: str) -> float | None:
        """The number under any of the names. Raises `CameraError` where it is none, or two disagree."""
        found = self.numbers(*names, count=1)
        return None if found is None else found[0]

    def numbers(self, *names: str, count: int | None = None) -> list[float] | None:
        """The numbers under any of the names. Raises `CameraError` where there are not `count`, or two disagree."""
        found = [(entry.name, numbers(entry, count)) for entry in self.find(*names)]
        for name, values in found[1:]:
            if values != found[0][1]:
                raise CameraError(f"{found[0][0]} is {found[0][1]}, but {name} is {values}; remove the wrong one")
        return found[0][1] if found else None

    def unused(self, wanted: Callable[[str], bool]) -> Iterator[str]:
        """Full names of the entries whose own name is wanted and of which nothing was used."""
        path, tree = self._scopes[0]
        yield from self._unused(path, tree, wanted)

    def _unused(self, path: Path, tree: Mapping[str, Any], wanted: Callable[[str], bool]) -> Iterator[str]:
        for key, value in tree.items():
            here = (*path, key)
            if here in self._used or value in (None, "", [], {}):
                continue
            inside = {here: value} if is_group(value) else {}
            if isinstance(value, list):
                inside = {(*here, k): item for k, item in enumerate(value) if is_group(item)}
            if wanted(str(key)) and not any(used[: len(here)] == here for used in self._used):
                yield spelt(here)
                continue
            for where, group in inside.items():
                if where not in self._used:
                    yield from self._unused(where, group, wanted)


def is_group(value: Any) -> bool:
    """Whether it is a mapping of further entries, and no matrix of OpenCV."""
    return isinstance(value, Mapping) and "data" not in value


def spelt(path: Path) -> str:
    """The name of an entry with those around it."""
    return ".".join(map(str, path))


def numbers(entry: Entry, count: int | None = None) -> list[float]:
    """The numbers of a list, of lists in a list, of a matrix of OpenCV or of a text. Raises `CameraError`."""

    def flat(value: Any) -> Iterator[float]:
        if isinstance(value, str):
            yield from map(float, re.sub(r"[\[\](),;]", " ", value).split())
        elif isinstance(value, list | tuple):
            for item in value:
                yield from flat(item)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield float(value)
        else:
            raise ValueError

    value = entry.value.get("data") if isinstance(entry.value, Mapping) else entry.value
    try:
        found = list(flat(value))
    except ValueError:
        found = None
    if found is None or (count is not None and len(found) != count):
        raise CameraError(
            f"{entry.name} is {repr(value)[:200]}; expected {count or 'a list of'} number{'s' * (count != 1)}"
        )
    return found
