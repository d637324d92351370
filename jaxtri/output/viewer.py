"""A recording for the rerun viewer: the camera on its way, its path and the points (extra `viewer`)."""

from pathlib import Path

import numpy as np

from jaxtri.errors import JaxtriError
from jaxtri.formats import atomic_path
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.run import Run


def write_recording(run: Run, camera: Camera, path: Path) -> Path:
    """Write a recording that `rerun FILE` shows; raises `JaxtriError` where rerun is not installed."""
    try:
        import rerun as rr  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise JaxtriError("the recording needs rerun: python -m pip install 'jaxtri[viewer]'") from None
    with atomic_path(path) as temporary:
        recording = rr.RecordingStream("jaxtri")
        recording.save(temporary)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        positions = run.trajectory.positions
        recording.log("world/path", rr.LineStrips3D([positions]), static=True)
        recording.log("world/points", rr.Points3D(run.points.xyz, colors=run.colours), static=True)
        size = camera.width or 2 * int(camera.cx), camera.height or 2 * int(camera.cy)

        def pinhole(camera: Camera) -> object:
            enlarged = np.asarray(camera.K) * np.append(np.full(2, camera.magnification), 1)  # viewers know no lenses
            return rr.Pinhole(image_from_camera=enlarged, resolution=size)

        zoom = run.odometry.zoom
        if zoom is None:
            recording.log("world/camera", pinhole(camera), static=True)
        for k, T in enumerate(run.trajectory.T_world_camera):
            recording.set_time("frame", sequence=k)
            recording.set_time("time", duration=run.trajectory.times[k] - run.trajectory.times[0])
            recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            if zoom is not None:
                recording.log("world/camera", pinhole(zoom.camera(camera, float(run.trajectory.times[k]))))
        recording.flush()
        recording.disconnect()
    return path
