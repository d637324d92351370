"""Camera models: pixels to normalised coordinates and back, with OpenCV's lens distortions."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtri.checks import concrete, number
from jaxtri.errors import CameraError

# Newton doubles the radius at most, from 1: enough steps for 89.9 degrees off the axis of a fisheye lens,
# and for a dozen rejected steps near the fold of a strong barrel distortion.
_STEPS = 30
# Largest coordinate that is distorted, 89.4 degrees off the axis: without a limit the sixth powers overflow, and
# inf * 0 is NaN even for coefficients of zero.
_WIDEST = 100
_FARTHEST = 1e6  # largest coordinate that a fisheye lens distorts: the square of more overflows in float32
_NEAR = 1e-5  # squared radius up to which three terms of the series of arctan are exact to rounding


class BrownConrady(eqx.Module):
    """Radial (rational) and tangential distortion, `cv2.projectPoints`'s model without prism and tilt.

    Source: Brown 1966, OpenCV's calib3d documentation.

    Attributes:
        coefficients: (8,) without unit, in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6.
    """

    coefficients: Float[Array, "8"]

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "BrownConrady":
        """Pad a shorter list with zeros. Raises `CameraError` for prism or tilt terms (ninth and on)."""
        if any(c != 0 for c in coefficients[8:]):
            raise CameraError(
                f"{len(coefficients)} distortion coefficients: thin prism and tilt terms (the ninth and on) "
                "are not supported; calibrate without CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
            )
        return cls(_coefficients(coefficients[:8], 8, dtype))

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 100 (89.4 degrees) count as 100."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.coefficients
        x, y = jnp.clip(xy, -_WIDEST, _WIDEST)
        r2 = x * x + y * y
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        tiny = math.sqrt(jnp.finfo(xy.dtype).eps)
        pole = jnp.abs(denominator) < tiny
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / jnp.where(pole, tiny, denominator)
        return jnp.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )


class Fisheye(eqx.Module):
    """Kannala-Brandt distortion, `cv2.fisheye`'s model: a polynomial of the angle to the optical axis.

    Attributes:
        coefficients: (4,) without unit: k1 k2 k3 k4. All zero is the equidistant projection, which is still not a
            pinhole.
    """

    coefficients: Float[Array, "4"]

    @classmethod
    def from_coefficients(cls, coefficients: Sequence[float], dtype: Any = None) -> "Fisheye":
        """Pad a shorter list with zeros. Raises `CameraError` for more than four."""
        return cls(_coefficients(coefficients, 4, dtype))

    def distort(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Distort one normalised point. Coordinates beyond 1e6 count as 1e6."""
        k1, k2, k3, k4 = self.coefficients
        xy = jnp.clip(xy, -_FARTHEST, _FARTHEST)
        r2 = xy @ xy
        near = r2 < _NEAR
        r = jnp.sqrt(jnp.where(near, 1, r2))
        ratio = jnp.where(near, 1 - r2 / 3 + r2 * r2 / 5, jnp.arctan(r) / r)  # theta / r
        theta2 = r2 * ratio * ratio
        return xy * ratio * (1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4))))


@jax.jit  # for eager callers: the loop is compiled once, not at every call
def undistort(distortion: BrownConrady | Fisheye, xy: Float[Array, "2"]) -> Float[Array, "2"]:
    """Invert `distortion.distort` at one distorted normalised point.

    Derivatives with respect to the point and the coefficients are those of the implicit function theorem,
    to first order. A point that no ray reaches (beyond the fold of a barrel distortion, or 90 degrees and
    more off the axis) gives the nearest reachable one that was found, with derivatives of zero. To find out,
    distort the result again.
    """
    # The loop is not differentiated: one Newton step from its result has the derivatives, whatever path
    # led there, and reverse mode keeps nothing of the path.
    frozen = jax.tree.map(jax.lax.stop_gradient, distortion)
    target = jnp.clip(jax.lax.stop_gradient(xy), -_FARTHEST, _FARTHEST)
    identity = jnp.eye(2, dtype=xy.dtype)

    def residual(z):
        r = frozen.distort(z) - target
        return r, r

    # Levenberg-Marquardt from the centre, not from the distorted point: the first root on the way out is
    # the physical one, and a start beyond the fold finds mirrored ones.
    def step(_, carry):
        z, r, J, damping = carry
        delta = -_solve2(J.T @ J + damping * identity, J.T @ r)
        size2, reach2 = delta @ delta, 1 + z @ z
        delta = delta * jnp.sqrt(jnp.minimum(1, reach2 / jnp.where(size2 > 0, size2, 1)))
        J_new, r_new = jax.jacfwd(residual, has_aux=True)(z + delta)
        better = r_new @ r_new < r @ r  # False for NaN
        kept = [jnp.where(better, a, b) for a, b in ((z + delta, z), (r_new, r), (J_new, J))]
        return *kept, jnp.where(better, damping / 10, jnp.minimum(damping * 10, 1e6))

    # At the centre every model is the identity to first order.
    start = (jnp.zeros_like(target), -target, identity, jnp.asarray(1e-4, xy.dtype))
    z, r, J, _ = jax.lax.fori_loop(0, _STEPS, step, start)
    eps = float(jnp.finfo(xy.dtype).eps)
    solved = (r @ r < eps * (1 + target @ target)) & (jnp.abs(_det2(J)) > eps)
    # An unsolved point is replaced before the step, so that neither its value nor its gradient is NaN.
    J = jnp.where(solved, J, identity)
    correction = _solve2(J, distortion.distort(jnp.where(solved, z, 0)) - jnp.where(solved, xy, 0))
    return jnp.where(solved, z - correction, z)


class Camera(eqx.Module):
    """A pinhole camera with an optional lens distortion; every intrinsic may be differentiated.

    u = fx x + skew y + cx, v = fy y + cy, for a normalised (and then distorted) point (x, y). The centre of the
    top-left pixel is (0, 0). Every field but the last two is a leaf.

    Attributes:
        fx: Focal length along the rows of the image, pixels.
        fy: Focal length along its columns, pixels.
        cx: Column of the principal point, pixels.
        cy: Row of the principal point, pixels.
        skew: Skew of the axes, pixels; zero for nearly every camera.
        distortion: Distortion of the lens, None for a pinhole.
        width: Width of the image in pixels, None where it is not known (static).
        height: Height of the image in pixels, None where it is not known (static).
    """

    fx: Float[Array, ""] = eqx.field(converter=number)
    fy: Float[Array, ""] = eqx.field(converter=number)
    cx: Float[Array, ""] = eqx.field(converter=number)
    cy: Float[Array, ""] = eqx.field(converter=number)
    skew: Float[Array, ""] = eqx.field(converter=number)
    distortion: BrownConrady | Fisheye | None = None
    width: int | None = eqx.field(static=True, default=None)
    height: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        """Raise `CameraError` naming what is not finite, or not positive where it must be; where there are values."""
        for name in ("fx", "fy", "cx", "cy", "skew"):
            value = concrete(getattr(self, name))
            if value is not None and not np.isfinite(value).all():
                raise CameraError(f"{name} is {value}; it must be a finite number of pixels")
        for name in ("fx", "fy", "width", "height"):
            value = concrete(getattr(self, name))
            if value is not None and not (value > 0).all():
                raise CameraError(f"{name} is {value}; it must be a positive number of pixels")
        coefficients = None if self.distortion is None else concrete(self.distortion.coefficients)
        if coefficients is not None and not np.isfinite(coefficients).all():
            raise CameraError(f"distortion is {coefficients}; its coefficients must be finite")

    @classmethod
    def from_parameters(
        cls,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        *,
        skew: float = 0.0,
        distortion: BrownConrady | Fisheye | None = None,
        width: int | None = None,
        height: int | None = None,
        dtype: Any = None,
    ) -> "Camera":
        """A camera from numbers; `dtype` defaults to JAX's default float.

        Raises `CameraError` naming the parameter that is not finite, or not positive where it must be.
        """
        dtype = jnp.result_type(float) if dtype is None else dtype
        fx_, fy_, cx_, cy_, skew_ = jnp.asarray([fx, fy, cx, cy, skew], dtype)
        return cls(fx_, fy_, cx_, cy_, skew_, distortion, width, height).astype(dtype)

    @classmethod
    def from_fov(cls, fov_deg: float, width: int, height: int, dtype: Any = None) -> "Camera":
        """A camera of square pixels with the given horizontal field of view (degrees), centred.

        The field reaches from the left edge of the first pixel to the right edge of the last.
        """
        if not 0 < fov_deg < 180:
            raise CameraError(f"fov_deg is {fov_deg}; a pinhole's field of view is in (0, 180) degrees")
        f = 0.5 * width / math.tan(math.radians(fov_deg) / 2)
        cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
        return cls.from_parameters(f, f, cx, cy, width=width, height=height, dtype=dtype)

    def astype(self, dtype: Any) -> "Camera":
        """The same camera with all its leaves in another float type."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype), self)

    @property
    def K(self) -> Float[Array, "3 3"]:
        """The intrinsic matrix."""
        zero, one = jnp.zeros_like(self.fx), jnp.ones_like(self.fx)
        rows = [[self.fx, self.skew, self.cx], [zero, self.fy, self.cy], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def to_pixels(self, normalised: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Pixels of normalised points (distorted first, if the camera has a distortion)."""
        if self.distortion is not None:
            normalised = jnp.vectorize(self.distortion.distort, signature="(2)->(2)")(normalised)
        x, y = normalised[..., 0], normalised[..., 1]
        return jnp.stack([self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy], -1)

    def to_normalised(self, pixels: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Normalised, undistorted points of pixels; see `undistort` for those that no ray reaches."""
        y = (pixels[..., 1] - self.cy) / self.fy
        x = (pixels[..., 0] - self.cx - self.skew * y) / self.fx
        xy = jnp.stack([x, y], -1)
        if self.distortion is None:
            return xy
        distortion = self.distortion
        return jnp.vectorize(lambda point: undistort(distortion, point), signature="(2)->(2)")(xy)


def _coefficients(values: Sequence[float], length: int, dtype: Any) -> Float[Array, " length"]:
    if len(values) > length:
        raise CameraError(f"{len(values)} distortion coefficients, but the model has {length}")
    padded = [float(v) for v in values] + [0.0] * (length - len(values))
    return jnp.asarray(padded, jnp.result_type(float) if dtype is None else dtype)


def _det2(A: Float[Array, "2 2"]) -> Float[Array, ""]:
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def _solve2(A: Float[Array, "2 2"], b: Float[Array, "2"]) -> Float[Array, "2"]:
    det = _det2(A)
    adjugate_b = jnp.stack([A[1, 1] * b[0] - A[0, 1] * b[1], A[0, 0] * b[1] - A[1, 0] * b[0]])
    return adjugate_b / jnp.where(det == 0, 1, det)
