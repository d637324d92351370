"""A pose for every frame as it comes: of a rendered scene, or of a camera, `python examples/live.py 0`."""

import sys

import numpy as np

from jaxtri import KLT, Camera, KLTSettings, Odometry, StartSettings, open_source, warm_up
from jaxtri.synthetic import laboratory, rendered_sequence

if len(sys.argv) > 1:
    source = open_source(sys.argv[1])
    camera = Camera.from_fov(65, *source.size)  # a guess: read_camera takes the file of a calibration
    frames = ((frame.time_s, frame.image) for frame in source)
else:
    camera = Camera.from_parameters(280, 280, 159.5, 119.5, width=320, height=240)
    scene, _, times, poses = laboratory(30)
    frames = zip(times, rendered_sequence(scene, camera, poses), strict=True)

klt, start = KLTSettings(capacity=120), StartSettings(lag=4)
warm_up(camera, klt=klt, start=start)  # compiles: no frame should wait for it
features, odometry = KLT(klt), Odometry(camera, start=start, capacity=klt.capacity)
for time, image in frames:
    features.lost = odometry.lost  # then it looks in every frame for what was there before
    tracks = features.track(image)
    outliers = odometry.add(tracks.pixels, tracks.visible, time, ids=tracks.ids, returns=tracks.returns)
    features.drop(tracks.ids[outliers])
    latest = odometry.latest  # `lag` frames behind while a start is worked out
    if latest is None or latest.T_camera_world is None:
        print(f"{time:.2f} s: no pose yet, {odometry.reason}")
        continue
    R, T = latest.T_camera_world[:3, :3], latest.T_camera_world[:3, 3]
    position, sd = -R.T @ T, np.sqrt(np.trace(latest.covariance[:3, :3]))
    print(f"{latest.time:.2f} s: {latest.status.name.lower()} at {position.round(3)}, one sigma {sd:.3f}", flush=True)

print(f"{odometry.trajectory().path_length:.2f} base lines in {len(odometry.poses)} frames")
