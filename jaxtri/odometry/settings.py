"""What a run may tune, and what it says of a frame."""

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.errors import InputError
from jaxtri.filters import ekf
from jaxtri.geometry.camera import Camera
from jaxtri.models.point_noise import PointNoise


class Base(Enum):
    """Which two base frames a track is measured from."""

    TRACKS = "tracks"  # a pair per track, drawn from keyframes
    INHERIT = "inherit"  # one pair for all; a restart takes two frames already tracked
    PAPER = "paper"  # one pair for all; a restart takes two consecutive frames and matches the scale

    @classmethod
    def _missing_(cls, value: object) -> "Base":
        raise InputError(f"base is {value!r}; choose one of {', '.join(repr(b.value) for b in cls)}")


class Status(IntEnum):
    """What a pose is worth."""

    INITIALISING = 0  # no pose yet: not enough parallax so far
    TRACKING = 1
    COASTING = 2  # predicted only: too few points agreed
    RESTARTED = 3  # the first frame of a new start; its scale is unknown unless said otherwise
    LOST = 4  # no pose


class Settings(eqx.Module):
    """What a tracker run may tune; lengths in normalised image units, angles in radians, times in frames.

    `Settings.of(camera)` fills them from pixels.
    """

    sigma: Float[Array, ""]  # noise of an image point
    acceleration: Float[Array, ""]  # of the camera, in median scene depths per frame^2
    angular_acceleration: Float[Array, ""]  # per frame^2
    keyframe_flow: Float[Array, ""]  # median flow since the last keyframe that makes a new one
    keyframe_common: Float[Array, ""]  # ... or fewer common tracks than this
    keyframe_usable: Float[Array, ""]  # ... or a smaller share of usable ones than this
    usable_parallax: Float[Array, ""]  # angle from which a base pair may measure
    fixed_parallax: Float[Array, ""]  # angle from which a base pair stays
    epipolar_gate: Float[Array, ""]  # largest Sampson distance of a base pair
    outlier: Float[Array, ""]  # squared Mahalanobis distance above which a track is given up
    minimum: Float[Array, ""]  # fewest agreeing points of a pose
    patience: Float[Array, ""]  # frames of coasting after which the camera is lost
    robust: ekf.Robust
    point_noise: PointNoise | None = None  # of a point over sigma
    passes: int = eqx.field(static=True, default=8)

    @classmethod
    def of(cls, camera: Camera, *, noise_px: Float[Array, ""] | float = 0.4, passes: int = 8) -> "Settings":
        """The defaults, for a camera whose tracks have `noise_px` of noise in each coordinate."""
        focal = jnp.sqrt(camera.fx * camera.fy)
        width = jnp.asarray(camera.width if camera.width else 2 * camera.cx)

        def number(x: float) -> Array:
            return jnp.asarray(x, focal.dtype)

        return cls(
            sigma=noise_px / focal,
            acceleration=number(0.02),
            angular_acceleration=number(0.02),
            keyframe_flow=0.035 * width / focal,
            keyframe_common=number(20),
            keyframe_usable=number(0.3),
            usable_parallax=jnp.deg2rad(number(0.3)),
            fixed_parallax=jnp.deg2rad(number(1.5)),
            epipolar_gate=1.5 / focal,
            outlier=number(30.0),
            minimum=number(8),
            patience=number(15),
            robust=ekf.Robust(number(1e4), number(16.0), number(13.8)),
            passes=passes,
        )


@dataclass(frozen=True)
class StartSettings:
    """When a base pair is good enough; see `jaxtri.vision.hypotheses`."""

    flow: float = 0.035  # median flow between the two frames, as a share of the image width
    parallax_deg: float = 1.0  # median angle between the two rays of a point
    points: int = 20  # fewest tracks that agree on the motion
    common: float = 0.15  # share of the tracks that must survive; below it a later first frame is taken
    restart: float = 0.35  # share of a pair's tracks below which a segment ends (inherit, paper)
    overlap: int = 1  # frames that two segments share (paper)
    lag: int = 16  # frames that come while a start is worked out beside them; its poses are known after as many
    eight_point: bool = False  # the 8-point algorithm with RANSAC, as in the paper
    poselib: bool = False  # hypotheses of PoseLib compete with OpenCV's (extra `init`)

    @classmethod
    def of(cls, base: Base | str, **changes: Any) -> "StartSettings":
        """The defaults of a kind of base; the paper's starts from the first two frames that move at all."""
        if Base(base) is Base.PAPER:
            changes = {"flow": 0.003, "parallax_deg": 0.1, "eight_point": True} | changes
        return cls(**changes)


class Report(NamedTuple):
    """What a step says of its frame."""

    pose: SE3  # world to camera
    covariance: Float[Array, "6 6"]  # of its error exp(delta) T, (linear, angular) in camera axes, drift included
    status: Int[Array, ""]
    keyframe: Bool[Array, ""]
    drop: Bool[Array, " n"]  # tracks that are outliers: their slots may be filled anew
    diagnostics: ekf.Diagnostics
