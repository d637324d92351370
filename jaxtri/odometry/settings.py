"""What a run may tune, and what it says of a frame."""

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxtri.checks import concrete, number, positive
from jaxtri.errors import InputError
from jaxtri.filters import ekf
from jaxtri.geometry.camera import Camera
from jaxtri.models.point_noise import PointNoise


class Base(Enum):
    """Which two base frames a track is measured from.

    Attributes:
        TRACKS: All keyframes of a window that see the track, improved together. Overlapping tracks carry the scale, so
            nothing is handed over: on real video this kind has the smallest error by far
            (`benchmarks/real_sequences.py`).
        INHERIT: One pair for all tracks. A new pair is made of two frames already tracked.
        PAPER: One pair for all tracks, as in Yu et al. 2006. A new pair is made of two consecutive frames, and its
            scale is that of the points which both pairs know.
    """

    TRACKS = "tracks"
    INHERIT = "inherit"
    PAPER = "paper"

    @classmethod
    def _missing_(cls, value: object) -> "Base":
        raise InputError(f"base is {value!r}; choose one of {', '.join(repr(b.value) for b in cls)}")


class Status(IntEnum):
    """What a pose is worth.

    Attributes:
        INITIALISING: There is no pose yet: the camera has not shown enough parallax so far.
        TRACKING: The pose is measured.
        COASTING: The pose is predicted, not measured: too few points agreed with it.
        RESTARTED: The first frame of a new start, after the camera was lost. From here on the scale is a guess.
        LOST: There is no pose: the camera coasted for too long, or too few tracks are left.
        UNCERTAIN: The pose is measured, but its numbers do not hold together: `FramePose.doubts` says in words why.
        FOUND: The first frame in which a scene that was lost is found again: the pose is measured, in the world and at
            the scale of before.
    """

    INITIALISING = 0
    TRACKING = 1
    COASTING = 2
    RESTARTED = 3
    LOST = 4
    UNCERTAIN = 5
    FOUND = 6

    @property
    def measured(self) -> bool:
        """Whether the pose comes from what this frame shows."""
        return self in (Status.TRACKING, Status.UNCERTAIN, Status.RESTARTED, Status.FOUND)


CALIBRATED = 0.003  # what a good calibration knows the focal length to, as a share of it


class Settings(eqx.Module):
    """What a tracker run may tune; `Settings.of(camera)` fills it from pixels.

    All fields but `passes` and `refinements` are leaves, scalars of one dtype. Lengths in the image are in normalised
    image units (pixels over the focal length), angles in radians, times in frames. The defaults of `Settings.of` were
    found on the sequences of `benchmarks/real_sequences.py`, and are the same for all of them.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length. 0.4 px by
            default: what fits the feature tracker of `jaxtri.vision` on real video (0.3 to 0.5 px). Lower, for rendered
            footage or better tracks, makes covariances smaller and more points fail the gate.
        correlation: Correlation of a track's noise in a keyframe with that in the keyframe before, from 0 to below 1
            (`jaxtri.refine`). A feature that is followed from frame to frame drifts: 0.9 by default, which fits the
            feature tracker of `jaxtri.vision` on real video. 0 is noise drawn anew in every frame: features that are
            found in each, and matched.
        calibration: Standard deviation of the focal length as a share of it, and of the principal point as a share of
            the focal length: 0.003 by default, 1.5 pixels of 500, which is what a good calibration reaches. The camera
            stays as it is given; the covariances count this. Higher for one that was guessed; 0 for one that is exact.
        acceleration: Standard deviation of the camera's acceleration, in median scene depths per frame^2. Higher trusts
            the prediction less: it survives jerks and smooths less.
        angular_acceleration: Standard deviation of its angular acceleration, radians per frame^2. Higher and lower do
            what they do for `acceleration`.
        keyframe_flow: Median flow since the last keyframe, in normalised image units, from which a new keyframe is
            made. 2.6 % of the image width by default. Higher gives longer base lines and fewer tracks that reach over
            them.
        keyframe_common: How many tracks must be left from the last keyframe; where there are fewer, a new one is made,
            so that overlapping tracks can carry the scale.
        keyframe_usable: Share of the visible tracks that must have a point which may measure; below it a new keyframe
            is made. Higher brings new tracks into use sooner, from shorter base lines.
        usable_parallax: Angle between the first and the last ray of a track, in radians, from which its point may
            measure. 0.3 degrees by default. Lower uses new tracks sooner, whose depths are hardly known.
        fixed_parallax: Angle in radians, three times which is enough between the two frames of a new pair
            (`Base.INHERIT`): more of it gains little, and leaves fewer tracks. 1.5 degrees by default.
        epipolar_gate: Largest Sampson distance of a track's two observations in the base pair of a start, in normalised
            image units. 1.5 px by default, nearly four times the default noise.
        outlier: Squared Mahalanobis distance of a point above which its track is given up. More than twice the gate of
            `robust`, which 5 to 10 % of real tracks fail in a frame: one that fails it narrowly may go on.
        minimum: Fewest points that must agree on a pose. Higher coasts, and loses the camera, where fewer points are in
            view; lower takes poses that chance agreement may have made.
        patience: Frames of coasting in a row after which the camera is lost. Higher bridges longer gaps by prediction
            alone; lower starts anew sooner, with an unknown scale.
        robust: Weights against outliers; see `jaxtri.Robust`. Graduated weights need no RANSAC in any frame.
        point_noise: Noise of each point over `sigma`, from what the feature tracker says of it; None takes `sigma` for
            all. None by default: learned on five sequences it changes the error on the sixth by no more than chance
            (`benchmarks/tuning.py`).
        noise_gain: Share by which a frame moves the noise that is found (`Base.TRACKS`): what the points are taken to
            have is `sigma` or, where they show more, that. 0 keeps `sigma`. 1 believes each frame by itself.
        suspicion: Share by which a frame moves what is thought of a track that it measures (`Base.TRACKS`): one that
            agrees with less than half of the latest frames moves by itself, or is followed wrongly, and is left out
            for a while. At 0.25 three frames in a row are enough. 0 leaves none out.
        passes: Linearisations of an update (static). Eight bring the weights of `robust` from their start to their end.
        refinements: Steps by which the window of keyframes is improved when one is made (static). A keyframe begins
            nearly right, and those before it have been improved already.
    """

    sigma: Float[Array, ""] = eqx.field(converter=number)
    correlation: Float[Array, ""] = eqx.field(converter=number)
    calibration: Float[Array, ""] = eqx.field(converter=number)
    acceleration: Float[Array, ""] = eqx.field(converter=number)
    angular_acceleration: Float[Array, ""] = eqx.field(converter=number)
    keyframe_flow: Float[Array, ""] = eqx.field(converter=number)
    keyframe_common: Float[Array, ""] = eqx.field(converter=number)
    keyframe_usable: Float[Array, ""] = eqx.field(converter=number)
    usable_parallax: Float[Array, ""] = eqx.field(converter=number)
    fixed_parallax: Float[Array, ""] = eqx.field(converter=number)
    epipolar_gate: Float[Array, ""] = eqx.field(converter=number)
    outlier: Float[Array, ""] = eqx.field(converter=number)
    minimum: Float[Array, ""] = eqx.field(converter=number)
    patience: Float[Array, ""] = eqx.field(converter=number)
    robust: ekf.Robust
    point_noise: PointNoise | None = None
    noise_gain: Float[Array, ""] = eqx.field(default=0.2, converter=number)
    suspicion: Float[Array, ""] = eqx.field(default=0.25, converter=number)
    passes: int = eqx.field(static=True, default=8)
    refinements: int = eqx.field(static=True, default=1)

    @classmethod
    def of(
        cls,
        camera: Camera,
        *,
        noise_px: Float[Array, ""] | float = 0.4,
        calibration: Float[Array, ""] | float = CALIBRATED,
        passes: int = 8,
    ) -> "Settings":
        """The defaults, for a camera whose tracks have a noise of `noise_px` pixels in each coordinate.

        Raises `InputError` where `noise_px` is not positive, `calibration` is negative or `passes` is below 1.
        """
        positive("noise_px", noise_px, " of pixels")
        given = concrete(calibration)
        if given is not None and not ((given >= 0) & (given < np.inf)).all():
            raise InputError(f"calibration is {given}; give a share of the focal length, 0 for an exact camera")
        if passes < 1:
            raise InputError(f"passes is {passes}; give at least 1")
        focal = camera.focal
        width = jnp.asarray(camera.width if camera.width else 2 * camera.cx)

        def scalar(x: Float[Array, ""] | float) -> Array:
            # In the camera's dtype: the fields' own converter takes JAX's default one.
            return jnp.asarray(x, focal.dtype)

        return cls(
            sigma=noise_px / focal,
            noise_gain=scalar(0.2),
            suspicion=scalar(0.25),
            correlation=scalar(0.9),
            calibration=scalar(calibration),
            acceleration=scalar(0.2),
            angular_acceleration=scalar(0.2),
            keyframe_flow=0.026 * width / focal,
            keyframe_common=scalar(20),
            keyframe_usable=scalar(0.3),
            usable_parallax=jnp.deg2rad(scalar(0.3)),
            fixed_parallax=jnp.deg2rad(scalar(1.5)),
            epipolar_gate=1.5 / focal,
            outlier=scalar(30.0),
            minimum=scalar(8),
            patience=scalar(15),
            # From 1e4, where `Robust` begins at 1e5: eight passes bring the scale down by a factor of 2.9 each, more
            # gently than the nine from 1e5 (3.5), and a frame costs a pass less. On the six sequences of
            # `benchmarks/real_sequences.py` both give the same: every ATE within half a percent.
            robust=ekf.Robust(scalar(1e4), scalar(16.0), scalar(13.8), passes=passes),
            passes=passes,
        )


@dataclass(frozen=True)
class StartSettings:
    """When a base pair is good enough to start from; see `jaxtri.vision.hypotheses`.

    Attributes:
        flow: Flow between the two frames, as a share of the image width, from which a start is tried: half of the
            tracks that are left must exceed it, or a quarter of all, as far as they were followed, 1.4 times. A start
            on two consecutive frames, as in the paper, has poor depths: in a prototype a single pair had 2.97 times the
            error of `pnp` then, and 1.9 times with 3.5 % of the width.
        parallax_deg: Angle in degrees between the two rays of a point that half of the points must exceed, or a quarter
            1.4 times. Below it a camera that only turns may look like one that moves. Higher waits longer and starts
            from better depths.
        points: Fewest tracks that must agree on the motion. Higher refuses starts that chance agreement may have made.
        common: Share of the first frame's tracks that must be left in the second. Below it a later frame becomes the
            first one.
        restart: Share of a pair's tracks below which a new pair is made (`Base.INHERIT`, `Base.PAPER`). An optimum in a
            prototype: higher makes base lines too short, lower leaves too few tracks to measure with.
        overlap: How many frames back a new pair begins (`Base.PAPER`): 1 takes the frame before, as in the paper.
        lag: Frames that queue up while a start is worked out in a thread; its poses are known so many frames later. A
            start takes about 0.1 seconds, less than 16 frames do: no frame waits. 0 waits for every start.
        eight_point: Start by the 8-point algorithm with RANSAC alone, as in the paper. Off: it fails before a plane.
        poselib: Let the pose that PoseLib finds compete with those of OpenCV. Off: it needs the extra `init`.
    """

    flow: float = 0.035
    parallax_deg: float = 1.0
    points: int = 20
    common: float = 0.15
    restart: float = 0.35
    overlap: int = 1
    lag: int = 16
    eight_point: bool = False
    poselib: bool = False

    @classmethod
    def of(cls, base: Base | str, **changes: Any) -> "StartSettings":
        """The defaults of a kind of base; the paper's starts from the first two frames that move at all."""
        if Base(base) is Base.PAPER:
            changes = {"flow": 0.003, "parallax_deg": 0.1, "eight_point": True} | changes
        return cls(**changes)


class Report(NamedTuple):
    """What a step says of its frame.

    Attributes:
        pose: World to camera, translation in scene units.
        covariance: (6, 6) of the pose's error exp(delta) pose, (linear, angular) in camera axes, scene units and
            radians, the drift included.
        status: A `Status`, as an integer.
        keyframe: Whether the frame was made a keyframe.
        parallax: Median angle in radians between the rays that the points used are known from.
        drop: (n,) tracks that are outliers: their slots may be filled anew.
        diagnostics: What the update found; see `jaxtri.Diagnostics`.
        noise: Standard deviation that the points were taken to have, over `Settings.sigma`.
        moving: (n,) tracks that move by themselves, or are followed wrongly: for a while they are not measured.
    """

    pose: SE3
    covariance: Float[Array, "6 6"]
    status: Int[Array, ""]
    keyframe: Bool[Array, ""]
    parallax: Float[Array, ""]
    drop: Bool[Array, " n"]
    diagnostics: ekf.Diagnostics
    noise: Float[Array, ""]
    moving: Bool[Array, " n"]
