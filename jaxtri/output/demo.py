"""The main job on a rendered scene with exact truth."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from jaxtri.formats import read_tum
from jaxtri.odometry.run import Run, track, warm_up
from jaxtri.output.results import write_overlay, write_results
from jaxtri.synthetic import laboratory
from jaxtri.synthetic.rendered import write_footage
from jaxtri.trajectory import Evaluation, evaluate
from jaxtri.vision.video import open_source


class Demo(NamedTuple):
    """A run in metres, its errors, the files that were written and the folder of the frames."""

    run: Run
    errors: Evaluation
    paths: list[Path]
    frames: Path


def demo(out: Path, said: Mapping[str, object], *, frames: int = 100, seed: int = 0, progress: bool = True) -> Demo:
    """Render the laboratory into a folder of `out`, track it, and write the results beside it.

    `said` is what `run.json` keeps as the settings; `seed` is of the noise in the images.
    """
    folder = out / "sequence"
    footage = laboratory(frames, seed)
    with ThreadPoolExecutor(1) as pool:  # the filters compile while the frames are rendered
        ready = pool.submit(warm_up, footage.camera, refine=True)
        camera = write_footage(folder, footage, seed, progress=progress)
        ready.result()
    truth = read_tum(folder / "groundtruth.txt")
    with open_source(folder) as source:
        run = track(source, camera, progress=progress, refine=True)
        fps = source.fps
    errors = evaluate(run.trajectory, truth)
    run = run.scaled(errors.scale)  # the gauge is known here: metres
    paths = write_results(run, out, said, reference=truth)
    with open_source(folder) as source:
        paths.append(write_overlay(run, source, camera, out / "overlay.mp4", fps, progress=progress))
    return Demo(run, errors, paths, folder)
