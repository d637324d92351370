"""The files of a run: trajectory, plot, points, overlay, and the record of how they came about."""

import importlib.metadata
import platform
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from tqdm import tqdm

from jaxtri.errors import InputError
from jaxtri.formats import atomic_path, atomic_write, write_camera, write_json, write_ply, write_tum
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.zoom_curve import camera_at
from jaxtri.odometry.run import Run
from jaxtri.odometry.settings import Status
from jaxtri.output.overlay import car, draw_text, draw_wireframe, place
from jaxtri.output.plot import plot_trajectory
from jaxtri.output.words import ranges
from jaxtri.trajectory import Trajectory
from jaxtri.vision.video import Frame, write_video

PACKAGES = ("jaxtri", "jax", "equinox", "optimistix", "jaxlie", "numpy", "opencv-python-headless")
NAMES = {int(s): s.name.lower() for s in Status}


FILES = (
    "trajectory.txt",
    "trajectory_causal.txt",
    "trajectory.png",
    "points.ply",
    "run.json",
    "overlay.mp4",
    "recording.rrd",
)
"""Everything that a run may write into its folder."""
CAMERA, FOCAL = "camera.json", "focal_length.txt"
"""What a run writes beside that where it estimates the camera, too; the second where the camera zooms."""


def spare(out: Path, inputs: Iterable[Path], frames: Path | None, written: Iterable[str] = FILES) -> None:
    """Make sure that the results of a run, written to `out`, leave what it reads as it is.

    `inputs` are files or folders that it reads; `frames` is the folder that holds the images, if there are any;
    `written` are the names of the results. Raises `InputError` where results would take the place of an input, or
    stand where the images of the source are looked for.
    """
    for path in inputs:
        if any((out / name).exists() and path.exists() and (out / name).samefile(path) for name in written):
            raise InputError(f"--out {out}: the results would overwrite {path}, which is read; give another folder")
        places = () if frames is None else (frames.resolve(), *frames.resolve().parents)
        if path.is_dir() and out.resolve() in (p for p in places if p.is_relative_to(path.resolve())):
            raise InputError(
                f"--out {out} is where the frames of the source {path} are looked for, and trajectory.png would count "
                "as one of them; give another folder"
            )


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the figures of a run depend on."""
    return {"python": platform.python_version()} | {p: importlib.metadata.version(p) for p in PACKAGES}


def write_results(
    run: Run, out: Path, settings: Mapping[str, object], reference: Trajectory | None = None
) -> list[Path]:
    """Write trajectory.txt, trajectory.png, points.ply and run.json; returns their paths.

    Where the camera was estimated, too, camera.json beside them has it, for `--camera` and other tools; where it zooms,
    with its mean focal length, and focal_length.txt has that of each frame. Where the run was refined,
    trajectory_causal.txt beside them has what the filter made of each frame at its time.
    `reference` is the truth in the frame and scale of the run, for the plot.
    """
    paths = [out / name for name in ("trajectory.txt", "trajectory.png", "points.ply", "run.json")]
    status = run.trajectory.status
    assert status is not None
    unsure = [
        f"{NAMES[code]}: frames {ranges(status == code)}" for code in NAMES if code != 1 and (status == code).any()
    ]
    header = "timestamp tx ty tz qx qy qz qw   camera to world, camera x right y down z forward, scale: gauge"
    write_tum(paths[0], run.trajectory, "\n".join([header, *unsure]))
    if run.refined is not None:
        paths.insert(1, out / "trajectory_causal.txt")
        write_tum(paths[1], run.odometry.trajectory(), header)
    figure = plot_trajectory(
        run.trajectory,
        reference=reference,
        points=run.points.xyz[precise(run)],
        names=NAMES,
        units="first base line" if reference is None else "m",
    )
    with atomic_path(out / "trajectory.png") as temporary:
        figure.savefig(temporary, dpi=120)
    sd = np.sqrt(np.linalg.eigvalsh(run.points.covariance)[:, -1]) if len(run.points.ids) else np.zeros(0)
    write_ply(out / "points.ply", run.points.xyz, run.colours, {"sd": sd})
    if run.calibration is not None:
        paths.append(out / CAMERA)
        write_camera(paths[-1], run.calibration.camera)
        if run.calibration.zoom is not None:
            paths.append(out / FOCAL)
            _write_focal_lengths(paths[-1], run)
    write_json(out / "run.json", {"settings": settings, "versions": versions(), "statistics": run.statistics})
    return paths


def _write_focal_lengths(path: Path, run: Run) -> None:
    with atomic_write(path) as file:
        file.write("# timestamp [s], focal length [px]\n")
        for time_s in run.trajectory.times:
            file.write(f"{time_s:.9f} {float(run.odometry.camera_at(float(time_s)).fx):.6f}\n")


def precise(run: Run, share: float = 0.1) -> np.ndarray:
    """Points (n,) whose standard deviation is below a share of their distance from the camera's path."""
    if not len(run.points.ids):
        return np.zeros(0, bool)
    sd = np.sqrt(np.linalg.eigvalsh(run.points.covariance)[:, -1])
    distance = np.linalg.norm(run.points.xyz - run.trajectory.positions.mean(axis=0), axis=1)
    return sd < share * distance


def write_overlay(
    run: Run,
    frames: Iterable[Frame],
    camera: Camera,
    path: Path,
    fps: float,
    *,
    at: tuple[float, float] | None = None,
    progress: bool = True,
) -> Path:
    """Write the frames with a wire-frame car that stands in the scene; `at` is its pixel in the middle frame.

    Raises `InputError` where there is no place for it.
    """
    good = precise(run)
    if good.sum() < 10:
        raise InputError(f"only {int(good.sum())} points are known well enough to stand anything on")
    posed = [k for k, p in enumerate(run.poses) if p.T_camera_world is not None]
    middle = posed[len(posed) // 2]
    zoom = run.odometry.zoom
    seen_by = camera_at(camera, zoom, run.poses[middle].time)
    T_world_car = place(run.points.xyz[good], run.trajectory.T_world_camera[middle], seen_by, pixel=at)
    wireframe = car()

    def drawn() -> Iterator[np.ndarray]:
        total = len(run.poses)
        bar = tqdm(frames, total=total, unit="frame", desc="overlay", disable=None if progress else True, leave=False)
        for frame, pose in zip(bar, run.poses, strict=False):
            image = frame.image
            if pose.T_camera_world is not None:
                seen_by = camera_at(camera, zoom, pose.time)
                image = draw_wireframe(image, seen_by, pose.T_camera_world, T_world_car, wireframe)
            text = f"frame {frame.index}  {pose.status.name.lower()}"
            yield draw_text(image, f"{text}  {pose.used} points" if pose.used else text)

    write_video(path, drawn(), fps)
    return path
