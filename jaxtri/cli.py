"""The command line: `jaxtri track`, `jaxtri evaluate`, `jaxtri demo`."""

import sys
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxtri.errors import CameraError, InputError, InputWarning, JaxtriError

# The rest is imported where it is called: help and a wrong option need not wait for it.
if TYPE_CHECKING:
    from jaxtri.geometry.camera import Camera
    from jaxtri.vision.video import FrameSource


GUESS = 0.05  # what a field of view that is guessed makes of the focal length, as a share


@dataclass
class Track:
    """Recover a camera's motion from a video and write the trajectory, a plot, an overlay and the points."""

    source: tyro.conf.Positional[str]
    """A video file, a folder of frames, or the number of a camera."""
    camera: Path | None = None
    """Calibration: camera.json, or the file of OpenCV, ROS, Kalibr, COLMAP, ...; FILE#NAME of several cameras."""
    scale_camera: bool = False
    """Scale the calibration to the size of the frames, where those were resized as a whole and not cropped."""
    fov: float | None = None
    """Horizontal field of view in degrees, where there is no calibration."""
    out: Path = Path("out")
    """Folder of the results."""
    base: str = "tracks"
    """Base frames: `tracks` (a window of keyframes), `inherit` (one pair, restarts from tracked frames) or `paper`
    (one pair, restarts from consecutive frames)."""
    overlap: int = 1
    """Frames that two segments share (with `--base paper`)."""
    noise_px: float = 0.4
    """Standard deviation of a tracked point, pixels."""
    calibration_error: float | None = None
    """What the focal length may be off by, as a share of it (0.003; 0.05 with `--fov`): it is in the covariances."""
    mask: Path | None = None
    """Picture, or folder of one a frame, of the frames' size: what is white (a logo, the bonnet) is ignored."""
    find_overlays: bool = True
    """Find bars and overlays (a logo, a time code, the bonnet) by themselves, and ignore them."""
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
    refine: bool = True
    """Adjust all keyframes together at the end of a file; what a camera shows is left as it was followed."""
    overlay: bool = True
    """Write overlay.mp4."""
    recording: bool = False
    """Write recording.rrd for the rerun viewer (extra `viewer`)."""
    starts: str = "opencv"
    """Who proposes the relative poses of a start: `opencv`, or `poselib` beside it (extra `init`)."""
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
    quiet: bool = False
    """No progress bar."""


Command = (
    Annotated[Track, tyro.conf.subcommand("track")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input ends with a message and exit code 2."""
    # A file may be named like an option; "./-clip.mp4" is none.
    arguments = sys.argv[1:] if arguments is None else arguments
    arguments = [f"./{a}" if a.startswith("-") and Path(a).exists() else a for a in arguments]
    command = tyro.cli(Command, args=arguments, prog="jaxtri", description=__doc__)  # pyright: ignore
    import jax

    from jaxtri.compilation import keep_programs

    jax.config.update("jax_enable_x64", True)
    keep_programs()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = _show
            {Track: _track, Evaluate: _evaluate, Demo: _demo}[type(command)](command)
    except (JaxtriError, OSError) as error:
        print(f"jaxtri: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, InputWarning):
        print(f"jaxtri: warning: {message}", file=sys.stderr)


def _track(options: Track) -> None:
    from jaxtri.odometry.run import track, warm_up
    from jaxtri.output.report import run_text
    from jaxtri.output.results import spare, write_results
    from jaxtri.vision.video import open_source, spool

    _check(options)
    live = options.source.isdecimal() and not Path(options.source).exists()
    if live and options.max_frames is None:
        print("a camera runs on: stop with Ctrl-C, what was tracked is kept", file=sys.stderr)
    with open_source(options.source, fps=options.fps, strict=options.strict, mask=options.mask) as source:
        if not live:
            read = (options.source, options.camera, options.mask)
            spare(options.out, [Path(p) for p in read if p is not None], source.folder)
        camera = _camera(options, source)
        how = _how(camera, options)
        if live:
            warm_up(camera, **how)
        frames: Any = spool(source, options.out / "frames") if live else source
        refine = options.refine and not live
        more = {"progress": not options.quiet, "max_frames": options.max_frames, "refine": refine}
        run = track(frames, camera, **more, **how)
        fps = source.fps
    said = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items()}
    paths = write_results(run, options.out, said)
    if options.recording:
        from jaxtri.output.viewer import write_recording

        paths.append(write_recording(run, camera, options.out / "recording.rrd"))
    if options.overlay:
        paths += _overlay(options, run, camera, options.out / "frames" if live else options.source, fps)
    print(run_text(run, paths))


def _overlay(options: Track, run: Any, camera: "Camera", source: Path | str, fps: float) -> list[Path]:
    """The overlay over a second reading of the frames; none, with a warning, where the car has no place."""
    from jaxtri.output.results import write_overlay
    from jaxtri.vision.video import open_source

    with warnings.catch_warnings(), open_source(source, fps=options.fps) as again:
        warnings.simplefilter("ignore", InputWarning)  # said once already
        path = options.out / "overlay.mp4"
        try:
            return [write_overlay(run, again, camera, path, fps, at=options.place, progress=not options.quiet)]
        except InputError as error:
            if options.place is not None:
                raise
            print(f"jaxtri: warning: no overlay: {error}", file=sys.stderr)
            return []


def _check(options: Track) -> None:
    """Numbers and words that no run can use, named before anything is opened."""
    least = {"features": 50, "overlap": 1, "max_frames": 1, "min_parallax": 0, "noise_px": 1e-6, "calibration_error": 0}
    for name, low in least.items():
        value = getattr(options, name)
        if value is not None and not low <= value < float("inf"):
            raise InputError(f"--{name.replace('_', '-')} {value:g}: give a number of at least {low:g}")
    for name, words in {"base": ("tracks", "inherit", "paper"), "starts": ("opencv", "poselib")}.items():
        if getattr(options, name) not in words:
            raise InputError(f"--{name} {getattr(options, name)}: choose one of {', '.join(words)}")
    if options.out.exists() and not options.out.is_dir():
        raise InputError(f"--out {options.out} is a file: give a folder")


def _camera(options: Track, source: "FrameSource") -> "Camera":
    from jaxtri.formats import read_camera
    from jaxtri.geometry.camera import Camera

    w, h = source.size
    if options.camera is not None and options.fov is None:
        try:
            return read_camera(options.camera, width=w, height=h, scale=options.scale_camera)
        except CameraError as error:
            if source.turned_deg not in (90, 270):
                raise
            said = f"the frames are {w}x{h} because their orientation (EXIF or metadata) turns them by "
            said += f"{source.turned_deg} degrees: calibrate with the turned pictures, or take the orientation out"
            raise CameraError(f"{error}; {said}") from error
    if options.camera is not None or options.fov is None:
        raise CameraError("give the intrinsics: --camera FILE, or a guess of the field of view by --fov DEGREES")
    camera = Camera.from_fov(options.fov, w, h)
    # The field of view is that of the width; what is stored in pixels that are no squares has another fy.
    return replace(camera, fy=camera.fx * source.pixel_aspect)


def _how(camera: "Camera", options: Track) -> dict[str, Any]:
    """The keyword arguments that `odometry.run.track` and `warm_up` have in common."""
    from jaxtri.odometry.settings import CALIBRATED, Base, Settings, StartSettings
    from jaxtri.vision.klt import KLTSettings

    base = Base(options.base)
    changes = {} if options.min_parallax is None else {"parallax_deg": options.min_parallax}
    poselib = options.starts == "poselib"
    calibration = CALIBRATED if options.fov is None else GUESS
    if options.calibration_error is not None:
        calibration = options.calibration_error
    return {
        "base": base,
        "settings": Settings.of(camera, noise_px=options.noise_px, calibration=calibration),
        "start": StartSettings.of(base, overlap=options.overlap, poselib=poselib, **changes),
        "klt": KLTSettings(capacity=options.features, find_overlays=options.find_overlays),
    }


def _evaluate(options: Evaluate) -> None:
    from jaxtri.formats import write_json
    from jaxtri.formats.trajectories import read_pair
    from jaxtri.output.report import errors_text
    from jaxtri.trajectory import evaluate

    pair = read_pair(options.estimate, options.groundtruth, options.times)
    found = evaluate(*pair, with_scale=options.scale)
    print(errors_text(found))
    if options.json is not None:
        write_json(options.json, asdict(found))


def _demo(options: Demo) -> None:
    from jaxtri.output.demo import demo
    from jaxtri.output.report import errors_text, run_text

    if options.frames < 2:
        raise InputError(f"--frames {options.frames}: a camera's motion needs at least two")
    print(f"rendering {options.frames} frames of a laboratory, the camera sliding sideways before some boxes")
    said = asdict(options) | {"out": str(options.out)}
    done = demo(options.out, said, frames=options.frames, seed=options.seed, progress=not options.quiet)
    print(run_text(done.run, done.paths))
    print("errors against the truth, in metres:")
    print(errors_text(done.errors))
    print(
        f"look at {options.out / 'trajectory.png'} and {options.out / 'overlay.mp4'}; the frames are in {done.frames}"
    )


if __name__ == "__main__":
    main()
