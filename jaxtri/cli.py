"""The command line: `jaxtri check`, `jaxtri track`, `jaxtri evaluate`, `jaxtri demo`."""

import sys
import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import arg

from jaxtri.errors import CameraError, InputError, InputWarning, JaxtriError

# The rest is imported where it is called: help and a wrong option need not wait for it.
if TYPE_CHECKING:
    from jaxtri.geometry.camera import Camera
    from jaxtri.odometry.settings import Settings
    from jaxtri.vision.video import FrameSource

GUESS = 0.05  # what a field of view that is guessed makes of the focal length, as a share
USUAL = 60.0  # degrees: the field of view that the search begins with where nothing is known
FROM_FOV, FROM_EXIF, FROM_FILE = 0.3, 0.1, 0.05  # what a focal length may be off by beforehand, as a share of it

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


@dataclass
class _Filter:
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
    filter: _Filter = field(default_factory=_Filter)
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


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input ends with a message and exit code 2."""
    # A file may be named like an option; "./-clip.mp4" is none.
    arguments = sys.argv[1:] if arguments is None else arguments
    arguments = [f"./{a}" if a.startswith("-") and Path(a).exists() else a for a in arguments]
    command = tyro.cli(Command, args=arguments, prog="jaxtri", description=__doc__)  # pyright: ignore
    if not isinstance(command, Check):  # which computes nothing by JAX
        import jax

        from jaxtri.compilation import keep_programs

        jax.config.update("jax_enable_x64", True)
        keep_programs()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = _Shown()
            {Check: _check_source, Track: _track, Evaluate: _evaluate, Demo: _demo}[type(command)](command)
    except (JaxtriError, OSError) as error:
        print(f"jaxtri: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


class _Shown:
    """Shows warnings of the input, each once: a source may be read several times."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def __call__(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = f"jaxtri: warning: {message}"
        if issubclass(category, InputWarning) and text not in self._said:
            self._said.add(text)
            print(text, file=sys.stderr)


def _is_live(options: Check | Track) -> bool:
    """Whether the source is a camera; that it runs on is said."""
    live = options.source.isdecimal() and not Path(options.source).exists()
    if live and options.max_frames is None:
        print("a camera runs on: stop with Ctrl-C, what was seen so far is kept", file=sys.stderr)
    return live


def _check_source(options: Check) -> None:
    from jaxtri.formats import write_json
    from jaxtri.output.check import check_text, findings, verdict
    from jaxtri.vision.survey import survey
    from jaxtri.vision.video import open_source

    if options.max_frames is not None and options.max_frames < 1:
        raise InputError(f"--max-frames {options.max_frames}: give a number of at least 1")
    _is_live(options)
    with open_source(options.source, fps=options.fps, mask=options.mask) as source:
        found = survey(source, max_frames=options.max_frames, progress=not options.quiet)
    wrong = findings(found)
    print(check_text(found, wrong))
    if options.json is not None:
        write_json(options.json, {"verdict": verdict(wrong), "findings": wrong, "figures": found})


def _track(options: Track) -> None:
    from jaxtri.odometry.rounds import track_uncalibrated
    from jaxtri.odometry.run import track, warm_up
    from jaxtri.output.report import run_text
    from jaxtri.output.results import CAMERA, FILES, FOCAL, spare, write_results
    from jaxtri.vision.video import open_source, spool

    _check(options)
    live = _is_live(options)

    def reopen() -> "FrameSource":
        return open_source(options.source, fps=options.fps, strict=options.input.strict, mask=options.mask)

    with reopen() as source:
        camera, prior = _camera(options, source, live)
        if not live:
            read = (options.source, options.camera, options.mask)
            written = FILES if prior is None else (*FILES, CAMERA, FOCAL)
            spare(options.out, [Path(p) for p in read if p is not None], source.folder, written)
        how, fps = _how(options), source.fps
        refine = options.filter.refine and not live
        more = {"progress": not options.quiet, "max_frames": options.max_frames, "refine": refine}
        if prior is None:
            how |= {"settings": _settings(options, camera)}
            if live:
                warm_up(camera, **how)
            frames: Any = spool(source, options.out / "frames") if live else source
            run = track(frames, camera, **more, **how)
        else:
            how |= {"settings": lambda camera, share: _settings(options, camera, share)}
            run = track_uncalibrated(reopen, camera, prior=prior, **more, **how)
    camera = run.odometry.camera
    said = {k: str(v) if isinstance(v, Path) else v for k, v in options.flat().items()}
    paths = write_results(run, options.out, said)
    if options.output.recording:
        from jaxtri.output.viewer import write_recording

        paths.append(write_recording(run, camera, options.out / "recording.rrd"))
    if options.output.overlay:
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
            return [write_overlay(run, again, camera, path, fps, at=options.output.place, progress=not options.quiet)]
        except InputError as error:
            if options.output.place is not None:
                raise
            print(f"jaxtri: warning: no overlay: {error}", file=sys.stderr)
            return []


def _check(options: Track) -> None:
    """Numbers and words that no run can use, named before anything is opened."""
    least = {"features": 50, "overlap": 1, "max_frames": 1, "min_parallax": 0, "noise_px": 1e-6, "calibration_error": 0}
    given = options.flat()
    for name, low in least.items():
        if (value := given[name]) is not None and not low <= value < float("inf"):
            raise InputError(f"--{name.replace('_', '-')} {value:g}: give a number of at least {low:g}")
    for name, words in {"base": ("tracks", "inherit", "paper"), "starts": ("opencv", "poselib")}.items():
        if given[name] not in words:
            raise InputError(f"--{name} {given[name]}: choose one of {', '.join(words)}")
    if options.camera is None and (given["scale_camera"] or given["turn_camera"]):
        raise InputError("--scale-camera and --turn-camera change what --camera gives: give --camera FILE, too")
    if options.out.exists() and not options.out.is_dir():
        raise InputError(f"--out {options.out} is a file: give a folder")


def _camera(options: Track, source: "FrameSource", live: bool) -> tuple["Camera", float | None]:
    """The camera to begin with, and what is known of its focal length where it is to be estimated, as a share of it."""
    from jaxtri.formats import read_camera
    from jaxtri.geometry.camera import Camera
    from jaxtri.odometry.calibrate import GUESSED

    (w, h), more, refine = source.size, options.input, options.input.refine_camera
    if live and (refine or (options.camera is None and options.fov is None)):
        raise CameraError(
            "a live camera shows its frames once, so that it cannot be calibrated by them: give --camera FILE, or "
            "--fov DEGREES; or film a clip with it, track that, and give the camera.json that comes of it"
        )
    if options.camera is not None and options.fov is not None:
        raise CameraError("--camera and --fov both say the focal length: give one of them")
    if options.camera is not None:
        try:
            camera = read_camera(options.camera, width=w, height=h, scale=more.scale_camera, turn_deg=more.turn_camera)
        except CameraError as error:
            if source.turned_deg not in (90, 270) or more.turn_camera:
                raise
            said = f"give --turn-camera {source.turned_deg} if it was calibrated before that"
            raise CameraError(f"{error}; their orientation (EXIF or metadata) turns the images: {said}") from error
        return camera, FROM_FILE if refine else None
    fov, prior = options.fov, FROM_FOV if refine else None
    if fov is None:
        fov, prior = (USUAL, GUESSED) if source.field_of_view_deg is None else (source.field_of_view_deg, FROM_EXIF)
    camera = Camera.from_fov(fov, w, h)
    # The field of view is that of the width; what is stored in pixels that are no squares has another fy.
    return replace(camera, fy=camera.fx * source.pixel_aspect), prior


def _settings(options: Track, camera: "Camera", share: float | None = None) -> "Settings":
    """Those of a camera; `share` is what its focal length is estimated to, as a share of it."""
    from jaxtri.odometry.settings import CALIBRATED, Settings

    calibration = options.input.calibration_error
    if calibration is None:
        calibration = share or (CALIBRATED if options.fov is None else GUESS)
    return Settings.of(camera, noise_px=options.tracker.noise_px, calibration=calibration)


def _how(options: Track) -> dict[str, Any]:
    """The keyword arguments that `track`, `track_uncalibrated` and `warm_up` have in common."""
    from jaxtri.odometry.settings import Base, StartSettings
    from jaxtri.vision.klt import KLTSettings

    base, t = Base(options.filter.base), options.tracker
    changes = {} if t.min_parallax is None else {"parallax_deg": t.min_parallax}
    find = {"find_overlays": t.find_overlays, "find_dissolves": t.find_dissolves, "find_places": options.filter.loops}
    return {
        "base": base,
        "start": StartSettings.of(base, overlap=options.filter.overlap, poselib=t.starts == "poselib", **changes),
        "klt": KLTSettings(t.features, **find),
    }


def _evaluate(options: Evaluate) -> None:
    from jaxtri.formats import write_json
    from jaxtri.formats.trajectories import read_pair
    from jaxtri.output.report import errors_text
    from jaxtri.trajectory import evaluate

    found = evaluate(*read_pair(options.estimate, options.groundtruth, options.times), with_scale=options.scale)
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
    print(run_text(done.run, done.paths), "errors against the truth, in metres:", errors_text(done.errors), sep="\n")
    print(
        f"look at {options.out / 'trajectory.png'} and {options.out / 'overlay.mp4'}; the frames are in {done.frames}"
    )


if __name__ == "__main__":
    main()
