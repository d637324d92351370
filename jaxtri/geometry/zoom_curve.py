"""A focal length that changes on the way."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxtri.geometry.camera import Camera


@dataclass(frozen=True)
class ZoomCurve:
    """How many times a camera's focal length it is at which time.

    Between two times it is geometric; before the first and after the last it stays.

    Attributes:
        times_s: (m,) seconds, increasing.
        ratio: (m,) focal length over that of the camera.
        sd: (m,) standard deviation of the ratio to the first one, as a share of it.
    """

    times_s: Float[np.ndarray, " m"]
    ratio: Float[np.ndarray, " m"]
    sd: Float[np.ndarray, " m"]

    def log(self, time_s: Float[np.ndarray, "*t"] | float) -> Float[np.ndarray, "*t"]:
        """Logarithm of the ratio at a time."""
        return np.asarray(np.interp(time_s, self.times_s, np.log(self.ratio)))

    def camera(self, camera: Camera, time_s: float) -> Camera:
        """The camera at a time."""
        ratio = float(np.exp(self.log(time_s)))
        return replace(camera, fx=camera.fx * ratio, fy=camera.fy * ratio)


def camera_at(camera: Camera, zoom: ZoomCurve | None, time_s: float) -> Camera:
    """The camera at a time, which may zoom."""
    return camera if zoom is None else zoom.camera(camera, time_s)
