"""Pictures of the documentation, from generated scenes alone: python docs/gallery.py."""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import numpy as np

from jaxtri import evaluate, open_source, read_trajectory, track, write_overlay, write_results
from jaxtri.output.plot import plot_trajectory
from jaxtri.output.results import NAMES, precise
from jaxtri.synthetic import Footage, laboratory, planar_scene
from jaxtri.synthetic.rendered import write_footage

IMAGES = Path(__file__).parent / "images"
LIMIT = 300_000  # bytes of a picture
FRAMES = 100


def orbit(frames: int) -> Footage:
    """The laboratory, with a camera that goes around a point on the table by half a degree a frame."""
    footage = laboratory(frames)
    pivot = np.array([0.0, 0.0, 1.2])  # metres before the first camera
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for k, T in enumerate(poses):
        T[:3, :3] = cv2.Rodrigues(np.radians(0.5) * k * np.array([0.3, -1.0, 0.0]))[0]
        T[:3, 3] = pivot - T[:3, :3] @ pivot
    return footage._replace(T_world_camera=poses)


def wall(frames: int) -> Footage:
    """A plane of coloured patches, past which the camera slides: two poses explain it, and one has to be chosen."""
    footage = laboratory(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.006 * np.arange(frames)
    poses[:, 2, 3] = 0.002 * np.arange(frames)
    return footage._replace(scene=planar_scene(), T_world_camera=poses)


def make(name: str, footage: Footage, shown: Sequence[float] = (0.05, 0.5, 0.98)) -> str:
    """Track a scene; write three frames of its overlay and its trajectory. Returns its errors in a line."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        camera = write_footage(folder / "sequence", footage, progress=False)
        truth = read_trajectory(folder / "sequence" / "groundtruth.txt")
        with open_source(folder / "sequence") as source:
            run = track(source, camera, progress=False)
        found = evaluate(run.trajectory, truth)
        run = run.scaled(found.scale)
        write_results(run, folder, {}, reference=truth)
        with open_source(folder / "sequence") as source:
            write_overlay(run, source, camera, folder / "overlay.avi", source.fps, progress=False)
        video = cv2.VideoCapture(str(folder / "overlay.avi"))
        images = [video.read()[1] for _ in footage.times]
    strip = np.hstack([cv2.resize(images[int(s * len(images))], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
                       for s in shown])  # fmt: skip
    for k in range(1, len(shown)):  # a gap between the frames
        middle = k * strip.shape[1] // len(shown)
        strip[:, middle - 4 : middle + 4] = 255
    keep(name, strip)
    points = run.points.xyz[precise(run)]
    figure = plot_trajectory(run.trajectory, reference=truth, points=points, names=NAMES, units="m")
    figure.savefig(IMAGES / f"{name}_trajectory.png", dpi=80)
    return f"{name}: ATE {1e3 * found.ate_rmse:.2f} mm, {found.ate_percent:.3f} % of the path"


def keep(name: str, image: np.ndarray) -> None:
    """Write a JPEG of at most `LIMIT` bytes."""
    for quality in (88, 80, 70, 60):
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        if len(data) < LIMIT:
            (IMAGES / f"{name}.jpg").write_bytes(data.tobytes())
            return
    raise SystemExit(f"{name} is too large")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    IMAGES.mkdir(exist_ok=True)
    scenes = {"demo": laboratory, "orbit": orbit, "wall": wall}
    for chosen in sys.argv[1:] or scenes:
        print(make(chosen, scenes[chosen](FRAMES)), flush=True)
