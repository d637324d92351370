"""Compile once: arrays of a few sizes, and programs kept for later runs."""

import hashlib
import math
import os
import platform
from collections.abc import Callable, Hashable
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import jax
import numpy as np
from jax.core import Tracer


def capacity(count: int) -> int:
    """The least of a few sizes that holds `count`, 64 and its doubles: what is compiled for it serves for less."""
    return 64 << max(0, math.ceil(math.log2(max(count, 1) / 64)))


def keep_programs(folder: Path | None = None) -> None:
    """Keep what is compiled from now on for later processes: JAX's persistent compilation cache.

    In `folder`, by default one of this processor under `XDG_CACHE_HOME` or `~/.cache`. JAX's own settings go first:
    `JAX_COMPILATION_CACHE_DIR` for another folder, `JAX_ENABLE_COMPILATION_CACHE=false` for none.
    """
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(folder or _default()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


class Stable:
    """A function that equals another one of the same code, defaults and surroundings.

    Whoever runs a notebook's cell again makes each of its functions anew; as a key of a compiled program the old and
    the new one are the same, unless something they refer to has changed. Surroundings are the variables that the code
    names: functions of the same module by theirs, jitted or not; arrays, numbers and trees of these by value; modules,
    classes and functions of other modules by identity. What may change unseen, as an object of another kind, makes a
    function equal to itself alone.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._key = _function_key(function, (), getattr(function, "__globals__", None))

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The function's value."""
        return self.function(*args, **kwargs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Stable) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class _Same:
    """An object as a key, by identity; it is kept, so that no other takes its place."""

    def __init__(self, thing: object) -> None:
        self.thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.thing is other.thing

    def __hash__(self) -> int:
        return id(self.thing)


def _function_key(function: Any, outer: tuple[Any, ...], home: dict[str, Any] | None) -> Hashable:
    if isinstance(function, jax.stages.Wrapped):  # by `jax.jit`, whose options do not change a value
        function = getattr(function, "__wrapped__", function)
    # What another module holds is not walked through: a library has no end, and is not made anew with a cell.
    if not isinstance(function, FunctionType) or function in outer or function.__globals__ is not home:
        return _Same(function)
    inner = (*outer, function)
    named = {n: function.__globals__[n] for n in sorted(_names(function.__code__)) if n in function.__globals__}
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    around = [*named.values(), *cells, function.__defaults__, function.__kwdefaults__]
    return _code_key(function.__code__), tuple(named), tuple(_value_key(x, inner, home) for x in around)


def _names(code: CodeType) -> set[str]:
    return set(code.co_names).union(*(_names(c) for c in code.co_consts if isinstance(c, CodeType)))


def _code_key(code: CodeType) -> Hashable:
    # Without the file and line, which differ from run to run.
    constants = tuple(_code_key(c) if isinstance(c, CodeType) else (type(c), repr(c)) for c in code.co_consts)
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_argcount


def _value_key(value: Any, outer: tuple[Any, ...], home: dict[str, Any] | None) -> Hashable:
    leaves, tree = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        return _leaf_key(value, outer, home)
    return tree, tuple(_leaf_key(leaf, outer, home) for leaf in leaves)


def _leaf_key(leaf: Any, outer: tuple[Any, ...], home: dict[str, Any] | None) -> Hashable:
    if isinstance(leaf, bool | int | float | complex | str | bytes):
        return type(leaf), repr(leaf)
    if isinstance(leaf, np.ndarray | np.generic) or (isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer)):
        value = np.asarray(leaf)
        return type(leaf), value.dtype, value.shape, hashlib.sha256(value.tobytes()).digest()
    if isinstance(leaf, FunctionType | jax.stages.Wrapped):
        return _function_key(leaf, outer, home)
    if isinstance(leaf, ModuleType | type | BuiltinFunctionType):
        return _Same(leaf)
    return _Same(object())


def _default() -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    # A home shared by several machines: what one processor runs another may not.
    return root / "jaxtri" / hashlib.sha256(_processor().encode()).hexdigest()[:12]


def _processor() -> str:
    described = [platform.machine(), platform.processor()]
    information = Path("/proc/cpuinfo")
    if information.is_file():
        lines = information.read_text(errors="replace").splitlines()
        described += [
            next((x for x in lines if x.startswith(kind)), "") for kind in ("model name", "flags", "Features")
        ]
    return "\n".join(described)
