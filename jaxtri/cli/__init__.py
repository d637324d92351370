"""The command line: `jaxtri check`, `jaxtri track`, `jaxtri evaluate`, `jaxtri demo`."""

import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from jaxtri.cli.cameras import begin_camera, settings_of
from jaxtri.cli.options import Check, Command, Demo, Evaluate, Track
from jaxtri.errors import InputError, InputWarning, JaxtriError

# The rest is imported where it is called: help and a wrong option need not wait for it.
if TYPE_CHECKING:
    from jaxtri.geometry.camera import Camera
    from jaxtri.vision.video import FrameSource


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
        camera, prior = begin_camera(options, source, live)
        if not live:
            read = (options.source, options.camera, options.mask)
            written = FILES if prior is None else (*FILES, CAMERA, FOCAL)
            spare(options.out, [Path(p) for p in read if p is not None], source.folder, written)
        how, fps = _how(options), source.fps
        refine = options.tracker.refine and not live
        more = {"progress": not options.quiet, "max_frames": options.max_frames, "refine": refine}
        if prior is None:
            how |= {"settings": settings_of(options, camera)}
            if live:
                warm_up(camera, **how)
            frames: Any = spool(source, options.out / "frames") if live else source
            run = track(frames, camera, **more, **how)
        else:
            how |= {"settings": lambda camera, share: settings_of(options, camera, share)}
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
    least = {
        "features": 50,
        "overlap": 1,
        "max_frames": 1,
        "min_parallax": 0,
        "noise_px": 1e-6,
        "calibration_error": 0,
        "readout": 0,
    }
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


def _how(options: Track) -> dict[str, Any]:
    """The keyword arguments that `track`, `track_uncalibrated` and `warm_up` have in common."""
    from jaxtri.odometry.settings import Base, StartSettings
    from jaxtri.vision.klt import KLTSettings

    t, base = options.tracker, Base(options.tracker.base)
    changes = {} if t.min_parallax is None else {"parallax_deg": t.min_parallax}
    find = {"find_overlays": t.find_overlays, "find_dissolves": t.find_dissolves, "find_places": options.tracker.loops}
    return {
        "base": base,
        "start": StartSettings.of(base, overlap=options.tracker.overlap, poselib=t.starts == "poselib", **changes),
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
