"""Does the tracker hold where frames are missing: every second, every third, a gap of five in the middle?

    python benchmarks/decimated.py --data ../shared/data

The sequences of `real_sequences.py`, with the shipped defaults; ATE in units of that of `pnp` on the whole sequence.
Frames keep their times.

Last answer (2 cores, OpenCV 5.0, JAX 0.10, float64; whole, stride2, stride3, gap5): geometric mean .661 .756 1.382
1.201, without the temple .718 .667 .705 .703. The temple, 19 frames 7 degrees apart, gives .44 1.42 39.8 and 17.2 (86 %
covered): of every third frame 17 tracks are left, and 12 of them agree on a wrong motion; five less are a step of 45
degrees.
"""

from collections.abc import Callable, Iterator

import jax
import numpy as np
from contract import parser, report, table

jax.config.update("jax_enable_x64", True)

from real_sequences import PEERS  # noqa: E402

from jaxtri.formats import read_camera, read_tum  # noqa: E402
from jaxtri.odometry.run import track  # noqa: E402
from jaxtri.trajectory import evaluate  # noqa: E402
from jaxtri.vision.video import Frame, FrameSource, open_source  # noqa: E402

GAP = 5
FORMS: dict[str, Callable[[int, int], bool]] = {
    "whole": lambda k, n: True,
    "stride2": lambda k, n: k % 2 == 0,
    "stride3": lambda k, n: k % 3 == 0,
    "gap5": lambda k, n: not n // 2 <= k < n // 2 + GAP,
}


def thinned(source: FrameSource, form: str, n: int) -> Iterator[Frame]:
    """The frames that a form keeps."""
    return (frame for frame in source if FORMS[form](frame.index, n))


def main() -> None:
    args = parser("Does the tracker hold where frames are missing?", data=True).parse_args()
    folders = [args.data / name for name in PEERS if (args.data / name).is_dir()]
    if not folders:
        raise SystemExit(f"{args.data}: none of the sequences is there; give their folder by --data")
    if args.quick:
        folders = folders[-1:]
    figures: dict[str, float] = {}
    rows = []
    for folder in folders:
        name, truth = folder.name, read_tum(folder / "groundtruth.txt")
        camera, row = read_camera(folder / "camera.json"), [folder.name]
        for form in FORMS:
            with open_source(folder) as source:
                run = track(thinned(source, form, len(truth.times)), camera, progress=False)
            poses, unknown = run.odometry.poses, run.odometry.scale_unknown_from
            coverage = np.mean([p.T_camera_world is not None for p in poses[:unknown]])
            ratio = evaluate(run.trajectory, truth).ate_percent / PEERS[name][1]
            figures |= {f"{name}.{form}.ate_over_pnp": ratio, f"{name}.{form}.coverage": float(coverage)}
            row.append(f"{ratio:.2f}" + ("" if coverage == 1 and unknown is None else f" ({coverage:.0%})"))
        rows.append(row)
        print(*row, sep="  ", flush=True)
    means = ["geometric mean"]
    for form in FORMS:
        mean = np.exp(np.mean([np.log(figures[f"{f.name}.{form}.ate_over_pnp"]) for f in folders]))
        figures[f"{form}.geomean_ate_vs_pnp"] = float(mean)
        means.append(f"{mean:.3f}")
    print("\n" + table(["ATE / pnp", *FORMS], [*rows, means]))
    if args.plots:
        print("no plots: the trajectories are those of real_sequences.py --plots")
    report(args.json, figures)


if __name__ == "__main__":
    main()
