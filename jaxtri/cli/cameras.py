"""The camera that a run begins with, and the settings that its calibration asks for."""

from dataclasses import replace
from typing import TYPE_CHECKING

from jaxtri.cli.options import Track
from jaxtri.errors import CameraError

# The rest is imported where it is called: help and a wrong option need not wait for it.
if TYPE_CHECKING:
    from jaxtri.geometry.camera import Camera
    from jaxtri.odometry.settings import Settings
    from jaxtri.vision.video import FrameSource

GUESS = 0.05  # what a field of view that is guessed makes of the focal length, as a share
USUAL = 60.0  # degrees: the field of view that the search begins with where nothing is known
FROM_FOV, FROM_EXIF, FROM_FILE = 0.3, 0.1, 0.05  # what a focal length may be off by beforehand, as a share of it


def begin_camera(options: Track, source: "FrameSource", live: bool) -> tuple["Camera", float | None]:
    """The camera to begin with, and what is known of its focal length where it is to be estimated, as a share of it."""
    camera, prior = _optics(options, source, live)
    if options.input.readout is None:
        return camera, prior
    # It is that of the rows of the sensor; the pictures may have been turned since.
    columns, rows = ((0, 1), (-1, 0), (0, -1), (1, 0))[source.turned_deg // 90 % 4]
    return camera.rolling(columns * options.input.readout, rows * options.input.readout), prior


def _optics(options: Track, source: "FrameSource", live: bool) -> tuple["Camera", float | None]:
    """All but the shutter."""
    from jaxtri.formats import read_camera
    from jaxtri.geometry.camera import Camera
    from jaxtri.odometry.calibrate import GUESSED

    (w, h), more, refine = source.size, options.input, options.input.refine_camera
    if live and (refine or (options.camera is None and options.fov is None)):
        raise CameraError(
            "a live camera shows its frames once, so that it cannot be calibrated by them: give --camera FILE, or "
            "--fov DEGREES; or film a clip with it, track that, and give the camera.json that comes of it"
        )
    if options.camera is not None and options.fov is not None:
        raise CameraError("--camera and --fov both say the focal length: give one of them")
    if options.camera is not None:
        try:
            camera = read_camera(options.camera, width=w, height=h, scale=more.scale_camera, turn_deg=more.turn_camera)
        except CameraError as error:
            if source.turned_deg not in (90, 270) or more.turn_camera:
                raise
            said = f"give --turn-camera {source.turned_deg} if it was calibrated before that"
            raise CameraError(f"{error}; their orientation (EXIF or metadata) turns the images: {said}") from error
        return camera, FROM_FILE if refine else None
    fov, prior = options.fov, FROM_FOV if refine else None
    if fov is None:
        fov, prior = (USUAL, GUESSED) if source.field_of_view_deg is None else (source.field_of_view_deg, FROM_EXIF)
    camera = Camera.from_fov(fov, w, h)
    # The field of view is that of the width; what is stored in pixels that are no squares has another fy.
    return replace(camera, fy=camera.fx * source.pixel_aspect), prior


def settings_of(options: Track, camera: "Camera", share: float | None = None) -> "Settings":
    """Those of a camera; `share` is what its focal length is estimated to, as a share of it."""
    from jaxtri.odometry.settings import CALIBRATED, Settings

    calibration = options.input.calibration_error
    if calibration is None:
        calibration = share or (CALIBRATED if options.fov is None else GUESS)
    return Settings.of(camera, noise_px=options.tracker.noise_px, calibration=calibration)
