"""Does refinement of a long sequence cost time and memory in proportion to its length?

    python benchmarks/long_sequence.py

A camera slides past points that it never sees again, 2.4 new ones a frame; a track lives some 80 frames, and drifts
by 0.05 px a frame. Seconds of the tracker on given tracks and of `jaxtri.refine`, once compiled, the most memory that
the process had before and after it, and the errors.

Last answer (2 cores, JAX 0.10, float64; keyframes, looks, steps, seconds of tracking and of refinement, megabytes
before and after, ATE in % causal and refined):
    750 frames    189   57,943  4   48.5 1.60   1220 1343   .0077 .0054
    1,500         376  115,389  5   16.7 2.90   1347 1493   .0193 .0117
    3,000         751  230,899  5   29.0 6.17   1498 1720   .0159 .0132
The first row's tracking has the compilation in it. In another run 3,000 frames took 4.7 seconds.
"""

import resource
import sys
import time
from collections.abc import Iterator

import jax
import numpy as np
from contract import parser, report, table

jax.config.update("jax_enable_x64", True)

from jaxtri.geometry.camera import Camera  # noqa: E402
from jaxtri.odometry.driver import Odometry  # noqa: E402
from jaxtri.odometry.refine import refine  # noqa: E402
from jaxtri.trajectory import Trajectory, evaluate  # noqa: E402

LENGTHS = (750, 1500, 3000)
STEP, DRIFT_PX, PER_STEP = 0.04, 0.05, 2.4
F, WIDTH, HEIGHT = 500.0, 640, 480


def path(frames: int) -> np.ndarray:
    """Positions (frames, 3): to the right, swaying."""
    k = np.arange(frames)
    return np.stack([k * STEP, 0.1 * np.sin(k / 40), 0.1 * np.sin(k / 25)], axis=1)


def tracks(frames: int, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pixels (n, 2) that each frame shows, and the numbers of their tracks."""
    rng = np.random.default_rng(seed)
    length = frames * STEP
    count = int(frames * PER_STEP) + 400
    points = rng.uniform([-3, -1.5, 3], [length + 3, 1.5, 5], (count, 3))
    points = points[np.argsort(points[:, 0])]
    drift = np.zeros((count, 2))
    for position in path(frames):
        first, last = np.searchsorted(points[:, 0], position[0] + [-3.5, 3.5])
        X = points[first:last] - position
        pixels = F * X[:, :2] / X[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        seen = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        drift[first:last] += rng.normal(scale=DRIFT_PX, size=(last - first, 2))
        yield (pixels + drift[first:last])[seen], np.arange(first, last)[seen]


def most_memory() -> float:
    """Megabytes that this process had at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def main() -> None:
    args = parser("Does refinement of a long sequence cost in proportion to its length?").parse_args()
    camera = Camera.from_parameters(F, F, WIDTH / 2, HEIGHT / 2, width=WIDTH, height=HEIGHT)
    rows, figures = [], {}
    for frames in LENGTHS[:1] if args.quick else LENGTHS:
        odometry = Odometry(camera, record=True, capacity=512)
        begun = time.perf_counter()
        for k, (pixels, ids) in enumerate(tracks(frames, args.seed)):
            odometry.add(pixels, np.ones(len(ids), bool), float(k), ids=ids)
        odometry.finish()
        followed, before = time.perf_counter() - begun, most_memory()
        refine(odometry)  # compiles
        begun = time.perf_counter()
        found = refine(odometry)
        seconds = time.perf_counter() - begun
        T = np.tile(np.eye(4), (frames, 1, 1))
        T[:, :3, 3] = path(frames)
        truth = Trajectory(np.arange(frames, dtype=float), T)
        ates = [evaluate(t, truth).ate_percent for t in (odometry.trajectory(), found.trajectory())]
        part = found.statistics["parts"][0]  # pyright: ignore[reportIndexIssue]
        numbers = [part[k] for k in ("keyframes", "tracks", "observations", "steps")]
        memory = [f"{m:.0f}" for m in (before, most_memory())]
        rows.append([frames, *numbers, f"{followed:.1f}", f"{seconds:.2f}", *memory, *(f"{a:.4f}" for a in ates)])
        figures |= {f"{frames}.refine_s": seconds, f"{frames}.track_s": followed, f"{frames}.memory_mb": most_memory()}
        figures |= {f"{frames}.ate": ates[0], f"{frames}.refined_ate": ates[1]}
    head = ["frames", "keyframes", "tracks", "looks", "steps", "tracking s", "refinement s", "MB before", "MB after"]
    print(table([*head, "ATE %", "refined ATE %"], rows))
    report(args.json, figures)


if __name__ == "__main__":
    main()
