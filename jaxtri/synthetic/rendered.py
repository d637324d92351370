"""A rendered sequence on disk, in the layout that `jaxtri track` reads, with its ground truth."""

from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from jaxtri.formats import atomic_path, write_camera, write_tum
from jaxtri.geometry.camera import Camera
from jaxtri.synthetic.laboratory import Footage, laboratory
from jaxtri.synthetic.scene import rendered_sequence
from jaxtri.trajectory import Trajectory


def write_laboratory(folder: Path, n_frames: int = 100, seed: int = 0, *, progress: bool = True) -> Camera:
    """Render the laboratory scene into `folder`; see `write_footage`."""
    return write_footage(folder, laboratory(n_frames, seed), seed, progress=progress)


def write_footage(folder: Path, footage: Footage, seed: int = 0, *, progress: bool = True) -> Camera:
    """Render a sequence into `folder`: frames, timestamps, ground truth (TUM) and camera.json."""
    scene, camera, times, T_world_camera = footage
    n_frames = len(times)
    names = [f"frames/{k:06d}.jpg" for k in range(n_frames)]
    images = rendered_sequence(scene, camera, T_world_camera, noise_gray=1.0, seed=seed)
    bar = tqdm(images, total=n_frames, unit="frame", desc="rendering", disable=None if progress else True, leave=False)
    for name, image in zip(names, bar, strict=True):
        with atomic_path(folder / name) as temporary:
            cv2.imwrite(str(temporary), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    with atomic_path(folder / "timestamps.txt") as temporary:
        temporary.write_text("".join(f"{t:.6f} {name}\n" for t, name in zip(times, names, strict=True)))
    write_tum(
        folder / "groundtruth.txt", Trajectory(np.asarray(times, np.float64), np.asarray(T_world_camera, np.float64))
    )
    write_camera(folder / "camera.json", camera)
    return camera
