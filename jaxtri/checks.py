"""What comes in at the public doors, brought into form and held against what is asked for.

`checked` does it for functions of JAX arrays, by their own annotations: shapes, kinds of numbers, lists and NumPy
arrays. Values are looked at where there are any: under `jit`, `grad` and `vmap` there are none.
"""

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import AbstractArray, ArrayLike

from jaxtri.errors import InputError, UnitsWarning

ArrayOrList = ArrayLike | Sequence[Any]
"""What a door takes for an array on the host: NumPy's, JAX's, or lists."""

P = ParamSpec("P")
R = TypeVar("R")
M = TypeVar("M")

NORMALISED = 10.0  # a normalised coordinate is the tangent of an angle off the axis: this is 84 degrees
NORMALISED_SIGMA = 0.03  # noise of a normalised image point: 20 pixels of a focal length of 700
PIXELS = 3.0  # image points that all lie within so many pixels of the corner are none
SPREAD = 1e-6  # of a covariance's scaled eigenvalues, that may lie below zero by rounding

_UNITS = "models work in normalised image units: pixels over the focal length, by camera.to_normalised"


def number(x: Array | float) -> Array:
    """A leaf of a definite dtype: a weakly typed one would compile once more than a plain one."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.result_type(float))


def numbers(name: str, value: Any, shape: tuple[int | str, ...], dtype: Any = np.float64) -> np.ndarray:
    """A NumPy array of numbers of the given shape, a letter for any length. Raises `InputError` that names it."""
    return _shaped(name, _array(name, value, dtype), shape)


def booleans(name: str, value: Any, shape: tuple[int | str, ...]) -> np.ndarray:
    """A NumPy array of booleans of the given shape, a letter for any length. Raises `InputError` that names it."""
    array = np.asarray(value)
    if array.dtype != bool and array.size:
        raise InputError(f"{name} holds {array.dtype} numbers; give booleans, as {name} > 0")
    return _shaped(name, array.astype(bool), shape)


def _array(name: str, value: Any, dtype: Any) -> np.ndarray:
    try:
        return np.asarray(value, dtype)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no array of numbers: {error}") from None


def _shaped(name: str, array: np.ndarray, shape: tuple[int | str, ...]) -> np.ndarray:
    if array.ndim != len(shape) or any(isinstance(w, int) and w != n for n, w in zip(array.shape, shape, strict=True)):
        wanted = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
        raise InputError(f"{name} has shape {array.shape}; give ({wanted})")
    return array


def positive(name: str, value: Any, units: str = "") -> None:
    """Raise `InputError` unless all of it is finite and above zero, where there are values."""
    found = concrete(value)
    if found is not None and not (np.isfinite(found).all() and (found > 0).all()):
        raise InputError(f"{name} is {found}; it must be a positive, finite number{units}")


def covariance(name: str, value: Array) -> None:
    """Raise `InputError` unless it is finite, symmetric and without negative eigenvalues, where there are values."""
    if (given := concrete(value)) is None:
        return
    P = given.astype(np.float64)
    if not np.isfinite(P).all():
        raise InputError(f"{name} is not finite")
    sd = np.sqrt(np.maximum(np.einsum("...ii->...i", P), 0))
    # In units of the standard deviations; where there is none, nothing else may stand in row or column.
    scaled = P / np.where(sd > 0, sd, 1)[..., :, None] / np.where(sd > 0, sd, 1)[..., None, :]
    if np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(initial=0) > 1e-3:
        raise InputError(f"{name} is not symmetric; give (C + C.T) / 2 if that is by rounding")
    lowest = np.linalg.eigvalsh(scaled).min(initial=0)
    if lowest < -SPREAD * np.sqrt(np.finfo(given.dtype).eps / np.finfo(np.float64).eps):
        raise InputError(f"{name} has a negative eigenvalue ({lowest:.3g} in units of its variances): it is none")


def image_points(name: str, observed: Any, mask: Any = None) -> None:
    """Warn where what should be normalised image points are clearly pixels."""
    values, seen = concrete(observed), concrete(mask)
    if values is not None and (mask is None or seen is not None):
        size = np.abs(values if seen is None else values[seen])
        if size.size and np.nanmedian(size) > NORMALISED:
            warnings.warn(f"{name} has values like {np.nanmedian(size):.3g}: {_UNITS}", UnitsWarning, stacklevel=4)


def pixel_points(name: str, values: np.ndarray) -> None:
    """Warn where what should be pixels is clearly normalised: many points, all within a pixel or two of the corner."""
    finite = values[np.isfinite(values)]
    if len(finite) >= 16 and np.abs(finite).max() < PIXELS:
        message = f"{name} are all within {np.abs(finite).max():.3g} of the corner: give pixels, not normalised points"
        warnings.warn(message, UnitsWarning, stacklevel=4)


def image_noise(name: str, sigma: Any) -> None:
    """Raise where the noise of a normalised image point cannot be one; warn where it is clearly in pixels."""
    positive(name, sigma, " in normalised image units: noise_px / focal length")
    found = concrete(sigma)
    if found is not None and found.max() > NORMALISED_SIGMA:
        message = f"{name} is {found.max():.3g}: {_UNITS}; give noise_px / focal length"
        warnings.warn(message, UnitsWarning, stacklevel=4)


def concrete(value: Any) -> np.ndarray | None:
    """The value as a NumPy array; None where there is none: under `jit`, `grad` and `vmap`, and of None itself."""
    if isinstance(value, Tracer) or not isinstance(value, bool | int | float | np.ndarray | np.generic | jax.Array):
        return None
    return np.asarray(value)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function with its arguments in form, or an `InputError` that names the one that cannot be used.

    Arrays are held against their annotations (`Float[Array, "t n m"]`): lists and NumPy arrays become JAX arrays of
    the belief's dtype, the letters must agree among the arguments, a mask must be boolean. In models and beliefs NumPy
    arrays and Python floats become JAX arrays, covariances must be such, a `sigma` positive; counts are at least 1.
    What a model with the attribute `normalised` measures must not be in pixels.
    """
    signature, hints = inspect.signature(function), inspect.get_annotations(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        bound = signature.bind(*args, **kwargs)
        try:
            _form(bound.arguments, hints)
            _judge(bound.arguments)
        except InputError as error:
            raise InputError(f"{function.__name__}: {error}") from None
        return function(*bound.args, **bound.kwargs)

    return call


def _form(arguments: dict[str, Any], hints: Mapping[str, Any]) -> None:
    dtype = _dtype(arguments)
    sizes: dict[str, tuple[int, str]] = {}
    for name, value in arguments.items():
        kinds = _kinds(hints.get(name))
        if kinds:
            arguments[name] = _conform(name, value, kinds, dtype, sizes)
        else:
            arguments[name] = _leaves(value, dtype)


def _dtype(arguments: Mapping[str, Any]) -> Any:
    """The float type to work in: a belief's, else that of the first array, else JAX's default."""
    inexact = [
        x.dtype
        for value in sorted(arguments.values(), key=lambda v: not hasattr(v, "mean"))
        for x in jax.tree.leaves(value)
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.inexact)
    ]
    return inexact[0] if inexact else jnp.result_type(float)


def _kinds(hint: Any) -> list[type[AbstractArray]]:
    options = get_args(hint) or (hint,)
    return [x for x in options if isinstance(x, type) and issubclass(x, AbstractArray)]


def _leaves(tree: M, dtype: Any) -> M:
    """NumPy arrays and Python floats become JAX arrays, and all floats of one dtype."""

    if isinstance(tree, float):  # by itself: `dt`, say
        return tree

    def leaf(x: Any) -> Any:
        if isinstance(x, float):
            return jnp.asarray(x, dtype)
        if isinstance(x, np.ndarray | np.generic):
            return jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.inexact) else None)
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating) and x.dtype != dtype:
            return x.astype(dtype)
        return x

    return jax.tree.map(leaf, tree)


def _conform(
    name: str, value: Any, kinds: list[type[AbstractArray]], dtype: Any, sizes: dict[str, tuple[int, str]]
) -> Any:
    if value is None or isinstance(value, bool | int | float):
        return value
    boolean = set(kinds[0].dtypes) <= {"bool", "bool_"}
    if not isinstance(value, jax.Array):
        if boolean:
            value = jnp.asarray(np.asarray(value))
        else:
            array = _array(name, value, None)
            whole = np.issubdtype(array.dtype, np.integer) and "int32" in kinds[0].dtypes
            value = jnp.asarray(_array(name, array, np.int64 if whole else np.float64), None if whole else dtype)
    if boolean and value.dtype != bool:
        raise InputError(f"{name} holds {value.dtype} numbers; give booleans, as {name} > 0")
    for kind in kinds:
        dims = kind.dim_str.split()
        if any(d.startswith(("*", "...")) for d in dims):
            return value
        if len(dims) == value.ndim:
            for dim, size in zip(dims, value.shape, strict=True):
                known, by = (int(dim), "") if dim.isdecimal() else sizes.setdefault(dim, (size, name))
                if known != size:
                    because = f" with {dim} = {known} as in {by}" if by else ""
                    raise InputError(f"{name} has shape {value.shape}; it must be ({', '.join(dims)}){because}")
                if size == 0:
                    raise InputError(f"{name} has shape {value.shape}: it holds nothing")
            return value
    wanted = " or ".join(f"({', '.join(k.dim_str.split())})" for k in kinds)
    raise InputError(f"{name} has shape {value.shape}; it must be {wanted}")


def _judge(arguments: Mapping[str, Any]) -> None:
    for name, value in arguments.items():
        if name in ("passes", "block", "k") and isinstance(value, int) and value < 1:
            raise InputError(f"{name} is {value}; give at least 1")
        if name == "dt" and (steps := concrete(value)) is not None and not np.isfinite(steps).all():
            raise InputError("dt is not finite: give the time since the frame before, one for all or one a frame")
        if name in ("covariance", "prior") and isinstance(value, jax.Array):
            covariance(name, value)
        if name == "sigma":
            positive(name, value)
        for field in ("covariance", "own"):
            part = getattr(value, field, None)
            if isinstance(part, jax.Array):
                covariance(f"{name}.{field}", part)
        if isinstance(sigma := getattr(value, "sigma", None), jax.Array):
            if getattr(value, "normalised", False):
                image_noise(f"{name}.sigma", sigma)
            else:
                positive(f"{name}.sigma", sigma)
    if getattr(arguments.get("model"), "normalised", False):
        image_points("observed", arguments.get("observed"), arguments.get("mask"))
