"""What does a frame of the filter cost, over the same update written in C++?

    OPENBLAS_NUM_THREADS=1 python benchmarks/speed.py --plots out

91 frames of the paper's experiment after the base pair, float64. `scan` and `step` are one pass with constant noise,
the update of `reference.cpp`, which the system's compiler builds; `default` is the default mode, four passes with the
noise of the base points. `scan` and `default` are one call for all frames, `step` is a call a frame from Python. All
run in turns; ratios are medians over the rounds. The answer is checked against the plain form, which takes every
item's own Jacobian, and against C++.

`batch` rows are 16 noise settings over one sequence, a run of them over a run alone: one after the other, four or all
at once.

Last answer (2 idle cores, JAX 0.10; N = 30, 100, 300, 1,000, 3,000, 10,000): scan 7.3, 6.9, 6.1, 5.3, 3.0, 2.2 times
C++ (3 asked at 300; C++ 30 us), step 25, 22, 14, 9.0, 4.1, 2.2 times (9 asked at 300), answers apart by 2e-12;
`default` 2.9 times a single pass (4), pose and bank 1.53 times pose (1.2), eight base frames 31 times; 10,000 points
8.2 times 300 (17), growing from 1,000 with N^.68 (1.05). A run of a batch costs .93, 1.17, .84 (N = 30) and .81, .87,
.76 (300) of one alone; in an earlier run .88, 1.39, 1.02 and .94, .95, .77.
"""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from contract import in_turns, parser, plot_growth, report, table
from gradient_cost import sequence
from paper_filters import draw, start_of
from tqdm import tqdm

jax.config.update("jax_enable_x64", True)

from jaxtri.filters import ekf  # noqa: E402
from jaxtri.filters.scan import batch  # noqa: E402
from jaxtri.geometry.pose import rotation_matrix  # noqa: E402
from jaxtri.models.trifocal import Trifocal, TrifocalState, start  # noqa: E402

SIZES = (30, 100, 300, 1000, 3000, 10000)
FRAMES = 91
BATCH = 16  # runs
NOISE = (1.7e-4, 0.015, 0.02)  # sigma, acceleration, angular acceleration


class Plain(eqx.Module):
    """A model without its moment form: each item is linearised on its own."""

    model: Trifocal

    def __getattr__(self, name: str) -> object:
        if name in ("matrix", "coordinates", "spread", "support"):
            raise AttributeError(name)
        return getattr(object.__getattribute__(self, "model"), name)


class Answer(NamedTuple):
    """Poses and covariances of all frames."""

    translation: np.ndarray  # (t, 3)
    rotation: np.ndarray  # (t, 3, 3)
    covariance: np.ndarray  # (t, 18, 18)


class Problem:
    """A sequence, with the filters that are to run over it."""

    def __init__(self, seed: int, points: int) -> None:
        self.points, data = points, sequence(seed, points, FRAMES + 2)
        self.observed, self.view = data.observed[2:], data.view
        self.pairs = jnp.concatenate([data.observed[0], data.observed[1]], axis=-1)
        self.seen = jnp.ones(self.observed.shape[:2], bool)
        self.belief = start(self.view, velocity_sd=0.02, angular_velocity_sd=0.02)

    def model(self, base_noise: bool) -> Trifocal:
        """Of the filter; without `base_noise` that of C++."""
        sigma, acceleration, angular = map(jnp.asarray, NOISE)
        return Trifocal(sigma, acceleration, angular, jnp.zeros(()), self.view.translation, base_noise=base_noise)

    def scan(self, passes: int, base_noise: bool, plain: bool = False) -> Callable[[], ekf.Belief[TrifocalState]]:
        """All frames in one call."""
        model: Any = Plain(self.model(base_noise)) if plain else self.model(base_noise)
        run = jax.jit(lambda b, z, seen: ekf.filter(model, b, self.pairs, z, seen, passes=passes)[0])
        return partial(run, self.belief, self.observed, self.seen)

    def step(self) -> Callable[[], ekf.Belief[TrifocalState]]:
        """A call a frame."""
        model, mask = self.model(False), self.seen[0]
        items = jax.jit(ekf.prepare)(model, self.pairs, mask)
        step = jax.jit(lambda b, z: ekf.step(model, b, items, z, mask, passes=1)[0])
        frames = list(self.observed)

        def run() -> ekf.Belief[TrifocalState]:
            belief = self.belief
            for z in frames:
                belief = step(belief, z)
            return belief

        return run

    def reference(self, library: ctypes.CDLL) -> Callable[[], Answer]:
        """The same in C++."""
        motion, n = self.belief.mean.motion, self.points
        state = (motion.translation, motion.velocity, motion.R, motion.angular_velocity)
        base = (
            self.belief.mean.base_translation,
            rotation_matrix(self.belief.mean.base_rotation),
            self.belief.covariance,
        )
        begun = np.concatenate([np.ravel(x) for x in (*state, *base)])
        observed = np.ascontiguousarray(np.swapaxes(self.observed, 1, 2))
        pairs, epipole = np.ascontiguousarray(self.pairs.T), np.array(self.view.translation)
        answer = Answer(np.empty((FRAMES, 3)), np.empty((FRAMES, 3, 3)), np.empty((FRAMES, 18, 18)))
        work = np.empty(26 * n)

        def run() -> Answer:
            arrays = (observed, pairs, epipole, begun.copy(), *answer, work)
            o, p, e, *rest = (ctypes.c_void_p(x.ctypes.data) for x in arrays)
            library.run(FRAMES, n, o, p, e, *map(ctypes.c_double, NOISE), *rest)
            return answer

        return run

    def batch(self, size: int) -> Callable[[], Any]:
        """`scan` under `BATCH` noise settings, the points shared."""

        def run(sigma: jax.Array) -> jax.Array:
            model = eqx.tree_at(lambda m: m.sigma, self.model(False), sigma)
            says = ekf.filter(model, self.belief, self.pairs, self.observed, self.seen, passes=1)[1]
            return jnp.sum(says.log_likelihood)

        return partial(jax.jit(lambda x: batch(run, x, size)), NOISE[0] * jnp.linspace(0.5, 2, BATCH))


def answer(beliefs: ekf.Belief[TrifocalState]) -> Answer:
    """Of our filter."""
    motion = beliefs.mean.motion
    found = motion.translation, jax.vmap(lambda m: m.R)(motion), beliefs.covariance
    return Answer(*map(np.asarray, found))


def build(folder: Path) -> ctypes.CDLL | None:
    """The reference, compiled; None with a notice where there is no compiler."""
    compiler = next((c for c in ("c++", "g++", "clang++") if shutil.which(c)), None)
    if compiler is None:
        print("no C++ compiler here: the rows over C++ are left out")
        return None
    source, library = Path(__file__).with_name("reference.cpp"), folder / "reference.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "-o", str(library), str(source)], check=True)
    return ctypes.CDLL(str(library))


def difference(a: Answer, b: Answer) -> float:
    """Largest difference of the poses."""
    return float(max(np.abs(x - y).max() for x, y in zip(a[:2], b[:2], strict=True)))


def beside(seed: int, points: int, rounds: int) -> dict[str, float]:
    """The bank and eight base frames, over the default pose filter."""
    trials = draw(seed, 1, n_points=points, n_frames=FRAMES + 2)
    e, view = jax.tree.map(lambda x: x[0], trials)
    runs = {}
    for method in ("pose", "default", "bases8"):
        f = start_of(e, view, method)
        run = jax.jit(lambda carry, z, step=f.step: jax.lax.scan(lambda c, z: (step(c, z)[0], None), carry, z)[0])
        runs[method] = partial(run, f.carry, f.observed[-FRAMES:])
    seconds = in_turns(runs, rounds)
    return {
        f"pose_and_bank_over_pose_n{points}": float(np.median(seconds["default"] / seconds["pose"])),
        f"bases8_over_default_n{points}": float(np.median(seconds["bases8"] / seconds["pose"])),
    }


def in_batches(seed: int, points: int, rounds: int) -> dict[str, float]:
    """A run of a batch, over a run alone: one after the other, four at once, all at once."""
    problem = Problem(seed, points)
    runs: dict[str, Callable[[], Any]] = {f"batch{size}": problem.batch(size) for size in (1, 4, BATCH)}
    seconds = in_turns({"alone": problem.scan(1, False), **runs}, rounds)
    return {f"{k}_over_scan_n{points}": float(np.median(seconds[k] / seconds["alone"])) / BATCH for k in runs}


def main() -> None:
    args = parser("What does a frame of the filter cost, over the same update written in C++?").parse_args()
    sizes, rounds = ((30, 300), 5) if args.quick else (SIZES, 25)
    figures: dict[str, float] = {}
    micro: dict[str, dict[int, float]] = {"C++": {}, "scan": {}, "step": {}, "default": {}}
    rows, worst = [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        library = build(Path(folder))
        for n in tqdm(sizes, leave=False, disable=None):
            problem = Problem(args.seed, n)
            runs: dict[str, Callable[[], Any]] = {}
            if library is not None:
                runs["C++"] = problem.reference(library)
            runs |= {"scan": problem.scan(1, False), "step": problem.step(), "default": problem.scan(4, True)}
            seconds = in_turns(runs, max(3, rounds // 5) if n > 1000 else rounds)
            ours = answer(runs["scan"]())
            P = ours.covariance
            assert np.linalg.eigvalsh(P).min() > -1e-9 * P.max()
            if n <= 1000:
                off = [difference(ours, answer(problem.scan(1, False, plain=True)()))]
                off += [difference(ours, runs["C++"]())] if library is not None else []
                worst = max(worst, *off)
            for name, x in seconds.items():
                micro[name][n] = 1e6 * float(np.median(x)) / FRAMES
            if library is not None:
                for name in ("scan", "step"):
                    figures[f"{name}_over_cpp_n{n}"] = float(np.median(seconds[name] / seconds["C++"]))
            if n == 300:
                figures["default_over_single_pass_n300"] = float(np.median(seconds["default"] / seconds["scan"]))
                figures["scan_frames_per_s_n300"] = float(FRAMES / np.median(seconds["scan"]))
            over = [f"{figures.get(f'{name}_over_cpp_n{n}', float('nan')):.1f}" for name in ("scan", "step")]
            rows.append([n, *(f"{micro[name].get(n, float('nan')):.1f}" for name in micro), *over])
    figures["answer_difference"] = worst
    if {300, 10000} <= set(sizes):
        figures["t10000_over_t300"] = micro["scan"][10000] / micro["scan"][300]
    print("\nmicroseconds a frame\n" + table(["N", *micro, "scan / C++", "step / C++"], rows))
    if not args.quick:
        for n in (30, 300):
            figures |= in_batches(args.seed, n, rounds // 3)
        figures |= beside(args.seed, 300, rounds)
    print("\n" + table(["", ""], [[k, f"{v:.3g}"] for k, v in figures.items() if "over_cpp" not in k]))
    if args.plots is not None:
        plot_growth({k: v for k, v in micro.items() if v}, "a frame [us]", args.plots / "speed.png")
    report(args.json, figures)


if __name__ == "__main__":
    main()
