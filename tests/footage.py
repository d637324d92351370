"""A few small rendered frames: what the tests of whole runs are fed with."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from jaxtri.geometry.camera import Camera
from jaxtri.synthetic import laboratory, rendered_sequence
from jaxtri.trajectory import Trajectory
from jaxtri.vision.video import Frame

STRIDE = 5  # of the laboratory's frames: 25 mm a frame, so that twenty frames make half a dozen keyframes


class Clip(NamedTuple):
    """Frames at 320x240 pixels, their camera and the true trajectory, metres."""

    camera: Camera
    frames: list[Frame]
    truth: Trajectory


@cache
def clip(n_frames: int = 20) -> Clip:
    """The laboratory from every fifth of its poses, at half its resolution."""
    scene, large, times, poses = laboratory(STRIDE * n_frames)
    w, h = (large.width or 0) // 2, (large.height or 0) // 2
    # The centre of the top-left pixel is (0, 0): that of four is half a pixel further.
    cx, cy = ((float(c) + 0.5) / 2 - 0.5 for c in (large.cx, large.cy))
    camera = Camera.from_parameters(float(large.fx) / 2, float(large.fy) / 2, cx, cy, width=w, height=h)
    times, poses = times[::STRIDE], poses[::STRIDE]
    images = rendered_sequence(scene, camera, poses, noise_gray=1.0)
    frames = [Frame(k, float(times[k]), image) for k, image in enumerate(images)]
    return Clip(camera, frames, Trajectory(np.asarray(times), np.asarray(poses)))


def dissolving(length: int, n_frames: int = 20) -> Clip:
    """Another shot, moving the other way, that comes through the first for so many frames from the sixth on."""
    found = clip(n_frames)
    shares = np.clip((np.arange(n_frames) - 5) / (length + 1), 0, 1)
    mixed = []
    for frame, other, share in zip(found.frames, found.frames[::-1], shares, strict=True):
        image = np.ascontiguousarray(255 - other.image[::-1, ::-1])
        mixed.append(replace(frame, image=cv2.addWeighted(frame.image, 1 - share, image, share, 0)))
    return found._replace(frames=mixed)
