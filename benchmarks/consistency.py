"""Does each filter know how good it is? NEES, NIS and coverage over time, by motion, noise and points.

    OPENBLAS_NUM_THREADS=1 python benchmarks/consistency.py --plots out

A trial is 300 points over 99 frames, 0.1 px at f = 600 px, unless its name says otherwise. `paper` is the
paper's experiment, started from frames 0 and 1 (0 and 3 where it is `wide`); in the others the camera moves
steadily, but for jitter, and starts once the base line has some length. NEES: 6 is right. Coverage: share of
the poses inside the 95 % region. Bounds: Cramer-Rao, from the first 30 trials; that of the translation is
across it, which the gauge of the scale leaves alone. The published filters: A-P with 60 points.

Last answer (2 cores, JAX 0.10, 200 trials, --seed 0; rotation over the bound, NEES with its extremes at every
tenth frame, coverage; an hour with other load):
                    default                      consistent
    paper           1.48  6.3 (5.9-7.1)  .939    1.42  6.3 (6.0-6.9)   .938
    sideways        2.57  7.3 (6.8-7.5)  .892    2.04  6.8 (5.8-10.8)  .915
    forward         1.15  7.0 (6.6-7.3)  .905    1.15  7.0 (6.1-8.5)   .902
    orbit           2.73  6.8 (6.1-7.3)  .911    2.37  6.2 (5.7-6.8)   .938
    rotation        1.99  8.2 (7.4-8.6)  .850    1.51  6.0 (5.7-6.3)   .951
    30 points       1.68  6.2 (5.7-7.0)  .944    1.68  8.9 (5.9-14.5)  .846
    30 points, wide 1.49  6.4 (6.0-7.1)  .934    1.27  6.4 (6.0-7.1)   .933
    1 px            1.70  7.1 (6.4-7.8)  .899    1.65  8.3 (6.2-10.5)  .891
    1 px, wide      1.35  6.4 (6.0-7.2)  .938    1.28  6.6 (6.0-7.4)   .925
In float32: consistent .937. NIS per component: 1.0 in the steady motions, 1.1 in `paper` (1.7 with 30 points), whose
displacements are drawn anew in every frame, which no constant velocity foretells.

    bases8          R     T     NEES                coverage
    paper           1.07  1.02  6.4 (5.9-7.2)       .929
    sideways        1.45  1.07  7.2 (5.8-11.2)      .894
    forward         1.04  1.04  6.3 (6.1-6.7)       .940
    orbit           1.43  1.24  8.3 (5.8-13.8)      .838
    rotation        1.55  1.18  6.3 (5.7-7.2)       .933
    30 points       1.12  1.01  9.5 (5.8-17.2)      .809
    30 points, wide 1.12  1.08  6.8 (6.0-7.8)       .918
    1 px            1.16  1.08  11.8 (6.1-22.6)     .761
    1 px, wide      1.05  1.00  6.7 (6.2-7.7)       .917
Over-confident all: `paper` mode R 1.7 to 27, coverage .00 to .06; `two_step_good` R 1.3 to 26, .002 to .24. `ap_good`,
with 60 points: paper 1.10, .848; forward 1.08, .861; sideways 2.08, .283; orbit 1.82, .327; rotation 1.58, .449.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from contract import parser, report, table
from jaxlie import SO3
from matplotlib.ticker import NullFormatter
from paper_filters import NAMES, STYLES, Trials, over_trials, pose_errors, run
from scipy.stats import chi2
from tqdm import tqdm

jax.config.update("jax_enable_x64", True)

from jaxtri.estimation.bound import filtering_bound  # noqa: E402
from jaxtri.estimation.two_view import TwoView, refine  # noqa: E402
from jaxtri.formats import atomic_path  # noqa: E402
from jaxtri.synthetic import Experiment, paper_experiment, steady_experiment  # noqa: E402

MODES = ("default", "consistent", "bases8", "paper", "two_step_good", "ap_good")
INSIDE = float(chi2.ppf(0.95, 6))
BOUND_TRIALS = 30
AP_POINTS = 60  # the full-covariance filter costs O(N^3): fewer points, the bound is theirs


class Case(NamedTuple):
    """Trials of one kind; the second base frame is number `second`."""

    draw: Callable[..., Experiment]
    second: int
    points: int = 300
    noise_px: float = 0.1
    single: bool = False  # float32
    modes: tuple[str, ...] = MODES


OURS = ("default", "consistent", "bases8")
CASES = {
    "paper": Case(paper_experiment, 1),
    "sideways": Case(partial(steady_experiment, metres_per_frame=(0.01, 0.0, 0.0)), 3),
    "forward": Case(partial(steady_experiment, metres_per_frame=(0.0, 0.0, 0.01)), 12),
    "orbit": Case(partial(steady_experiment, degrees_per_frame=(0.0, 0.7, 0.0), orbit=True), 3),
    "rotation": Case(
        partial(steady_experiment, metres_per_frame=(0.001, 0.0, 0.0), degrees_per_frame=(0.0, 0.25, 0.0)), 20
    ),
    "paper_30_points": Case(paper_experiment, 1, points=30, modes=OURS),
    "paper_30_points_wide": Case(paper_experiment, 3, points=30, modes=OURS),
    "paper_1px": Case(paper_experiment, 1, noise_px=1.0, modes=OURS),
    "paper_1px_wide": Case(paper_experiment, 3, noise_px=1.0, modes=OURS),
    "paper_float32": Case(paper_experiment, 1, single=True, modes=OURS),
}


def draw(case: Case, seed: int, count: int, points: int, frames: int) -> Trials:
    """Trials without the frames between the first two base frames, whose base line has its true length (the gauge)."""

    def one(key: jax.Array) -> Trials:
        e = case.draw(key, n_points=points, n_frames=frames, noise_px=case.noise_px)
        kept = jnp.concatenate([jnp.zeros(1, int), jnp.arange(case.second, frames)])
        e = Experiment(e.points, e.rotations[kept], e.translations[kept], e.clean[kept], e.observed[kept], e.sigma)
        R = SO3.from_matrix(e.rotations[1])
        everything = jnp.ones(points, bool)
        return Trials(e, refine(e.translations[1], R, e.observed[0], e.observed[1], everything, e.sigma))

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), count))


def one(e: Experiment, view: TwoView, method: str, frames: float, single: bool) -> dict[str, Any]:
    """Errors of one trial, a figure per frame: NEES, radians, and metres across the translation."""
    seen = (e, view)
    if single:
        seen = jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, seen)
    estimate = jax.tree.map(lambda x: x.astype(jnp.float64), run(seen[0], seen[1], method, frames))
    between, shift, nees = pose_errors(e, estimate)
    T = e.translations[2:]
    along = T / jnp.linalg.norm(T, axis=-1, keepdims=True)
    across = shift - along * jnp.sum(shift * along, axis=-1, keepdims=True)
    return {
        "nees": nees,
        "nis": estimate.nis,
        "rotation": jnp.linalg.norm(between, axis=-1),
        "translation": jnp.linalg.norm(shift, axis=-1),
        "across": jnp.linalg.norm(across, axis=-1),
    }


def bound(e: Experiment, _: TwoView, frames: jax.Array) -> dict[str, jax.Array]:
    """Root mean square errors of the best unbiased filter, in the frames given."""
    C = filtering_bound(e.points, e.rotations, e.translations, e.sigma, frames=frames)
    along = e.translations[frames] / jnp.linalg.norm(e.translations[frames], axis=-1, keepdims=True)
    across = jnp.trace(C[:, :3, :3], axis1=1, axis2=2) - jnp.einsum("ti,tij,tj->t", along, C[:, :3, :3], along)
    return {"rotation": jnp.sqrt(jnp.trace(C[:, 3:, 3:], axis1=1, axis2=2)), "across": jnp.sqrt(across)}


def rms(x: np.ndarray) -> np.ndarray:
    """Root mean square over the trials."""
    return np.sqrt(np.mean(x**2, axis=0))


def interval(x: np.ndarray) -> float:
    """Half width of the 95 % interval of a mean over trials; the frames of a trial are not independent."""
    return float(1.96 * x.mean(axis=1).std() / np.sqrt(len(x)))


def main() -> None:
    p = parser(__doc__.splitlines()[0] if __doc__ else "", trials=200)
    p.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    p.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    args = p.parse_args()
    began = time.perf_counter()
    figures: dict[str, float] = {}
    cases = args.cases if not args.quick else ["paper"]
    modes = args.modes if not args.quick else ["default", "consistent"]
    for name in tqdm(cases, desc="cases", disable=None):
        case = CASES[name]
        rows, found = [], {}
        count, frames = (min(args.trials, 3), 33) if args.quick else (args.trials, 99)
        for mode in (m for m in case.modes if m in modes):
            points = min(case.points, AP_POINTS) if mode == "ap_good" else case.points
            trials = draw(case, args.seed, count, points, frames)
            x = over_trials(partial(one, method=mode, frames=float(case.second), single=case.single), trials, mode)
            at = jnp.arange(2, trials.experiment.observed.shape[1], 8)
            few = jax.tree.map(lambda x: x[:BOUND_TRIALS], trials)
            if (points, "bound") not in found:
                found[points, "bound"] = over_trials(partial(bound, frames=at), few, "bound")
            best = found[points, "bound"]
            found[mode] = x
            rows.append(_row(name, mode, x, best, np.asarray(at) - 2, figures))
        if not rows:
            continue
        head = ["", "geodesic", "R / bound", "T / bound", "NEES", "every 10th", "NIS", "coverage", "+-", "lost"]
        print(f"\n{name}: {count} trials, seed {args.seed}\n" + table(head, rows), flush=True)
        if args.plots is not None:
            plot(name, {k: v for k, v in found.items() if isinstance(k, str)}, args.plots)
    print(f"\n{time.perf_counter() - began:.0f} s")
    report(args.json, figures)


def _row(
    case: str,
    mode: str,
    x: dict[str, np.ndarray],
    best: dict[str, np.ndarray],
    at: np.ndarray,
    figures: dict[str, float],
) -> list[str]:
    lost = ~(x["rotation"].mean(axis=1) < np.deg2rad(10))
    kept = {k: v[~lost] for k, v in x.items()}
    covered = (x["nees"] < INSIDE) & (x["nees"] >= 0)  # a lost trial counts against
    few = len(best["rotation"])
    over = {k: np.median(rms(x[k][:few])[at] / rms(best[k])) for k in ("rotation", "across")}
    nees = kept["nees"].mean(axis=0)
    key = f"{mode}.{case}"
    figures |= {
        f"{key}.nees": float(nees.mean()),
        f"{key}.nis_per_dof": float(kept["nis"].mean()),
        f"{key}.nees_lowest": float(nees[::10].min()),
        f"{key}.nees_highest": float(nees[::10].max()),
        f"{key}.coverage": float(covered.mean()),
        f"{key}.coverage_interval": interval(covered),
        f"{key}.geodesic_deg": float(np.rad2deg(kept["rotation"].mean())),
        f"{key}.rotation_over_bound": float(over["rotation"]),
        f"{key}.translation_over_bound": float(over["across"]),
        f"{key}.lost": float(lost.mean()),
    }
    f = figures
    return [
        NAMES[mode],
        f"{f[f'{key}.geodesic_deg']:.4f}",
        f"{over['rotation']:.2f}",
        f"{over['across']:.2f}",
        f"{nees.mean():.3g}",
        f"{nees[::10].min():.3g} to {nees[::10].max():.3g}",
        f"{f[f'{key}.nis_per_dof']:.2f}",
        f"{covered.mean():.3f}",
        f"{interval(covered):.3f}",
        f"{int(lost.sum())}",
    ]


def plot(case: str, found: dict[str, dict[str, np.ndarray]], out: Path) -> None:
    """NEES and coverage over time, with the intervals that a consistent filter would stay in."""
    out.mkdir(parents=True, exist_ok=True)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for mode, x in found.items():
        colour, line, marker = STYLES[mode]
        t = np.arange(2, 2 + x["nees"].shape[1])
        style = {"color": colour, "linestyle": line, "marker": marker, "markevery": 12, "markersize": 5, "lw": 1.3}
        left.semilogy(t, np.nanmean(x["nees"], axis=0), label=NAMES[mode], **style)
        right.plot(t, ((x["nees"] < INSIDE) & (x["nees"] >= 0)).mean(axis=0), **style)
    count = len(next(iter(found.values()))["nees"])
    low, high = chi2.ppf([0.025, 0.975], 6 * count) / count
    left.axhspan(low, high, color="0.85", zorder=0)
    spread = 1.96 * np.sqrt(0.95 * 0.05 / count)
    right.axhspan(0.95 - spread, min(1.0, 0.95 + spread), color="0.85", zorder=0)
    left.yaxis.set_major_formatter("{x:g}")
    bottom, top = left.get_ylim()
    left.yaxis.set_minor_formatter("{x:g}" if top < 20 * bottom else NullFormatter())
    left.set_title(f"{case}: mean NEES of the pose (6 is right)", fontsize=10)
    right.set_title("share of the poses inside the 95 % region", fontsize=10)
    right.set_ylim(0, 1.02)
    for axis in (left, right):
        axis.set_xlabel("frame after the start")
        axis.grid(alpha=0.25)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    with atomic_path(out / f"consistency_{case}.png") as path:
        figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
