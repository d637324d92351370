"""What does one more frame cost, and how does it grow with the number of points? The paper's table II.

    python benchmarks/paper_table_2.py

Time of a frame after the first ten, in a hot scan, all filters in turn within each round: medians over the
rounds of the ratios to the pose-only filter. Upper table: ours as shipped and the others with the same
passes. Lower table: one pass each, as published. Then the growth with the number of points: the slope of log
time against log N.

Last answer (2 idle cores, JAX 0.10, float64; over the pose alone, in brackets the paper): pose and structure 1.38
(1.07), A-P 97 (1.67), two-step 2.4 (.27); as published 1.61, 96, 1.67. Pose in `consistent` mode 7.8, from 2, 4 and 8
base frames 5.6, 9.0, 19. The pose alone takes .65 ms: since it is filtered by moments it is two to four times faster,
and the others are as they were. Growth N^.5 (pose), N^.6 to N^.8, A-P N^2.3, up to N = 3000 (A-P 1000).
"""

import time

import jax
import numpy as np
from contract import parser, plot_growth, report, table
from jaxtyping import Array
from paper_filters import Trials, draw, start_of
from tqdm import tqdm

jax.config.update("jax_enable_x64", True)

# Names of the figures, methods of `paper_filters`, the paper's seconds.
SHIPPED = {"pose": "pose", "pose_and_structure": "default", "ap": "ap_good", "two_step": "two_step_good"}
MORE = {"consistent": "consistent_pose", "bases2": "bases2", "bases4": "bases4", "bases8": "bases8"}  # not the paper's
PUBLISHED = {"pose": "paper_pose", "pose_and_structure": "paper", "ap": "ap_classic", "two_step": "two_step_classic"}
SECONDS = {"pose": 1.56, "pose_and_structure": 1.67, "ap": 2.60, "two_step": 0.42}
LABELS = {
    "pose": "pose",
    "pose_and_structure": "pose and structure",
    "ap": "A-P",
    "two_step": "two-step",
    "consistent": "pose, `consistent` mode",
    "bases2": "2 base frames",
    "bases4": "4 base frames",
    "bases8": "8 base frames",
}
CHUNK = 10  # frames in one call


class Clock:
    """A filter that has seen ten frames, ready to be timed over the next ones, ten at a time."""

    def __init__(self, trials: Trials, method: str, n: int) -> None:
        e, view = jax.tree.map(lambda x: x[0], trials)
        e = e._replace(points=e.points[:n], clean=e.clean[:, :n], observed=e.observed[:, :n])
        f = start_of(e, view, method)

        def advance(carry: object, observed: Array) -> object:
            return jax.lax.scan(lambda c, z: (f.step(c, z)[0], None), carry, observed)[0]

        self.observed, self.seen = f.observed, 0
        self.run = jax.jit(advance)
        # Weakly typed scalars would compile twice.
        self.carry = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), f.carry)
        self()

    def __call__(self) -> float:
        """Seconds a frame; the last ten frames again and again once the sequence is at its end."""
        last = len(self.observed) // CHUNK - 1
        at = min(self.seen, last) * CHUNK
        began = time.perf_counter()
        carry = jax.block_until_ready(self.run(self.carry, self.observed[at : at + CHUNK]))
        seconds = (time.perf_counter() - began) / CHUNK
        if self.seen < last:
            self.carry, self.seen = carry, self.seen + 1
        return seconds


def measure(trials: Trials, methods: dict[str, str], n: int, rounds: int) -> dict[str, np.ndarray]:
    """Seconds a frame of each method in each round, interleaved."""
    clocks = {name: Clock(trials, method, n) for name, method in methods.items()}
    times = {name: [] for name in methods}
    for _ in range(rounds):
        for name, clock in clocks.items():
            times[name].append(clock())
    return {name: np.array(x) for name, x in times.items()}


def main() -> None:
    args = parser(__doc__.splitlines()[0] if __doc__ else "").parse_args()
    began = time.perf_counter()
    n, rounds = (100, 4) if args.quick else (300, 24)
    sizes = (30, 100, 300, 1000, 3000)
    trials = draw(args.seed, 1, n_points=n if args.quick else sizes[-1])
    figures: dict[str, float] = {}
    tables = (
        ("as shipped", SHIPPED if args.quick else SHIPPED | MORE, ""),
        ("as published, one pass", PUBLISHED, "published_"),
    )
    for title, methods, prefix in tables[:1] if args.quick else tables:
        times = measure(trials, methods, n, rounds)
        rows = []
        for name, x in times.items():
            ratio = float(np.median(x / times["pose"]))
            figures[prefix + name] = ratio
            figures[f"{prefix}{name}_ms"] = 1e3 * float(np.median(x))
            paper = [f"{SECONDS[name]:.2f}", f"{SECONDS[name] / SECONDS['pose']:.2f}"] if name in SECONDS else ["", ""]
            rows.append([LABELS[name], f"{1e3 * np.median(x):.3f}", f"{ratio:.2f}", *paper])
        print(f"\nOne more frame, N = {n}, {title}\n")
        print(table(["", "ms", "over pose", "the paper [s]", "over pose"], rows) + "\n", flush=True)

    growth = {} if args.quick else measure_growth(trials, sizes)
    if growth:
        rows = []
        for name, x in growth.items():
            last = [k for k in x if k >= sizes[-1] / 30]
            slope = np.polyfit(np.log(last), np.log([x[k] for k in last]), 1)[0]
            figures |= {f"{name}_ms_n{k}": 1e3 * v for k, v in x.items()} | {f"{name}_growth": float(slope)}
            rows.append([LABELS[name], *(f"{1e3 * x[k]:.2f}" if k in x else "" for k in sizes), f"N^{slope:.2f}"])
        print("Growth: ms a frame, as shipped. The paper claims O(N^2) time and O(N) storage for ours (it inverts the")
        print("2N x 2N innovation, which is never formed here), O(N^3) and O(N^2) for A-P.\n")
        print(table(["", *(f"N = {k}" for k in sizes), "slope"], rows))
    print(f"\n{time.perf_counter() - began:.0f} s")
    report(args.json, figures)
    if args.plots is not None and growth:
        curves = {LABELS[name]: {n: 1e3 * v for n, v in x.items()} for name, x in growth.items()}
        plot_growth(curves, "time of one more frame [ms]", args.plots / "table_2.png")


def measure_growth(trials: Trials, sizes: tuple[int, ...]) -> dict[str, dict[int, float]]:
    """Seconds a frame of each method with each number of points."""
    methods = SHIPPED | {"consistent": MORE["consistent"], "bases8": MORE["bases8"]}
    growth: dict[str, dict[int, float]] = {name: {} for name in methods}
    for size in tqdm(sizes, desc="growth", leave=False, disable=None):
        for name, method in methods.items():
            if name == "ap" and size > 1000:
                continue  # 3000 points: a covariance of 72 MB and minutes a frame
            times = measure(trials, {name: method}, size, 2 if name == "ap" and size == 1000 else 5)
            growth[name][size] = float(np.median(times[name]))
    return growth


if __name__ == "__main__":
    main()
