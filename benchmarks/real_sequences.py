"""How far is the recovered trajectory from the truth on real video, with the shipped defaults?

    python benchmarks/real_sequences.py --data ../shared/data

The same settings for every sequence. Peers beside ours are single runs with the same intrinsics; `pnp` is a
two-view start, PnP per frame and landmarks triangulated once.

Last answer (2 cores, OpenCV 5.0, JAX 0.10, float64; ATE / pnp in the order of the table, geometric mean):
    tracks    0.25 0.52 1.84 1.10 0.63 0.44   0.646
    inherit   0.93 1.20 1.90 1.15 1.00 1.10   1.179
    paper     2.00 1.39 1.89 7.55 10.8 1.20   2.832
    refined   0.13 0.50 1.71 0.92 0.50 0.34   0.509
Coverage 100 % of one scale everywhere; rotation_7scenes_kitchen 1.90 degrees; dinosaur 0.162 degrees a
step, 1.79 degrees after the circle. All but these two rows were measured before starts in traffic were mended: tracks
0.659, refined 0.526 then. Other rounding moves the kitchen from 1.00 to 1.11 (0.645 in all). The noise of
`refine` in the window and the filter gave 0.19 0.60 1.78 1.05 0.64 0.76, 0.685, and a rotation error a frame 6 %
smaller. Refined to the last decimal it is 0.518; with three steps 0.535; with the noise that was found in the place of
the one assumed, found again after it, 0.556.
Without a calibration (--uncalibrated, from 60 degrees): focal length off by +.05 -.04 -.52 -.41 +1.7 +2.0 %, stated
1.5 1.7 1.5 1.5 1.5 1.6 %; ATE .010 .331 .168 .679 .065 .074 %, refined .005 .273 .189 .590 .041 .061 %.
"""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from contract import parser, report, table

jax.config.update("jax_enable_x64", True)

from jaxtri.formats import atomic_path, read_camera, read_tum  # noqa: E402
from jaxtri.geometry.camera import Camera  # noqa: E402
from jaxtri.odometry.rounds import track_uncalibrated  # noqa: E402
from jaxtri.odometry.run import Run, follow_tracks, track  # noqa: E402
from jaxtri.odometry.settings import Base  # noqa: E402
from jaxtri.output.plot import plot_trajectory  # noqa: E402
from jaxtri.trajectory import Evaluation, Trajectory, align, evaluate  # noqa: E402
from jaxtri.vision.video import open_source  # noqa: E402

# ATE in % of the path: essential, pnp, window, isam2, svo (causal), full BA, COLMAP (batch).
PEERS = {
    "aerial_semisynthetic_a": (3.58, 0.037, 0.024, 0.026, 0.049, 0.035, 0.019),
    "ar_chessboard": (5.5, 0.203, 0.184, 0.149, 0.115, 0.142, 0.127),
    "driving_kitti00": (0.62, 0.209, 0.468, 0.364, 1.47, 0.460, 0.314),
    "indoor_7scenes_kitchen": (2.67, 0.656, 0.847, 1.14, 0.748, 0.618, 0.583),
    "indoor_tsukuba_rendered": (1.30, 0.157, 0.299, 0.255, 0.202, 0.196, 0.146),
    "rig_temple": (1.48, 0.182, 0.179, 0.373, 4.7, 0.096, 0.253),
}
GUESS_DEG = 60.0  # field of view that a camera is begun with of which nothing is known
NAMES = ("essential", "pnp", "window", "isam2", "svo", "full BA", "COLMAP")
ROTATION = "rotation_7scenes_kitchen"
ROTATION_PEERS = "orientation RMSE in degrees: pnp 1.50, window 1.61, isam2 1.54, svo .91 (92 %), full BA .34"


def run_sequence(folder: Path, base: Base) -> tuple[Run, Evaluation, Evaluation | None, float]:
    """The run, its errors, those once it is refined, and the share of frames with a pose of the first scale."""
    camera = read_camera(folder / "camera.json")
    with open_source(folder) as source:
        run = track(source, camera, base=base, progress=False, refine=base is Base.TRACKS)
    posed = np.array([p.T_camera_world is not None for p in run.odometry.poses])
    one_scale = len(posed) if run.odometry.scale_unknown_from is None else run.odometry.scale_unknown_from
    coverage = posed[:one_scale].sum() / len(posed)
    truth = read_tum(folder / "groundtruth.txt")
    refined = None if run.refined is None else evaluate(run.trajectory, truth)
    return run, evaluate(run.odometry.trajectory(), truth), refined, float(coverage)


def plot(run: Run, folder: Path, path: Path) -> None:
    """The trajectory aligned to the truth, and the truth."""
    truth, T = read_tum(folder / "groundtruth.txt"), run.trajectory.T_world_camera
    fit = align(jnp.asarray(T[:, :3, 3]), jnp.asarray(truth.positions))
    aligned = Trajectory(run.trajectory.times, np.asarray(fit.transform_poses(jnp.asarray(T))))
    figure = plot_trajectory(aligned, reference=truth, units="m", title=path.stem)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=100)


def dinosaur(folder: Path) -> dict[str, float]:
    """The turntable: 36 views of a full circle from given tracks."""
    data = np.load(folder / "tracks.npz")
    camera = read_camera(folder / "camera.json", width=720, height=576)
    odometry = follow_tracks(camera, data["xy"], data["visible"])
    estimate = odometry.trajectory()
    truth = data["Twc"]
    R, R_true = estimate.rotations, truth[:, :3, :3]
    step = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    step_true = np.swapaxes(R_true[:-1], 1, 2) @ R_true[1:]

    def angle(M: np.ndarray) -> np.ndarray:
        return np.rad2deg(np.arccos(np.clip((np.trace(M, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))

    whole = R[0].T @ R[-1]
    whole_true = R_true[0].T @ R_true[-1]
    errors = evaluate(estimate, read_tum(folder / "groundtruth.txt"))
    posed = sum(p.T_camera_world is not None for p in odometry.poses)
    return {
        "coverage": posed / len(truth),
        "segments": odometry.starts,
        "step_rotation_error_deg": float(angle(np.swapaxes(step_true, 1, 2) @ step).mean()),
        "closing_error_deg": float(angle(whole_true.T @ whole)),
        "ate_percent": errors.ate_percent,
    }


def uncalibrated(folders: list[Path]) -> dict[str, float]:
    """What comes of the sequences where nothing is known of the camera; prints a table."""
    figures, rows = {}, []
    for folder in folders:
        name, true = folder.name, read_camera(folder / "camera.json")
        assert true.width is not None
        assert true.height is not None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            guess = Camera.from_fov(GUESS_DEG, true.width, true.height)
            run = track_uncalibrated(lambda folder=folder: open_source(folder), guess, progress=False)
        found, truth = run.calibration, read_tum(folder / "groundtruth.txt")
        assert found is not None
        error = float(found.camera.fx / true.fx) - 1
        causal, refined = evaluate(run.odometry.trajectory(), truth), evaluate(run.trajectory, truth)
        figures |= {
            f"{name}.focal_relative_error": abs(error),
            f"{name}.focal_sd": found.focal_sd,
            f"{name}.uncalibrated_ate_percent": causal.ate_percent,
            f"refined.{name}.uncalibrated_ate_percent": refined.ate_percent,
        }
        started = f"{float(guess.fx / true.fx) - 1:+.0%}"
        row = [name, started, f"{100 * error:+.2f}", f"{100 * found.focal_sd:.2f}"]
        rows.append([*row, f"{causal.ate_percent:.3f}", f"{refined.ate_percent:.3f}"])
        print(*rows[-1], sep="  ", flush=True)
    head = ["no calibration", "begun", "focal length %", "stated sd %", "ATE %", "refined %"]
    print("\n" + table(head, rows))
    return figures


def main() -> None:
    options = parser("How far is the recovered trajectory from the truth on real video?", data=True)
    options.add_argument("--bases", nargs="+", default=[b.value for b in Base], help="kinds of base to compare")
    options.add_argument("--uncalibrated", action="store_true", help="the same without a calibration, and nothing else")
    args = options.parse_args()
    folders = [args.data / name for name in [*PEERS, ROTATION] if (args.data / name).is_dir()]
    if not folders:
        raise SystemExit(f"{args.data}: none of the sequences is there; give their folder by --data")
    if args.quick:
        folders = folders[3:4] + folders[5:6]
        args.bases = ["tracks"]
    if args.uncalibrated:
        report(args.json, uncalibrated([f for f in folders if f.name in PEERS]))
        return
    figures: dict[str, float] = {}
    for kind in args.bases:
        rows, ratios, refined_ratios = [], [], []
        prefix = "" if kind == "tracks" else f"{kind}."
        for folder in folders:
            name = folder.name
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run, errors, refined, coverage = run_sequence(folder, Base(kind))
            if args.plots:
                plot(run, folder, args.plots / f"{kind}_{name}.png")
            fps = float(run.statistics["frames_per_second"])  # pyright: ignore[reportArgumentType]
            figures |= {
                f"{prefix}{name}.coverage": coverage,
                f"{prefix}{name}.segments": run.odometry.starts,
                f"{prefix}{name}.restarts": run.odometry.changes,
                f"{prefix}{name}.ate_percent": errors.ate_percent,
                f"{prefix}{name}.rotation_rmse_deg": errors.rotation_rmse_deg,
                f"{prefix}{name}.rpe_translation_percent": errors.rpe_translation_percent,
                f"{prefix}{name}.rpe_rotation_deg": errors.rpe_rotation_deg,
                f"{prefix}{name}.fps": fps,
            }
            if refined is not None:
                names = ("ate_percent", "rotation_rmse_deg", "rpe_translation_percent", "rpe_rotation_deg")
                figures |= {f"refined.{name}.{x}": getattr(refined, x) for x in names}
                figures[f"refined.{name}.coverage"] = coverage
            row = [
                name,
                f"{coverage:.0%}",
                run.odometry.starts,
                run.odometry.changes,
                f"{errors.ate_percent:.3f}",
            ]
            row += [f"{errors.rpe_translation_percent:.1f}", f"{errors.rpe_rotation_deg:.4f}"]
            row += [f"{errors.rotation_rmse_deg:.2f}", f"{fps:.0f}"]
            if name in PEERS:
                ratio = errors.ate_percent / PEERS[name][1]
                ratios.append(ratio)
                row += [f"{ratio:.2f}"]
                if refined is not None:
                    refined_ratios.append(refined.ate_percent / PEERS[name][1])
                    row += [f"{refined.ate_percent:.4f}", f"{refined_ratios[-1]:.2f}"]
                row += [f"{p:g}" for p in PEERS[name]]
            else:
                row += [""] if refined is None else ["", f"{refined.rotation_rmse_deg:.2f} deg", ""]
                row += [""] * len(NAMES)
            rows.append(row)
            print(f"  {kind}: {name} {errors.ate_percent:.3f} %", flush=True)
        head = [
            "sequence",
            "cover",
            "starts",
            "restarts",
            "ATE %",
            "RPE t %",
            "RPE r deg",
            "rot deg",
            "fps",
            "ATE/pnp",
        ]
        head += ["refined %", "/pnp"] if kind == "tracks" else []
        print(f"\nbase: {kind}\n" + table(head + list(NAMES), rows))
        if ratios:
            mean = float(np.exp(np.mean(np.log(ratios))))
            figures[f"{prefix}geomean_ate_vs_pnp"] = mean
            print(f"geometric mean of ATE / pnp over {len(ratios)} sequences: {mean:.3f}")
        if refined_ratios:
            figures["refined.geomean_ate_vs_pnp"] = float(np.exp(np.mean(np.log(refined_ratios))))
            print(f"the same, refined: {figures['refined.geomean_ate_vs_pnp']:.3f}")
        print(f"{ROTATION}: {ROTATION_PEERS}\n", flush=True)
    circle = args.data / "tracks_oxford_dinosaur"
    if circle.is_dir():
        found = dinosaur(circle)
        figures |= {f"tracks_oxford_dinosaur.{k}": v for k, v in found.items()}
        print(
            f"tracks_oxford_dinosaur: {found['coverage']:.0%} of the circle in {found['segments']:.0f} start(s), "
            f"{found['step_rotation_error_deg']:.3f} degrees mean rotation error per step (of 10), "
            f"{found['closing_error_deg']:.2f} degrees after the whole circle, ATE {found['ate_percent']:.2f} %"
        )
    report(args.json, figures)


if __name__ == "__main__":
    main()
