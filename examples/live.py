"""Poses while frames come in: from a rendered scene, or from a camera, `python examples/live.py 0`; Ctrl-C ends it."""

import sys
from contextlib import suppress

import jax
import numpy as np

from jaxtri import KLT, Camera, KLTSettings, Odometry, keep_programs, open_source, warm_up
from jaxtri.synthetic import laboratory, rendered_sequence

jax.config.update("jax_enable_x64", True)
keep_programs()  # a second run need not compile
klt = KLTSettings(capacity=256)
if len(sys.argv) > 1:
    source = open_source(sys.argv[1])
    camera = Camera.from_fov(65, *source.size)  # a guess: give the calibration, where there is one
    frames = ((frame.image, frame.time_s) for frame in source)
else:
    scene, camera, times, poses = laboratory(40)
    frames = zip(rendered_sequence(scene, camera, poses), times, strict=True)

warm_up(camera, klt=klt)  # compiles before the first frame comes
features, odometry = KLT(klt), Odometry(camera, capacity=klt.capacity)
with suppress(KeyboardInterrupt):
    for image, time in frames:
        tracks = features.track(image)
        outliers = odometry.add(tracks.pixels, tracks.visible, time, ids=tracks.ids)
        features.drop(tracks.ids[outliers])
        now = odometry.latest
        if now is not None and now.T_camera_world is not None:
            R, T = now.T_camera_world[:3, :3], now.T_camera_world[:3, 3]
            centre, sd = -R.T @ T, np.sqrt(np.trace(now.covariance[:3, :3]))
            print(f"{time:6.2f} s {now.status.name:9} {now.used:4} points, at {centre.round(2)} +- {sd:.3f}")
        else:
            print(f"{time:6.2f} s {odometry.status.name.lower()}: {odometry.reason}")
odometry.finish()
print(f"{len(odometry.poses)} frames, {len(odometry.points().ids)} points; the unit is the first base line")
