"""The focal length and the lens of a camera from its own video: keyframes, points and intrinsics at once."""

import math
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from jaxtri.errors import InputError
from jaxtri.estimation import calibration
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.odometry.adjustment import FEWEST, Adjustment, stretch
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.intrinsics import GUESSED, UNMODELLED, Found, Search
from jaxtri.odometry.stretches import keyframes, segments

UNDETERMINED = 0.1  # share of the focal length: with a larger standard deviation the motion does not determine it


@dataclass
class Calibration:
    """Intrinsics of a camera, from its own video.

    Attributes:
        camera: The camera: with its focal length, principal point and, where the lens is Brown's or none was known, k1
            and k2. Where it zooms, the focal length is the mean one.
        focal_sd: Standard deviation of the focal length, as a share of it.
        centre_sd: Standard deviations of the principal point, pixels.
        radial_sd: Standard deviations of k1 and k2; empty for another lens.
        keyframes: Number of the frames that it comes from.
        zoom: How the focal length changes on the way; None where it does not.
    """

    camera: Camera
    focal_sd: float
    centre_sd: tuple[float, float]
    radial_sd: tuple[float, ...]
    keyframes: int
    zoom: ZoomCurve | None = None

    @property
    def determined(self) -> bool:
        """Whether the motion determines the focal length: to better than a tenth."""
        return self.focal_sd < UNDETERMINED

    @property
    def field_of_view_deg(self) -> float:
        """From the left edge of the picture to the right one, as a pinhole has it, degrees."""
        width = self.camera.width or 2 * float(self.camera.cx) + 1
        return 2 * math.degrees(math.atan(width / (2 * float(self.camera.fx))))

    def statistics(self) -> dict[str, object]:
        """As `run.json` has them."""
        fx, lens = float(self.camera.fx), self.camera.distortion
        said: dict[str, object] = {
            "focal_length_px": round(fx, 3),
            "focal_length_sd_px": round(fx * self.focal_sd, 3),
            "field_of_view_deg": round(self.field_of_view_deg, 3),
            "principal_point_px": [round(float(c), 3) for c in (self.camera.cx, self.camera.cy)],
            "principal_point_sd_px": [round(s, 3) for s in self.centre_sd],
            "determined": self.determined,
            "keyframes": self.keyframes,
        }
        if self.radial_sd and lens is not None:
            said["k1_k2"] = [round(float(c), 5) for c in lens.coefficients[: len(self.radial_sd)]]
            said["k1_k2_sd"] = [round(s, 5) for s in self.radial_sd]
        if self.zoom is not None:
            focal_px = [round(fx * float(r), 3) for r in self.zoom.ratio]
            said["zoom"] = {"time_s": [float(t) for t in self.zoom.times_s], "focal_length_px": focal_px}
        return said

    def shift(self, other: Camera, zoom: ZoomCurve | None = None) -> float:
        """How far another camera sees what this one sees at the edge of its picture, as a share of the way there.

        By its focal length, where they zoom at the worst time, and its lens: a principal point that moves is, nearly, a
        camera that turns. At the middle of the right edge: for a corner a lens with much distortion has no ray.
        """
        c = self.camera
        edge, centre = jnp.stack([jnp.asarray(c.width or 2 * c.cx, c.fx.dtype), c.cy]), jnp.stack([c.cx, c.cy])
        ray = c.to_normalised(edge)
        # By the ray, and not the edge: where there is none for that either, there is one that is near.
        here, there = c.to_pixels(ray), replace(other, cx=c.cx, cy=c.cy).to_pixels(ray)
        moved = jnp.linalg.norm(there - here) / jnp.linalg.norm(edge - centre)
        return max(float(moved), abs(math.log(float(other.fx / c.fx)))) + _apart(self.zoom, zoom)


def _apart(zoom: ZoomCurve | None, other: ZoomCurve | None) -> float:
    """How far the logarithms of two curves are from one another at most."""
    times = np.concatenate([z.times_s for z in (zoom, other) if z is not None] or [np.zeros(1)])
    a, b = (np.zeros(len(times)) if z is None else z.log(times) for z in (zoom, other))
    return float(np.abs(a - b).max())


def calibrate(
    odometry: Odometry, *, guess: Camera | None = None, prior: float = GUESSED, progress: bool = False
) -> Calibration:
    """Estimate the intrinsics from a run: `Odometry(..., record=True)`, or `run.odometry` of `track(..., record=True)`.

    Of the longest stretch over which the camera was followed. `guess` is what was thought of the camera before anything
    was seen, by default `odometry.camera`, and `prior` the standard deviation of its focal length, as a share of it;
    that of the principal point is 2 % of the width, that of k1 and k2 .2 and .1.

    Standard deviations are the largest of those by the noise that is assumed and by what tracks, times and parts of the
    picture disagree on (White 1980). Those of the focal length and the principal point count 1.5 % of the focal length,
    which no track shows.

    Where the focal length changes on the way it is found at up to 17 keyframes, and geometric between them; its
    logarithm is taken to be a random walk beforehand. `Calibration.zoom` has it where the change is larger than what is
    said of the focal length, at both ends, explains, and so goes `Odometry.zoom` when it is tracked again.

    The poses were followed with the camera as it was. Where it has changed much, track again with the new one, and
    estimate once more: `track_uncalibrated` does. Raises `InputError` where no tracks were kept,
    `InitialisationError` where there is no pose.
    """
    if not odometry.record:
        raise InputError("nothing was recorded: ask for it by record=True")
    odometry.trajectory()  # takes in what is queued, and raises where there is none
    first, end = max(segments(odometry), key=lambda s: s[1] - s[0])
    # With what seemed to move by itself: tracks disagree as much where the focal length is wrong.
    segment, keys, settings, _ = stretch(odometry, np.arange(first, end), moving=True)
    if odometry.zoom is not None:  # it is geometric between keyframes: where it begins and ends it is not
        keys = keyframes(replace(settings, keyframe_flow=settings.keyframe_flow / 2), segment)
    begun = Adjustment.of(settings, segment, keys)
    search = Search(odometry, segment, keys, begun, guess or odometry.camera, prior, progress)
    none = Found(np.zeros_like(search.known), search.known, None)
    found = search.run() if len(keys) >= FEWEST else none
    if not (np.isfinite(found.change).all() and np.isfinite(found.sd).all()):
        found = none
    return _found(calibration.changed(search.camera, jnp.asarray(found.change)), found.sd, len(keys), found.zoom)


def _found(camera: Camera, sd: np.ndarray, keyframes: int, zoom: ZoomCurve | None) -> Calibration:
    focal_sd, cx, cy = (math.hypot(s, UNMODELLED) for s in sd[:3])
    centre_sd = cx * float(camera.fx), cy * float(camera.fy)
    return Calibration(camera, focal_sd, centre_sd, tuple(float(s) for s in sd[3:]), keyframes, zoom)
