"""A camera: pixels to normalised coordinates and back, through a lens."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtri.checks import concrete, number
from jaxtri.errors import CameraError
from jaxtri.geometry.lenses import Lens, turned
from jaxtri.geometry.undistortion import undistort

SLOWEST = 0.5  # seconds: what takes longer to be read was given in milliseconds


class Camera(eqx.Module):
    """A pinhole camera with an optional lens distortion; every intrinsic may be differentiated.

    u = fx x + skew y + cx, v = fy y + cy, for a normalised (and then distorted) point (x, y). The centre of the
    top-left pixel is (0, 0). Every field but the two of the size is a leaf.

    Attributes:
        fx: Focal length along the rows of the image, pixels.
        fy: Focal length along its columns, pixels.
        cx: Column of the principal point, pixels.
        cy: Row of the principal point, pixels.
        skew: Skew of the axes, pixels; zero for nearly every camera.
        distortion: Distortion of the lens, None for a pinhole.
        width: Width of the image in pixels, None where it is not known (static).
        height: Height of the image in pixels, None where it is not known (static).
        readout: (2,) seconds from the exposure of the first column to that of the last, and from that of the first row
            to that of the last, of a shutter that rolls; None of one that exposes all at once.
    """

    fx: Float[Array, ""] = eqx.field(converter=number)
    fy: Float[Array, ""] = eqx.field(converter=number)
    cx: Float[Array, ""] = eqx.field(converter=number)
    cy: Float[Array, ""] = eqx.field(converter=number)
    skew: Float[Array, ""] = eqx.field(converter=number)
    distortion: Lens | None = None
    width: int | None = eqx.field(static=True, default=None)
    height: int | None = eqx.field(static=True, default=None)
    readout: Float[Array, "2"] | None = None

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
        readout = None if self.readout is None else concrete(self.readout)
        if readout is not None and not (np.isfinite(readout).all() and (np.abs(readout) < SLOWEST).all()):
            raise CameraError(f"readout is {readout}; it is in seconds, of some 0.005 to 0.03")
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
        distortion: Lens | None = None,
        width: int | None = None,
        height: int | None = None,
        readout: float | None = None,
        dtype: Any = None,
    ) -> "Camera":
        """A camera from numbers; `dtype` defaults to JAX's default float. `readout` is that of the rows, in seconds.

        Raises `CameraError` naming the parameter that is not finite, or not positive where it must be.
        """
        dtype = jnp.result_type(float) if dtype is None else dtype
        fx_, fy_, cx_, cy_, skew_ = jnp.asarray([fx, fy, cx, cy, skew], dtype)
        rolls = None if readout is None else jnp.asarray([0.0, readout], dtype)
        return cls(fx_, fy_, cx_, cy_, skew_, distortion, width, height, rolls).astype(dtype)

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

    def scaled(self, width: int, height: int) -> "Camera":
        """The camera of the same picture at another size, resized as a whole.

        Raises `CameraError` where the size of this one is not known, or the picture would be stretched by more than
        what rounding a side to whole pixels does.
        """
        if self.width is None or self.height is None:
            raise CameraError("the size that the camera was calibrated at is not known: set its width and height")
        if not same_aspect((self.width, self.height), (width, height)):
            if same_aspect((self.height, self.width), (width, height)):
                raise CameraError(
                    f"{width}x{height} is {self.width}x{self.height} turned by a quarter: turn the camera first, by "
                    "turned(90) or turned(270)"
                )
            raise CameraError(
                f"{width}x{height} is no {self.width}x{self.height} resized: it is cropped or stretched; calibrate "
                "for it"
            )
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            skew=self.skew * sx,
            width=width,
            height=height,
        )

    def turned(self, degrees: int) -> "Camera":
        """The camera of the same picture turned clockwise, by a multiple of 90 degrees.

        Poses turn with it: what was at a normalised (x, y) is at (-y, x) after a quarter. Raises `CameraError` for
        another angle, where the size of the picture is not known, and of a quarter where there is a skew: no matrix K
        has that of the columns.
        """
        quarters, rest = divmod(degrees, 90)
        if rest:
            raise CameraError(f"a camera cannot be turned by {degrees} degrees: give 90, 180 or 270 (clockwise)")
        skew = concrete(self.skew)
        if quarters % 2 and skew is not None and (skew != 0).any():
            raise CameraError(f"skew is {skew}: a camera with a skew cannot be turned by a quarter; calibrate without")
        camera = self
        for _ in range(quarters % 4):
            if camera.width is None or camera.height is None:
                raise CameraError("the size that the camera was calibrated at is not known: set its width and height")
            camera = dataclasses.replace(
                camera,
                fx=camera.fy,
                fy=camera.fx,
                cx=camera.height - 1 - camera.cy,
                cy=camera.cx,
                distortion=None if camera.distortion is None else turned(camera.distortion),
                width=camera.height,
                height=camera.width,
                readout=None if camera.readout is None else jnp.stack([-camera.readout[1], camera.readout[0]]),
            )
        return camera

    def rolling(self, columns_s: float, rows_s: float) -> "Camera":
        """The camera with a shutter that reads its columns, or its rows, within so many seconds: `readout`."""
        return dataclasses.replace(self, readout=jnp.asarray([columns_s, rows_s], self.fx.dtype))

    def late(self, pixels: Float[Array, "*batch 2"]) -> Float[Array, " *batch"]:
        """Seconds from the exposure of the middle of the picture to that of pixels.

        Raises `CameraError` where the size of the picture is not known; zero without a `readout`.
        """
        if self.readout is None:
            return jnp.zeros_like(pixels[..., 0])
        if self.width is None or self.height is None:
            raise CameraError("a shutter that rolls goes over the picture, whose size is not known: set it")
        share = (pixels + 0.5) / jnp.asarray([self.width, self.height], pixels.dtype) - 0.5
        return share @ self.readout

    @property
    def magnification(self) -> Float[Array, ""] | float:
        """What the lens multiplies a small distance from the optical axis by; 1 for most."""
        return 1.0 if self.distortion is None else self.distortion.magnification

    @property
    def focal(self) -> Float[Array, ""]:
        """Pixels per unit of a normalised point at the optical axis, the mean of both directions."""
        return jnp.sqrt(self.fx * self.fy) * self.magnification

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


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether a picture of one size may be that of the other, resized, its sides rounded to whole (or even) pixels."""
    (w, h), (u, v) = size, other
    return abs(u - w * v / h) <= 1 or abs(v - h * u / w) <= 1
