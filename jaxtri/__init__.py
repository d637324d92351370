"""Differentiable filters that recover a camera's motion from a monocular video.

Conventions, written here once:

- Axes are OpenCV's: x right, y down, z forward. The world is the camera frame of the first base frame.
- A pose maps world to camera, `X_camera = R X_world + T` (Yu et al. 2006, eq. 3), and is named
  `T_camera_world`. Trajectories and their files are camera to world, named `T_world_camera`.
- The filters work in normalised image coordinates (intrinsics and distortion removed). Pixels exist in
  `Camera` and `jaxtri.vision` only; the centre of the top-left pixel is (0, 0). Noise is given in pixels.
- Array axes: frame t, point n, component. Functions take one item; batch them with `jax.vmap`, whole runs with `batch`.
- Angles are in radians, time in frames unless a `dt` is given, lengths in units of the scene.
- The scale of a monocular reconstruction is a gauge, fixed by the length of the first base line.
- Missing is False in a boolean mask; what stands in a masked entry changes nothing, NaN included.
- The dtype follows the inputs; nothing here touches `jax.config`.
"""

from jaxtri import segments as segments
from jaxtri import tracker as tracker
from jaxtri.errors import (
    CameraError,
    InitialisationError,
    InputError,
    JaxtriError,
    ResolutionChangeError,
    TrajectoryError,
    TruncatedVideoError,
    TruncatedVideoWarning,
    VideoError,
)
from jaxtri.estimation.bound import filtering_bound, smoothing_bound
from jaxtri.estimation.two_view import TwoView, refine
from jaxtri.filters import ekf as ekf
from jaxtri.filters import schmidt as schmidt
from jaxtri.filters.ekf import Diagnostics, Robust
from jaxtri.filters.model import Belief
from jaxtri.filters.scan import batch
from jaxtri.geometry.camera import BrownConrady, Camera, Fisheye
from jaxtri.models.base_frames import BaseFrames, BaseFramesState
from jaxtri.models.base_pairs import BasePairs, BasePoint
from jaxtri.models.baselines.structure_and_motion import StructureAndMotion
from jaxtri.models.baselines.two_step import TwoStep
from jaxtri.models.depth import Bank, Depth
from jaxtri.models.motion import Kinematics, Twist
from jaxtri.models.trifocal import Trifocal, TrifocalState
from jaxtri.tracker import Settings, Status
from jaxtri.trajectory import Trajectory, align, ate_rmse, evaluate, nees, relative_errors

__all__ = [
    "Bank",
    "BaseFrames",
    "BaseFramesState",
    "BasePairs",
    "BasePoint",
    "Belief",
    "BrownConrady",
    "Camera",
    "CameraError",
    "Depth",
    "Diagnostics",
    "Fisheye",
    "InitialisationError",
    "InputError",
    "JaxtriError",
    "Kinematics",
    "ResolutionChangeError",
    "Robust",
    "Settings",
    "Status",
    "StructureAndMotion",
    "Trajectory",
    "TrajectoryError",
    "Trifocal",
    "TrifocalState",
    "TruncatedVideoError",
    "TruncatedVideoWarning",
    "Twist",
    "TwoStep",
    "TwoView",
    "VideoError",
    "align",
    "ate_rmse",
    "batch",
    "ekf",
    "evaluate",
    "filtering_bound",
    "nees",
    "refine",
    "relative_errors",
    "schmidt",
    "segments",
    "smoothing_bound",
    "tracker",
]
