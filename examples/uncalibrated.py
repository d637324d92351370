"""The camera's path and the camera itself, of a clip without a calibration; `python examples/uncalibrated.py CLIP`."""

import sys
from pathlib import Path

import jax
import numpy as np

from jaxtri import BrownConrady, Camera, open_source, track, track_uncalibrated, write_results
from jaxtri.formats import read_camera
from jaxtri.synthetic import laboratory, rendered_sequence
from jaxtri.vision.video import write_video

jax.config.update("jax_enable_x64", True)

clip = sys.argv[1] if len(sys.argv) > 1 else "clip.mp4"
if len(sys.argv) == 1:
    # 40 frames of a camera that goes around a table, by 40 degrees, and looks at it through a barrel lens.
    lens = BrownConrady.from_coefficients([-0.15])
    camera = Camera.from_parameters(250, 250, 159.5, 119.5, width=320, height=240, distortion=lens)
    poses = np.tile(np.eye(4), (40, 1, 1))
    for pose, a in zip(poses, np.radians(np.linspace(-20, 20, 40)), strict=True):
        pose[:3, :3] = [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
        pose[:3, 3] = np.array([0, 0, 1.2]) - 1.2 * pose[:3, 2]
    write_video(clip, rendered_sequence(laboratory(1).scene, camera, poses, noise_gray=1), 25)

with open_source(clip) as source:
    guess = Camera.from_fov(source.field_of_view_deg or 60, *source.size)
run = track_uncalibrated(lambda: open_source(clip), guess)
found = run.calibration
sd = float(found.camera.fx) * found.focal_sd
print(f"focal length {found.camera.fx:.1f} pixels, one sigma {sd:.1f}; determined: {found.determined}")
print(f"k1 {found.camera.distortion.coefficients[0]:.3f}, one sigma {found.radial_sd[0]:.3f}")
write_results(run, Path("out"), {})  # camera.json is one of them

with open_source(clip) as source:
    again = track(source, read_camera("out/camera.json"), refine=True)
print(f"by the camera that was found: {again.trajectory.path_length:.2f} base lines in {len(again.poses)} frames")
