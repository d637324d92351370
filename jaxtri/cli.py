"""The command line: `jaxtri track`, `jaxtri evaluate`, `jaxtri demo`."""

import importlib.metadata
import platform
import sys
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxtri.errors import CameraError, InputError, JaxtriError, TruncatedVideoWarning

PACKAGES = ("jaxtri", "jax", "equinox", "optimistix", "jaxlie", "numpy", "opencv-python-headless")


@dataclass
class Track:
    """Recover a camera's motion from a video and write the trajectory, a plot, an overlay and the points."""

    source: tyro.conf.Positional[str]
    """A video file, a folder of frames, or the number of a camera."""
    camera: Path | None = None
    """Calibration: camera.json, or OpenCV's or ROS's YAML."""
    fov: float | None = None
    """Horizontal field of view in degrees, where there is no calibration."""
    out: Path = Path("out")
    """Folder of the results."""
    base: str = "tracks"
    """Base frames: `tracks` (a pair per track), `inherit` (one pair, restarts from tracked frames) or `paper`
    (one pair, restarts from consecutive frames)."""
    overlap: int = 1
    """Frames that two segments share (with `--base paper`)."""
    noise_px: float = 0.4
    """Standard deviation of a tracked point, pixels."""
    features: int = 800
    """Features followed at once."""
    min_parallax: float | None = None
    """Least median parallax of the first base pair, degrees (1; 0.1 with `--base paper`)."""
    fps: float | None = None
    """Frames a second, instead of the source's own times."""
    max_frames: int | None = None
    """Stop after so many frames."""
    place: tuple[float, float] | None = None
    """Where the car stands: pixel u v in the middle frame; on the dominant plane by default."""
    overlay: bool = True
    """Write overlay.mp4."""
    strict: bool = False
    """Fail on a truncated source instead of warning."""
    quiet: bool = False
    """No progress bar."""


@dataclass
class Evaluate:
    """Compare a trajectory with the ground truth: ATE after alignment, RPE, orientation."""

    estimate: tyro.conf.Positional[Path]
    """Trajectory file: TUM, KITTI or EuRoC."""
    groundtruth: tyro.conf.Positional[Path]
    """Trajectory file: TUM, KITTI or EuRoC."""
    scale: bool = True
    """Align the scale too, Sim(3), as a monocular trajectory needs; `--no-scale` for SE(3)."""
    json: Path | None = None
    """Write the figures here."""


@dataclass
class Demo:
    """Render a laboratory scene with exact truth, track it, and print the errors."""

    out: Path = Path("jaxtri-demo")
    """Folder of the results."""
    frames: int = 100
    """Length of the sequence."""
    seed: int = 0
    """Of the noise in the images."""
    quiet: bool = False
    """No progress bar."""


Command = (
    Annotated[Track, tyro.conf.subcommand("track")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input ends with a message and exit code 2."""
    command = tyro.cli(Command, args=arguments, prog="jaxtri", description=__doc__)  # pyright: ignore
    import jax

    jax.config.update("jax_enable_x64", True)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show
            {Track: _track, Evaluate: _evaluate, Demo: _demo}[type(command)](command)
    except (JaxtriError, OSError) as error:
        print(f"jaxtri: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, TruncatedVideoWarning):
        print(f"jaxtri: warning: {message}", file=sys.stderr)


def _versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {p: importlib.metadata.version(p) for p in PACKAGES}
