"""Differentiable filters that recover a camera's motion from a monocular video.

Conventions, written here once:

- Axes are OpenCV's: x right, y down, z forward. The world is the camera frame of the first base frame.
- A pose maps world to camera, `X_camera = R X_world + T` (Yu et al. 2006, eq. 3), and is named
  `T_camera_world`. Trajectories and their files are camera to world, named `T_world_camera`.
- The filters work in normalised image coordinates (intrinsics and distortion removed). Pixels exist in
  `Camera`, `jaxtri.vision` and at the doors of `jaxtri.odometry`; the centre of the top-left pixel is (0, 0).
- Noise is given in pixels where a camera stands beside it: `Settings.of(camera, noise_px=0.4)`, `--noise-px`. The
  `sigma` of every model and of `Settings` is that of a normalised image point: noise_px / focal length.
- Array axes: frame t, point n, component. Functions take one item; batch them with `jax.vmap`, whole runs with `batch`.
- Angles are in radians, time in frames unless a `dt` is given, lengths in units of the scene.
- The scale of a monocular reconstruction is a gauge, fixed by the length of the first base line.
- Missing is False in a boolean mask; what stands in a masked entry changes nothing, NaN included.
- The dtype follows the inputs; nothing here touches `jax.config`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jaxtri.compilation import capacity, keep_programs
from jaxtri.errors import (
    CameraError,
    InitialisationError,
    InputError,
    InputWarning,
    JaxtriError,
    ResolutionChangeError,
    SourceWarning,
    TrajectoryError,
    TrajectoryWarning,
    TruncatedVideoError,
    TruncatedVideoWarning,
    UnitsWarning,
    VideoError,
)
from jaxtri.estimation import two_view
from jaxtri.estimation.bound import filtering_bound, smoothing_bound
from jaxtri.estimation.two_view import TwoView
from jaxtri.filters import ekf, schmidt
from jaxtri.filters.ekf import Belief, Diagnostics, Robust
from jaxtri.filters.scan import batch
from jaxtri.formats.archive import load, save
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady, DoubleSphere, ExtendedUnified, FieldOfView, Fisheye
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.models.base_frames import BaseFrames, BaseFramesState
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.baselines.structure_and_motion import StructureAndMotion
from jaxtri.models.baselines.two_step import TwoStep
from jaxtri.models.depth import Bank, Depth
from jaxtri.models.motion import Kinematics, Twist
from jaxtri.models.point_noise import PointNoise
from jaxtri.models.rolling_shutter import LatePoint, RollingShutter
from jaxtri.models.trifocal import Trifocal, TrifocalState
from jaxtri.odometry import replay, single_pair, track_pairs
from jaxtri.odometry.replay import Recording
from jaxtri.odometry.settings import Base, Report, Settings, StartSettings, Status
from jaxtri.trajectory import Trajectory, align, ate_rmse, evaluate, nees, relative_errors

if TYPE_CHECKING:
    from jaxtri.estimation import tuning
    from jaxtri.formats import read_camera, read_timestamps, read_trajectory, write_camera, write_tum
    from jaxtri.odometry.calibrate import Calibration, calibrate
    from jaxtri.odometry.driver import Odometry
    from jaxtri.odometry.poses import FramePose
    from jaxtri.odometry.refine import Refinement, refine
    from jaxtri.odometry.rounds import track_uncalibrated
    from jaxtri.odometry.run import Run, follow_tracks, track, warm_up
    from jaxtri.odometry.structure import Points
    from jaxtri.output.plot import plot_trajectory
    from jaxtri.output.results import write_overlay, write_results
    from jaxtri.vision.klt import KLT, KLTSettings
    from jaxtri.vision.places import Returns
    from jaxtri.vision.survey import Survey, survey
    from jaxtri.vision.video import open_source

# Loaded when they are asked for: what they stand on, OpenCV above all, takes time and need not be there.
_LATER = {
    "Calibration": "jaxtri.odometry.calibrate",
    "FramePose": "jaxtri.odometry.poses",
    "KLT": "jaxtri.vision.klt",
    "KLTSettings": "jaxtri.vision.klt",
    "Odometry": "jaxtri.odometry.driver",
    "Points": "jaxtri.odometry.structure",
    "Refinement": "jaxtri.odometry.refine",
    "Returns": "jaxtri.vision.places",
    "Run": "jaxtri.odometry.run",
    "Survey": "jaxtri.vision.survey",
    "calibrate": "jaxtri.odometry.calibrate",
    "follow_tracks": "jaxtri.odometry.run",
    "open_source": "jaxtri.vision.video",
    "plot_trajectory": "jaxtri.output.plot",
    "read_camera": "jaxtri.formats",
    "read_timestamps": "jaxtri.formats",
    "read_trajectory": "jaxtri.formats",
    "refine": "jaxtri.odometry.refine",
    "survey": "jaxtri.vision.survey",
    "track": "jaxtri.odometry.run",
    "track_uncalibrated": "jaxtri.odometry.rounds",
    "tuning": "jaxtri.estimation",
    "warm_up": "jaxtri.odometry.run",
    "write_camera": "jaxtri.formats",
    "write_overlay": "jaxtri.output.results",
    "write_results": "jaxtri.output.results",
    "write_tum": "jaxtri.formats",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = _LATER[name]
    found = import_module(f"{place}.{name}") if name == "tuning" else getattr(import_module(place), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__


__all__ = [
    "KLT",
    "Bank",
    "Base",
    "BaseFrames",
    "BaseFramesState",
    "BasePairs",
    "BasePoint",
    "Belief",
    "BrownConrady",
    "Calibration",
    "Camera",
    "CameraError",
    "Depth",
    "Diagnostics",
    "DoubleSphere",
    "ExtendedUnified",
    "FieldOfView",
    "Fisheye",
    "FramePose",
    "InitialisationError",
    "InputError",
    "InputWarning",
    "JaxtriError",
    "KLTSettings",
    "Kinematics",
    "LatePoint",
    "Odometry",
    "PointNoise",
    "Points",
    "Recording",
    "Refinement",
    "Report",
    "ResolutionChangeError",
    "Returns",
    "Robust",
    "RollingShutter",
    "Run",
    "Settings",
    "SourceWarning",
    "StartSettings",
    "Status",
    "StructureAndMotion",
    "Survey",
    "Trajectory",
    "TrajectoryError",
    "TrajectoryWarning",
    "Trifocal",
    "TrifocalState",
    "TruncatedVideoError",
    "TruncatedVideoWarning",
    "Twist",
    "TwoStep",
    "TwoView",
    "UnitsWarning",
    "VideoError",
    "ZoomCurve",
    "align",
    "ate_rmse",
    "batch",
    "calibrate",
    "capacity",
    "ekf",
    "evaluate",
    "filtering_bound",
    "follow_tracks",
    "keep_programs",
    "load",
    "nees",
    "open_source",
    "plot_trajectory",
    "read_camera",
    "read_timestamps",
    "read_trajectory",
    "refine",
    "relative_errors",
    "replay",
    "save",
    "schmidt",
    "single_pair",
    "smoothing_bound",
    "survey",
    "track",
    "track_pairs",
    "track_uncalibrated",
    "tuning",
    "two_view",
    "warm_up",
    "write_camera",
    "write_overlay",
    "write_results",
    "write_tum",
]
