"""Lens models: normalised points of a pinhole, (x / z, y / z), to those that a real lens makes of them."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.errors import CameraError

# Largest coordinate that a polynomial distorts, 89.4 degrees off the axis: without a limit the sixth powers overflow,
# and inf * 0 is NaN even for coefficients of zero.
_WIDEST = 100
FARTHEST = 1e6  # largest coordinate that the other lenses distort: the square of more overflows in float32
_NEAR = 1e-5  # square up to which three terms of the series of arctan are exact to rounding
_NEAR_TAN = 1e-4  # square up to which four terms of the series of tan are


class BrownConrady(eqx.Module):
    """Radial (rational), tangential and thin prism distortion, `cv2.projectPoints`'s model without tilt.

    Source: Brown 1966, OpenCV's calib3d documentation.

    Attributes:
        coefficients: (8,) or (12,) without unit, in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6 and, if any, s1 s2 s3 s4.
    """

    coefficients: Float[Array, " n"]
    names: ClassVar = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    magnification: ClassVar = 1.0

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "BrownConrady":
        """Pad a shorter list with zeros. Raises `CameraError` for tilt terms (the thirteenth and on)."""
        if any(c != 0 for c in coefficients[12:]):
            raise CameraError(
                f"{len(coefficients)} distortion coefficients: tilt terms (the thirteenth and on) are not supported; "
                "calibrate without CALIB_TILTED_MODEL"
            )
        length = 12 if any(c != 0 for c in coefficients[8:12]) else 8
        return cls(_padded(coefficients[:length], length, dtype))

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 100 (89.4 degrees) count as 100."""
        k1, k2, p1, p2, k3, k4, k5, k6, *prism = self.coefficients
        x, y = jnp.clip(xy, -_WIDEST, _WIDEST)
        r2 = x * x + y * y
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        tiny = math.sqrt(jnp.finfo(xy.dtype).eps)
        pole = jnp.abs(denominator) < tiny
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / jnp.where(pole, tiny, denominator)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        if prism:
            s1, s2, s3, s4 = prism
            u, v = u + r2 * (s1 + r2 * s2), v + r2 * (s3 + r2 * s4)
        return jnp.stack([u, v])


class Fisheye(eqx.Module):
    """Kannala-Brandt distortion, `cv2.fisheye`'s model: a polynomial of the angle to the optical axis.

    Attributes:
        coefficients: (4,) without unit: k1 k2 k3 k4. All zero is the equidistant projection, which is still not a
            pinhole.
    """

    coefficients: Float[Array, "4"]
    names: ClassVar = ("k1", "k2", "k3", "k4")
    magnification: ClassVar = 1.0

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "Fisheye":
        """Pad a shorter list with zeros. Raises `CameraError` for more than four."""
        return cls(_padded(coefficients, 4, dtype))

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 1e6 count as 1e6."""
        k1, k2, k3, k4 = self.coefficients
        xy = jnp.clip(xy, -FARTHEST, FARTHEST)
        r2 = xy @ xy
        ratio = _arctan_ratio(r2)  # theta / r
        theta2 = r2 * ratio * ratio
        return xy * ratio * (1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4))))


class FieldOfView(eqx.Module):
    """The lens of one parameter of Devernay & Faugeras 2001, eq. 13: r_d = arctan(2 r tan(omega / 2)) / omega.

    Attributes:
        coefficients: (1,): omega in radians, the field of view of an ideal fisheye of this shape. Zero is a pinhole.
    """

    coefficients: Float[Array, "1"]
    names: ClassVar = ("omega",)

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "FieldOfView":
        """Of one number. Raises `CameraError` for more, and where it is not in [0, pi)."""
        _inside(coefficients, cls.names, ((0, False, math.pi),))
        return cls(_padded(coefficients, 1, dtype))

    @property
    def magnification(self) -> Float[Array, ""]:
        """What a small distance from the centre is multiplied by: 2 tan(omega / 2) / omega."""
        h2 = self.coefficients[0] ** 2 / 4
        near = h2 < _NEAR_TAN
        h = jnp.sqrt(jnp.where(near, 1, h2))
        return jnp.where(near, 1 + h2 * (1 / 3 + h2 * (2 / 15 + h2 * 17 / 315)), jnp.tan(h) / h)

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 1e6 count as 1e6."""
        xy = jnp.clip(xy, -FARTHEST, FARTHEST)
        # omega * magnification is 2 tan(omega / 2), and goes to zero with omega.
        scale = self.magnification
        return xy * scale * _arctan_ratio((self.coefficients[0] * scale) ** 2 * (xy @ xy))


class DoubleSphere(eqx.Module):
    """Two spheres and a pinhole, of Usenko, Demmel & Cremers 2018, eq. 40 to 43.

    The model's own focal lengths are those of `Camera`; a length at the centre of the image is 1 / (1 + xi) times
    as long as theirs.

    Attributes:
        coefficients: (2,) without unit: xi alpha. Both zero is a pinhole.
    """

    coefficients: Float[Array, "2"]
    names: ClassVar = ("xi", "alpha")

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "DoubleSphere":
        """Of two numbers. Raises `CameraError` for more, and unless xi is in (-1, 1) and alpha in [0, 1]."""
        _inside(coefficients, cls.names, ((-1, True, 1), (0, False, 1 + 1e-9)))
        return cls(_padded(coefficients, 2, dtype))

    @property
    def magnification(self) -> Float[Array, ""]:
        """What a small distance from the centre is multiplied by: 1 / (1 + xi)."""
        return 1 / _above_zero(1 + self.coefficients[0])

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 1e6 count as 1e6."""
        xi, alpha = self.coefficients
        xy = jnp.clip(xy, -FARTHEST, FARTHEST)
        r2 = xy @ xy
        z = 1 + xi * jnp.sqrt(1 + r2)  # seen from the second sphere
        return xy / _above_zero(alpha * _root(r2 + z * z) + (1 - alpha) * z)


class ExtendedUnified(eqx.Module):
    """The extended unified camera of Khomutenko, Garcia & Martinet 2016, eq. 8; with beta 1 the unified one of Mei.

    Attributes:
        coefficients: (2,) without unit: alpha beta. An alpha of zero is a pinhole.
    """

    coefficients: Float[Array, "2"]
    names: ClassVar = ("alpha", "beta")
    magnification: ClassVar = 1.0

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "ExtendedUnified":
        """Of two numbers. Raises `CameraError` for more, and unless alpha is in [0, 1] and beta above zero."""
        _inside(coefficients, cls.names, ((0, False, 1 + 1e-9), (0, True, math.inf)))
        return cls(_padded(coefficients, 2, dtype))

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 1e6 count as 1e6."""
        alpha, beta = self.coefficients
        xy = jnp.clip(xy, -FARTHEST, FARTHEST)
        return xy / _above_zero(1 - alpha + alpha * _root(1 + beta * (xy @ xy)))


Lens = BrownConrady | Fisheye | FieldOfView | DoubleSphere | ExtendedUnified
"""What a camera may have: `distort` of one point, `names` of its coefficients, `magnification` at the centre."""


def turned(lens: Lens) -> Lens:
    """The lens of a picture that was turned clockwise by a quarter, so that (x, y) is now (-y, x)."""
    if not isinstance(lens, BrownConrady):
        return lens  # the same in all directions
    at = [0, 1, 3, 2, 4, 5, 6, 7, 10, 11, 8, 9][: len(lens.coefficients)]
    sign = [1, 1, 1, -1, 1, 1, 1, 1, -1, -1, 1, 1][: len(lens.coefficients)]
    return BrownConrady(lens.coefficients[jnp.array(at)] * jnp.array(sign, lens.coefficients.dtype))


def _padded(values: Sequence[float], length: int, dtype: Any) -> Float[Array, " length"]:
    if len(values) > length:
        raise CameraError(f"{len(values)} distortion coefficients, but the model has {length}")
    padded = [float(v) for v in values] + [0.0] * (length - len(values))
    return jnp.asarray(padded, jnp.result_type(float) if dtype is None else dtype)


def _inside(values: Sequence[float], names: tuple[str, ...], limits: tuple[tuple[float, bool, float], ...]) -> None:
    """Of lower limits, open or not, and open upper ones. What is not finite is left to `Camera`, which names it."""
    if len(values) < len(names):
        raise CameraError(f"{len(values)} distortion coefficients, but the model has {' '.join(names)}")
    for value, name, (low, is_open, high) in zip(values, names, limits, strict=False):
        if math.isfinite(value) and not (low < value < high or (value == low and not is_open)):
            raise CameraError(f"{name} is {value}; it must lie between {low:g} and {high:.6g}")


def _arctan_ratio(r2: Float[Array, ""]) -> Float[Array, ""]:
    """arctan(r) / r by the square of r."""
    near = r2 < _NEAR
    r = jnp.sqrt(jnp.where(near, 1, r2))
    return jnp.where(near, 1 - r2 / 3 + r2 * r2 / 5, jnp.arctan(r) / r)


def _above_zero(x: Float[Array, ""]) -> Float[Array, ""]:
    """A denominator that is safe: behind its pole it stays on the side of the axis."""
    return jnp.maximum(x, math.sqrt(jnp.finfo(x.dtype).eps))


def _root(x: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.maximum(x, jnp.finfo(x.dtype).eps ** 2))
