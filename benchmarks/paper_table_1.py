"""How accurate is each filter on the paper's synthetic experiment? Table I, figures 4 to 6, and the bound.

    python benchmarks/paper_table_1.py --plots out

300 points in 0.13 cubic metres at 0.33 m, 0.1 px at f = 600 px, 99 frames: pure translation, pure rotation,
both. The paper's rows are its own draws of an experiment that it describes but in part.

Last answer (2 cores, JAX 0.10, float64, 50 trials, --seed 2006; rotation in degrees, over the bound, translation
in mm, NEES of the pose, of the depths):
    default            .0049   1.51   .137       6.3   1.11
    consistent         .0047   1.43   .139       6.2   1.11
    8 base frames      .0035   1.07   .151       6.4   1.18
    paper              .095   32     1.17   36,000    43
    A-P, classic       .28    95    24.6       160
    A-P, good          .0037   1.12   .128       7.1   2.5
    two-step, classic  .22    23     2.8       380     2.0
    two-step, good     .0062   2.2    .224     490    26
The paper's own row: .2417 degrees in total, 30.6 mm. 10 to 14 minutes. With --seed 0 A-P, good, loses
the scale in one trial (.247 mm, NEES 32); the others are as here.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from contract import parser, report, table
from jaxlie import SO3
from matplotlib.axes import Axes
from paper_filters import METHODS, NAMES, STYLES, Estimate, draw, over_trials, pose_errors, run

jax.config.update("jax_enable_x64", True)

from jaxtri.estimation.bound import filtering_bound  # noqa: E402
from jaxtri.estimation.two_view import TwoView  # noqa: E402
from jaxtri.formats import atomic_path  # noqa: E402
from jaxtri.geometry.pose import euler_from_matrix  # noqa: E402
from jaxtri.synthetic import Experiment  # noqa: E402

# Roll, pitch, yaw (degrees), tx, ty, tz (m), total rotation (degrees, %), total translation (m, %).
PAPER = {
    "the paper, ours": (0.0822, 0.1769, 0.5411, 0.0067, 0.0199, 0.0210, 0.2417, 0.8466, 0.0306, 3.8015),
    "the paper, A-P": (0.8296, 2.1704, 7.9952, 0.0314, 0.0676, 0.0336, 3.2283, 11.830, 0.0871, 15.509),
    "the paper, two-step": (1.0856, 2.5604, 4.8386, 0.0131, 0.0406, 0.0182, 2.6504, 9.7289, 0.0485, 8.1139),
}
PAPER_GEODESIC = float(np.linalg.norm(PAPER["the paper, ours"][:3]))  # at least, from its mean errors
COLUMNS = ("roll_deg", "pitch_deg", "yaw_deg", "tx_mm", "ty_mm", "tz_mm")
QUICK = ("default", "consistent", "paper", "ap_good", "two_step_good")  # compilation is most of a short run
LOST_DEG = 10.0  # a trial whose mean error is above this has diverged


def errors(e: Experiment, estimate: Estimate) -> dict[str, jax.Array]:
    """Errors of one trial, one per frame: degrees, millimetres."""
    R, T = e.rotations[2:], e.translations[2:]

    def turn(a: jax.Array) -> jax.Array:
        return SO3.from_matrix(a).log()

    angles = [jax.vmap(lambda x: jnp.linalg.norm(turn(x)))(x) for x in (R, estimate.R)]
    yaw, pitch, roll = (jax.vmap(euler_from_matrix)(R) - jax.vmap(euler_from_matrix)(estimate.R)).T
    between, shift, nees = pose_errors(e, estimate)
    degrees = {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}
    millimetres = {f"{axis}_mm": 1e3 * shift[:, k] for k, axis in enumerate(("tx", "ty", "tz"))}
    return {
        **{k: jnp.rad2deg(jnp.abs(jnp.arctan2(jnp.sin(x), jnp.cos(x)))) for k, x in degrees.items()},
        **{k: jnp.abs(x) for k, x in millimetres.items()},
        "geodesic_deg": jnp.rad2deg(jnp.linalg.norm(between, axis=-1)),
        "total_rotation_deg": jnp.rad2deg(jnp.abs(angles[0] - angles[1])),  # the paper's definition
        "true_angle_deg": jnp.rad2deg(angles[0]),
        "translation_mm": 1e3 * jnp.linalg.norm(shift, axis=-1),
        "true_translation_mm": 1e3 * jnp.linalg.norm(T, axis=-1),
        "nees": nees,
    }


def depth_nees(e: Experiment, estimate: Estimate) -> jax.Array:
    """Mean over the points of the normalised squared error of the inverse depth, a figure per frame."""
    largest = jnp.max(estimate.variance, axis=-1, keepdims=True)
    known = estimate.variance > 1e-9 * largest  # all but the one that holds the scale of a plane
    squared = (estimate.points[..., 3] - 1 / e.points[:, 2]) ** 2 / jnp.where(known, estimate.variance, 1.0)
    return jnp.sum(jnp.where(known, squared, 0.0), axis=-1) / jnp.sum(known, axis=-1)


def one(e: Experiment, view: TwoView, method: str) -> dict[str, jax.Array]:
    estimate = run(e, view, method)
    return errors(e, estimate) | {"depth_nees": depth_nees(e, estimate)}


def rms(x: np.ndarray) -> np.ndarray:
    """Root mean square over the trials."""
    return np.sqrt(np.mean(x**2, axis=0))


def main() -> None:
    p = parser(__doc__.splitlines()[0] if __doc__ else "", trials=50)
    args = p.parse_args()
    count = min(args.trials, 1) if args.quick else args.trials
    began = time.perf_counter()
    trials = draw(args.seed, count, n_points=100, n_frames=33) if args.quick else draw(args.seed, count)
    frames = np.arange(2, trials.experiment.observed.shape[1], 4)
    bound = over_trials(partial(_bound, frames=jnp.asarray(frames)), trials, "bound")
    found = {m: over_trials(partial(one, method=m), trials, NAMES[m]) for m in (QUICK if args.quick else METHODS)}

    figures: dict[str, float] = {}
    rows = [[name, *(f"{x:.4f}" for x in row[:3]), *(f"{1e3 * x:.1f}" for x in row[3:6]), f"{row[6]:.4f}",
             f"{row[7]:.2f}", f"{1e3 * row[8]:.1f}", f"{row[9]:.2f}"] for name, row in PAPER.items()]  # fmt: skip
    ours = []
    for method, x in found.items():
        lost = ~(x["geodesic_deg"].mean(axis=1) < LOST_DEG)
        kept = {k: v[~lost] for k, v in x.items()}
        if lost.all():
            rows.append([NAMES[method], *["diverged"] * 10])
            continue
        mean = {k: float(v.mean()) for k, v in kept.items()}
        percent = [100 * mean[a] / mean[b] for a, b in (("total_rotation_deg", "true_angle_deg"),
                                                        ("translation_mm", "true_translation_mm"))]  # fmt: skip
        at = frames - 2
        over = {
            "rotation": np.median(rms(kept["geodesic_deg"])[at] / np.rad2deg(rms(bound["rotation"][~lost]))),
            "translation": np.median(rms(kept["translation_mm"])[at] / (1e3 * rms(bound["translation"][~lost]))),
        }
        figures |= {f"{method}.{k}": mean[k] for k in (*COLUMNS, "total_rotation_deg", "geodesic_deg",
                                                       "translation_mm", "nees", "depth_nees")}  # fmt: skip
        figures |= {f"{method}.{k}_over_bound": float(v) for k, v in over.items()}
        figures[f"{method}.lost"] = float(lost.mean())
        cells = [f"{mean[k]:.4f}" if k.endswith("deg") else f"{mean[k]:.3f}" for k in COLUMNS]
        rows.append([NAMES[method], *cells, f"{mean['total_rotation_deg']:.4f}", f"{percent[0]:.3f}",
                     f"{mean['translation_mm']:.3f}", f"{percent[1]:.3f}"])  # fmt: skip
        ours.append([NAMES[method], f"{mean['geodesic_deg']:.4f}", f"{over['rotation']:.2f}",
                     f"{over['translation']:.2f}", f"{mean['nees']:.3g}", f"{np.median(kept['nees']):.3g}",
                     f"{mean['depth_nees']:.3g}", f"{int(lost.sum())} of {count}",
                     f"{PAPER['the paper, ours'][6] / mean['total_rotation_deg']:.0f}",
                     f"{PAPER_GEODESIC / mean['geodesic_deg']:.0f}"])  # fmt: skip

    print(f"Mean error per frame, {count} trials, seed {args.seed}. Angles in degrees, translations in mm.\n")
    head = ["", "roll", "pitch", "yaw", "tx", "ty", "tz", "total rotation", "%", "total translation", "%"]
    print(table(head, rows))
    print("\nGeodesic: the angle of the rotation between truth and estimate (the paper's total rotation is the")
    print("difference of two angles, which is smaller). Bound: Cramer-Rao, root mean squares over the trials, median")
    print("over time. NEES: 6 is right for a pose, 1 for a depth. Classic rows: scale fitted to the truth. The last")
    print("two columns: how far below the paper's own row, by its definition (difference of angles) and by ours; its")
    print("geodesic error is at least .575, the root of the squares of its three angle columns.\n")
    head = ["", "geodesic", "rotation / bound", "translation / bound", "NEES of 6", "median", "depth NEES",
            "diverged", ".2417 / total", ".575 / geodesic"]  # fmt: skip
    print(table(head, ours))
    if not args.quick:
        print("\n" + claims(figures))
    print(f"\n{time.perf_counter() - began:.0f} s")
    report(args.json, figures)
    if args.plots is not None:
        plot(found, bound, frames, args.plots)


def _bound(e: Experiment, _: TwoView, frames: jax.Array) -> dict[str, jax.Array]:
    """Root mean square errors of the best unbiased filter: radians and metres."""
    C = filtering_bound(e.points, e.rotations, e.translations, e.sigma, frames=frames)
    return {
        "rotation": jnp.sqrt(jnp.trace(C[:, 3:, 3:], axis1=1, axis2=2)),
        "translation": jnp.sqrt(jnp.trace(C[:, :3, :3], axis1=1, axis2=2)),
    }


def claims(f: dict[str, float]) -> str:
    """Which of the paper's claims this run bears out: ratios of rotation errors, and a verdict."""

    def ratio(a: str, b: str) -> str:
        x = f.get(f"{a}.geodesic_deg", float("inf")) / f.get(f"{b}.geodesic_deg", float("nan"))
        return f"{x:.2g} times the error" + (", holds" if x > 1.1 else ", does not hold" if x < 0.9 else ", level")

    def of(key: str) -> str:
        return f"{f[key]:.3g}" if key in f else "none"

    lines = [
        "The paper's claims, on these data (rotation):",
        "- `paper` mode is more accurate than the filters of its day as they were started then:",
        f"    A-P, classic start: {ratio('ap_classic', 'paper')}",
        f"    two-step, classic start: {ratio('two_step_classic', 'paper')}",
        "- `paper` mode against the same filters with our start and our iterations:",
        f"    A-P, good start: {ratio('ap_good', 'paper')}; two-step, good start: {ratio('two_step_good', 'paper')}",
        "- our default against these:",
        f"    A-P, good start: {ratio('ap_good', 'default')}; it is the reference, "
        f"{of('ap_good.rotation_over_bound')} times the bound, at O(N^3)",
        f"    two-step, good start: {ratio('two_step_good', 'default')}; its covariance is far too small, NEES "
        f"{of('two_step_good.nees')} of 6",
        "- why: a plane, one pass and exact rays make the baselines over-confident before the structure is known; with",
        "  a good start that goes away, and keeping the structure in the state costs time, not accuracy. What one pass",
        f"  and a constant R cost the trifocal filter: {ratio('paper', 'default').split(',')[0]} of the default.",
    ]
    return "\n".join(lines)


def plot(found: dict[str, dict[str, np.ndarray]], bound: dict[str, np.ndarray], frames: np.ndarray, out: Path) -> None:
    """Figures 4, 5 and 6 of the paper: mean errors over time, all methods."""
    out.mkdir(parents=True, exist_ok=True)
    time_axis = np.arange(2, 2 + found["default"]["nees"].shape[1])

    def draw(axis: Axes, values: Callable[[dict[str, np.ndarray]], np.ndarray], title: str) -> None:
        for method, x in found.items():
            good = x["geodesic_deg"].mean(axis=1) < LOST_DEG
            if good.any():
                colour, line, marker = STYLES[method]
                axis.semilogy(time_axis, values({k: v[good] for k, v in x.items()}), color=colour, linestyle=line,
                              marker=marker, markevery=12, markersize=5, label=NAMES[method], lw=1.3)  # fmt: skip
        for edge in (1 + len(time_axis) / 3, 1 + 2 * len(time_axis) / 3):
            axis.axvline(edge, color="0.85", lw=1, zorder=0)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("frame")
        axis.grid(alpha=0.25)

    def mean(key: str) -> Callable[[dict[str, np.ndarray]], np.ndarray]:
        return lambda x: x[key].mean(axis=0)

    def share(a: str, b: str) -> Callable[[dict[str, np.ndarray]], np.ndarray]:
        return lambda x: 100 * x[a].mean(axis=0) / np.where(x[b].mean(axis=0) > 1e-9, x[b].mean(axis=0), np.nan)

    panels = {
        "figure_4": [
            ("rotation error, geodesic [degrees]", mean("geodesic_deg")),
            ("translation error [mm]", mean("translation_mm")),
        ],
        "figure_5": [
            ("total rotation error [% of the angle]", share("total_rotation_deg", "true_angle_deg")),
            ("total translation error [% of the length]", share("translation_mm", "true_translation_mm")),
        ],
        "figure_6": [
            (f"{k.split('_')[0]} error [{'degrees' if k.endswith('deg') else 'mm'}]", mean(k)) for k in COLUMNS
        ],
    }
    for name, parts in panels.items():
        rows = len(parts) // 3 or 1
        figure, axes = plt.subplots(rows, len(parts) // rows, figsize=(11, 4.2 * rows), layout="constrained")
        for axis, (title, values) in zip(axes.ravel(), parts, strict=True):
            draw(axis, values, title)
        if name == "figure_4":
            # A mean of norms is about .92 of the root mean square that the bound gives.
            axes[0].semilogy(frames, 0.92 * np.rad2deg(rms(bound["rotation"])), "k:", lw=1.5, label="Cramer-Rao bound")
            axes[1].semilogy(frames, 0.92e3 * rms(bound["translation"]), "k:", lw=1.5)
        figure.legend(*axes.ravel()[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
        with atomic_path(out / f"{name}.png") as path:
            figure.savefig(path, dpi=120)
        plt.close(figure)


if __name__ == "__main__":
    main()
