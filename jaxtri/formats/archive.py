"""Beliefs, recordings, runs and whole odometries in one file, to go on from or to look into.

The file is a NumPy archive (`.npz`): `numpy.load` reads it anywhere. Each array stands under the path by which it is
reached, as `poses/0/covariance`, with a `~` where that is taken. The entry `tree` holds what is not an array, as JSON
in UTF-8 bytes: `format` (1), `versions`, and `root`, a node. A node is a JSON null, boolean, number or string as it is,
or an object of one key:
`float` ("nan", "inf", "-inf"), `array` (its path; `jax` beside it where JAX held it), `list`, `tuple`, `dict` (pairs
of key and node), `enum` (class and value), or `class` with `fields`, for dataclasses, Equinox modules, JAX
dataclasses and named tuples. A class is written as `module:name`; nothing in the file is ever run as code.
"""

import dataclasses
import importlib
import importlib.metadata
import json
import math
import zipfile
from collections.abc import Sequence
from enum import Enum
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxtri.errors import InputError
from jaxtri.formats.files import PathLike, atomic_write

FORMAT = 1
TREE = "tree"
_PACKAGES = ("jaxtri", "jaxlie")  # whose classes are known by name; others have to be given

T = TypeVar("T", bound="Archived")


class Archived:
    """What can be kept in a file: `save` and `load` as methods."""

    def save(self, path: PathLike) -> None:
        """Write all of it to a file: `jaxtri.save`."""
        save(path, self)

    @classmethod
    def load(cls: type[T], path: PathLike) -> T:
        """Read one back: `jaxtri.load`. Raises `InputError` where the file holds something else."""
        found = load(path)
        if not isinstance(found, cls):
            raise InputError(f"{path} holds a {type(found).__name__}, not a {cls.__name__}: read it by jaxtri.load")
        return found


def save(path: PathLike, thing: Any) -> None:
    """Write a belief, model, recording, run, odometry, or any tree of such, as a whole or not at all.

    Whatever is made of arrays, numbers, strings, lists, tuples, dictionaries, enumerations, dataclasses and named
    tuples can be written; `jaxtri.formats.archive` describes the file. Raises `InputError` that names what cannot.
    """
    arrays: dict[str, np.ndarray] = {}
    root = _node(thing, "", arrays)
    versions = {name: importlib.metadata.version(name) for name in ("jaxtri", "jax")}
    tree = json.dumps({"format": FORMAT, "versions": versions, "root": root}, allow_nan=False)
    arrays[TREE] = np.frombuffer(tree.encode(), np.uint8)
    # Not `numpy.savez`, whose keyword arguments are the names.
    with atomic_write(path, "wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def load(path: PathLike, *, types: Sequence[type] = ()) -> Any:
    """Read what `save` has written. `types` are classes of your own that the file may hold.

    Raises `InputError` where the file is no such archive or another format, a class is not known, or an array of
    double precision meets a JAX without it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        tree = json.loads(arrays.pop(TREE).tobytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as an archive of jaxtri.save: {error}") from error
    if tree.get("format") != FORMAT:
        raise InputError(f"{path} is of format {tree.get('format')}; this version reads {FORMAT}")
    wide = any(a.dtype in (np.float64, np.complex128) for a in arrays.values())
    if wide and not jax.config.read("jax_enable_x64") and '"jax"' in json.dumps(tree["root"]):
        raise InputError(f'{path} holds double precision: set jax.config.update("jax_enable_x64", True) before')
    return _Reader(str(path), arrays, {f"{t.__module__}:{t.__qualname__}": t for t in types}).read(tree["root"])


def _node(x: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """What a thing is in the tree; its arrays are added to `arrays`."""

    def inner(key: object, value: Any) -> Any:
        return _node(value, f"{path}/{key}" if path else str(key), arrays)

    if isinstance(x, Enum):
        return {"enum": _name(type(x)), "value": x.value}
    if x is None or isinstance(x, bool | int | str):
        return x
    if isinstance(x, float):
        return x if math.isfinite(x) else {"float": str(x)}
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        name = path or "value"
        while name in arrays or name == TREE:  # as where a key has a slash in it
            name += "~"
        arrays[name] = np.asarray(x)
        return {"array": name, "jax": True} if isinstance(x, jax.Array) else {"array": name}
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        fields = [f.name for f in dataclasses.fields(x) if f.metadata.get("saved", True)]
        return {"class": _name(type(x)), "fields": {name: inner(name, getattr(x, name)) for name in fields}}
    if isinstance(x, tuple) and hasattr(x, "_asdict"):
        return {"class": _name(type(x)), "fields": {n: inner(n, v) for n, v in x._asdict().items()}}  # pyright: ignore
    if isinstance(x, list | tuple):
        return {type(x).__name__: [inner(k, value) for k, value in enumerate(x)]}
    if isinstance(x, dict):
        return {"dict": [[inner(f"{k}.key", k), inner(k, value)] for k, value in x.items()]}
    raise InputError(f"{path or 'this'} is a {type(x).__name__}, which cannot be saved: give arrays, or a dataclass")


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


@dataclasses.dataclass
class _Reader:
    """Makes things of nodes."""

    path: str
    arrays: dict[str, np.ndarray]
    types: dict[str, type]

    def read(self, node: Any) -> Any:
        """The thing of a node."""
        if not isinstance(node, dict):
            return node
        match node:
            case {"float": text}:
                return float(text)
            case {"array": name, "jax": True}:
                return jnp.asarray(self.arrays[name])
            case {"array": name}:
                return self.arrays[name]
            case {"list": nodes}:
                return [self.read(x) for x in nodes]
            case {"tuple": nodes}:
                return tuple(self.read(x) for x in nodes)
            case {"dict": pairs}:
                return {self.read(key): self.read(value) for key, value in pairs}
            case {"enum": name, "value": value}:
                return self._class(name)(value)
            case {"class": name, "fields": fields}:
                kind = self._class(name)
                if missing := _missing(kind, fields):
                    raise InputError(
                        f"{self.path} was saved by another version of jaxtri: its {kind.__name__} has no "
                        f"{', '.join(missing)}; make it anew"
                    )
                return _made(kind, {key: self.read(value) for key, value in fields.items()})
        raise InputError(f"{self.path}: {str(node)[:80]} is no node of an archive")

    def _class(self, name: str) -> type:
        if name in self.types:
            return self.types[name]
        module, _, qualified = name.partition(":")
        if module.split(".")[0] not in _PACKAGES:
            raise InputError(f"{self.path} holds a {name}: give the class, load(path, types=[{qualified}])")
        try:
            found: Any = importlib.import_module(module)
            for part in qualified.split("."):
                found = getattr(found, part)
        except (ImportError, AttributeError):
            found = None
        if not isinstance(found, type):
            raise InputError(f"{self.path} holds a {name}, which this version of the package does not know")
        return found


def _missing(kind: type, fields: dict[str, Any]) -> list[str]:
    """What an instance needs and the file does not have."""
    if issubclass(kind, tuple):
        needed = [name for name in getattr(kind, "_fields", ()) if name not in getattr(kind, "_field_defaults", ())]
    else:
        needed = [
            f.name
            for f in dataclasses.fields(kind)
            if f.default is dataclasses.MISSING and f.metadata.get("saved", True)
        ]
    return [name for name in needed if name not in fields]


def _made(kind: type, fields: dict[str, Any]) -> Any:
    """An instance with these fields, and the defaults of those that are not saved; nothing of its own is run."""
    if issubclass(kind, tuple):
        return kind(**fields)
    made = object.__new__(kind)
    for field in dataclasses.fields(kind):
        value = fields.get(field.name, field.default)
        object.__setattr__(made, field.name, value)
    return made
