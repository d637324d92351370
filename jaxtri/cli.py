"""The command line: `jaxtri track`, `jaxtri evaluate`, `jaxtri demo`."""

import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxtri.errors import CameraError, InputError, JaxtriError, TruncatedVideoWarning


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
    recording: bool = False
    """Write recording.rrd for the rerun viewer (extra `viewer`)."""
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

    from jaxtri.compilation import keep_programs

    jax.config.update("jax_enable_x64", True)
    keep_programs()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", TruncatedVideoWarning)
            warnings.showwarning = _show
            {Track: _track, Evaluate: _evaluate, Demo: _demo}[type(command)](command)
    except (JaxtriError, OSError) as error:
        print(f"jaxtri: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, TruncatedVideoWarning):
        print(f"jaxtri: warning: {message}", file=sys.stderr)


def _track(options: Track) -> None:
    from jaxtri.pipeline import warm_up
    from jaxtri.results import write_overlay, write_results
    from jaxtri.vision.video import open_source, spool

    _check(options)
    base = _base(options.base)
    live = options.source.isdecimal() and not Path(options.source).exists()
    if live and options.max_frames is None:
        print("a camera runs on: stop with Ctrl-C, what was tracked is kept", file=sys.stderr)
    with open_source(options.source, fps=options.fps, strict=options.strict) as source:
        camera = _camera(options, source.size)
        if live:
            warm_up(camera, **_options(camera, base, options))
        frames: Any = spool(source, options.out / "frames") if live else source
        run = _run(frames, camera, base, options)
        fps = source.fps
    paths = write_results(
        run, options.out, {k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items()}
    )
    if options.recording:
        from jaxtri.vision.viewer import write_recording

        paths.append(write_recording(run, camera, options.out / "recording.rrd"))
    if options.overlay:
        again = options.out / "frames" if live else options.source
        with warnings.catch_warnings(), open_source(again, fps=options.fps) as source:
            warnings.simplefilter("ignore", TruncatedVideoWarning)  # said once already
            try:
                overlay = options.out / "overlay.mp4"
                paths.append(
                    write_overlay(run, source, camera, overlay, fps, at=options.place, progress=not options.quiet)
                )
            except InputError as error:
                if options.place is not None:
                    raise
                print(f"jaxtri: warning: no overlay: {error}", file=sys.stderr)
    _summarise(run, paths)


def _check(options: Track) -> None:
    """Numbers that no run can use, named before anything is opened."""
    least = {"features": 50, "overlap": 1, "max_frames": 1, "min_parallax": 0, "noise_px": 1e-6}
    for name, low in least.items():
        value = getattr(options, name)
        if value is not None and not low <= value < float("inf"):
            raise InputError(f"--{name.replace('_', '-')} {value:g}: give a number of at least {low:g}")


def _base(name: str) -> Any:
    from jaxtri.bases import Base

    try:
        return Base(name)
    except ValueError:
        raise InputError(f"--base {name}: choose one of {', '.join(b.value for b in Base)}") from None


def _camera(options: Track, size: tuple[int, int]) -> Any:
    from jaxtri.formats import read_camera
    from jaxtri.geometry.camera import Camera

    if options.camera is not None and options.fov is None:
        return read_camera(options.camera, width=size[0], height=size[1])
    if options.camera is not None or options.fov is None:
        raise CameraError("give the intrinsics: --camera FILE, or a guess of the field of view by --fov DEGREES")
    return Camera.from_fov(options.fov, *size)


def _run(frames: Any, camera: Any, base: Any, options: Track) -> Any:
    from jaxtri.pipeline import track

    progress = not options.quiet
    return track(frames, camera, progress=progress, max_frames=options.max_frames, **_options(camera, base, options))


def _options(camera: Any, base: Any, options: Track) -> dict[str, Any]:
    """The keyword arguments of `pipeline.track` and `pipeline.warm_up`."""
    from jaxtri.bases import StartSettings
    from jaxtri.tracker import Settings
    from jaxtri.vision.klt import KLTSettings

    changes = {} if options.min_parallax is None else {"parallax_deg": options.min_parallax}
    return {
        "base": base,
        "settings": Settings.of(camera, noise_px=options.noise_px),
        "start": StartSettings.of(base, overlap=options.overlap, **changes),
        "klt": KLTSettings(capacity=options.features),
    }


def _summarise(run: Any, paths: list[Path]) -> None:
    s = run.statistics
    states = ", ".join(f"{count} {name}" for name, count in s["status"].items())
    print(f"{s['frames']} frames at {s['frames_per_second']:.0f} a second: {states}")
    print(f"{s['keyframes']} keyframes, {s['points_used_per_frame']:.0f} points a frame, {len(run.points.ids)} in all")
    if s["scale_unknown_from_frame"] is not None:
        print(f"the camera was lost: from frame {s['scale_unknown_from_frame']} on the scale is a guess")
    if s["interrupted"]:
        print("interrupted: these are the frames up to there")
    for path in paths:
        print(f"  {path}")


def _evaluate(options: Evaluate) -> None:
    from jaxtri.formats import read_trajectory, write_json
    from jaxtri.trajectory import evaluate

    found = evaluate(read_trajectory(options.estimate), read_trajectory(options.groundtruth), with_scale=options.scale)
    _print_errors(found)
    if options.json is not None:
        write_json(options.json, asdict(found))


def _print_errors(found: Any) -> None:
    print(f"{found.matched} frames matched, {found.coverage:.1%} of the reference; scale {found.scale:.6g}")
    print(f"ATE  {found.ate_rmse:.6g} rmse, {found.ate_percent:.3f} % of the path")
    print(f"RPE  {found.rpe_translation:.6g} ({found.rpe_translation_percent:.2f} % of the mean step), ", end="")
    print(f"{found.rpe_rotation_deg:.4f} degrees a frame")
    print(f"orientation {found.rotation_rmse_deg:.4f} degrees rmse")


def _demo(options: Demo) -> None:
    from jaxtri.formats import read_tum
    from jaxtri.pipeline import warm_up
    from jaxtri.results import write_overlay, write_results
    from jaxtri.synthetic import laboratory
    from jaxtri.synthetic.rendered import write_footage
    from jaxtri.trajectory import evaluate
    from jaxtri.vision.video import open_source

    if options.frames < 2:
        raise InputError(f"--frames {options.frames}: a camera's motion needs at least two")
    folder = options.out / "sequence"
    print(f"rendering {options.frames} frames of a laboratory, the camera sliding sideways before some boxes")
    track, base = Track(str(folder), quiet=options.quiet), _base("tracks")
    footage = laboratory(options.frames, options.seed)
    with ThreadPoolExecutor(1) as pool:  # the filters compile while the frames are rendered
        ready = pool.submit(warm_up, footage.camera, **_options(footage.camera, base, track))
        camera = write_footage(folder, footage, options.seed, progress=not options.quiet)
        ready.result()
    truth = read_tum(folder / "groundtruth.txt")
    with open_source(folder) as source:
        run = _run(source, camera, base, track)
        fps = source.fps
    found = evaluate(run.trajectory, truth)
    run = run.scaled(found.scale)  # the gauge is known here: metres
    paths = write_results(run, options.out, asdict(options) | {"out": str(options.out)}, reference=truth)
    with open_source(folder) as source:
        overlay = options.out / "overlay.mp4"
        paths.append(write_overlay(run, source, camera, overlay, fps, progress=not options.quiet))
    _summarise(run, paths)
    print("errors against the truth, in metres:")
    _print_errors(found)
    print(f"look at {options.out / 'trajectory.png'} and {options.out / 'overlay.mp4'}; the frames are in {folder}")


if __name__ == "__main__":
    main()
