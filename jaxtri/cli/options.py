"""The options of the commands, and what help says of them."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import arg

Source = tyro.conf.Positional[Annotated[str, arg(metavar="SOURCE")]]
FileOption = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")]
Rate = Annotated[float | None, arg(metavar="RATE", help_behavior_hint="(default: the source's times)")]
Frames = Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")]
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]  # without its --no- form: it is off by default
On = Annotated[Switch, arg(help_behavior_hint="")]  # its --no- form alone


# The groups of `jaxtri track --help`. They have no docstrings: help would repeat them.
@dataclass
class _Input:
    refine_camera: Switch = False
    """Estimate focal length and lens, from --camera or --fov on."""
    scale_camera: Switch = False
    """Scale the calibration to the frames: resized, not cropped."""
    turn_camera: Annotated[int, arg(metavar="DEGREES")] = 0
    """Turn the calibration clockwise, as the frames were: 90, 180, 270."""
    calibration_error: Annotated[
        float | None, arg(metavar="SHARE", help_behavior_hint="(default: .003; .05 with --fov)")
    ] = None
    """Error of the focal length, as a share of it."""
    readout: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="(default: all rows at once)")] = None
    """Seconds in which a rolling shutter reads the rows."""
    strict: Switch = False
    """Fail on a truncated source instead of warning."""


@dataclass
class _Tracker:
    features: Annotated[int, arg(metavar="N")] = 800
    """Features followed at once."""
    noise_px: Annotated[float, arg(metavar="PX")] = 0.4
    """Standard deviation of a tracked point, pixels."""
    starts: Annotated[str, arg(metavar="WHO")] = "opencv"
    """Who proposes starts: opencv, or poselib beside it."""
    find_overlays: bool = True
    """Find bars, logos, a bonnet by themselves, and ignore them."""
    find_dissolves: bool = True
    """Find dissolves between shots, and start anew after them."""
    min_parallax: Annotated[
        float | None, arg(metavar="DEGREES", help_behavior_hint="(default: 1; 0.1 with --base paper)")
    ] = None
    """Least parallax of a start."""
    base: Annotated[str, arg(metavar="KIND")] = "tracks"
    """Base frames: tracks, inherit or paper."""
    overlap: Annotated[int, arg(metavar="N")] = 1
    """Frames that two segments share (--base paper)."""
    refine: On = True
    """Do not adjust all keyframes together at the end of a file."""
    loops: On = True
    """Do not find places again after a loss, nor close loops."""


@dataclass
class _Output:
    overlay: On = True
    """Write no overlay.mp4."""
    place: Annotated[tuple[float, float] | None, arg(metavar="U V", help_behavior_hint="(default: on a plane)")] = None
    """Pixel of the middle frame where the car stands."""
    recording: Switch = False
    """Write recording.rrd (extra viewer)."""


@dataclass
class Track:
    """Recover a camera's motion from a video and write the trajectory, a plot, an overlay and the points."""

    source: Source
    """A video file, a folder of frames, or the number of a camera."""
    camera: FileOption = None
    """Calibration: camera.json, or of another tool; FILE#NAME."""
    fov: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="(default: from the video)")] = None
    """Horizontal field of view, if not calibrated."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("out")
    """Folder of the results."""
    mask: FileOption = None
    """Picture, or folder of one a frame: white is ignored."""
    fps: Rate = None
    """Frames a second."""
    max_frames: Frames = None
    """Stop after so many frames."""
    quiet: Switch = False
    """No progress bar."""
    input: _Input = field(default_factory=_Input)
    tracker: _Tracker = field(default_factory=_Tracker)
    output: _Output = field(default_factory=_Output)

    def flat(self) -> dict[str, Any]:
        """All options by the names that they have on the command line, whatever their group."""
        found: dict[str, Any] = {}
        for name, value in asdict(self).items():
            found |= value if isinstance(value, dict) else {name: value}
        return found


@dataclass
class Check:
    """Say what a video shows and whether it can be tracked: size, times, light, blur, features, flow, cuts, faults."""

    source: Source
    """A video file, a folder of frames, or the number of a camera."""
    mask: FileOption = None
    """Picture, or folder of one a frame: white is ignored."""
    fps: Rate = None
    """Frames a second."""
    max_frames: Frames = None
    """Stop after so many frames."""
    json: FileOption = None
    """Write the figures of every frame here."""
    quiet: Switch = False
    """No progress bar."""


@dataclass
class Evaluate:
    """Compare a trajectory with the ground truth: ATE after alignment, RPE, orientation."""

    estimate: tyro.conf.Positional[Path]
    """Trajectory file: TUM, KITTI or EuRoC."""
    groundtruth: tyro.conf.Positional[Path]
    """Trajectory file: TUM, KITTI or EuRoC."""
    times: Path | None = None
    """Times of the lines of a KITTI file, which has none; by default a times.txt beside it, where they are needed."""
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
    quiet: Switch = False
    """No progress bar."""


Command = (
    Annotated[Check, tyro.conf.subcommand("check")]
    # Without prefixes it is --noise-px, not --tracker.noise-px.
    | Annotated[Track, tyro.conf.subcommand("track"), tyro.conf.OmitArgPrefixes]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)
