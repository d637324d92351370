"""Does an inserted object stay where it was put, on real video? The paper's figures 8 to 13.

    python benchmarks/paper_real.py --data ../shared/data --plots out

The paper's own sequences (a laboratory seen from a rig, a stadium and a canyon from the air) are not to be
had; these stand for them: a desk and a rig for the laboratory, a flight over relief for the stadium, a road
for the canyon. Each is run twice, as shipped and as published (`--base paper`), with the same features. The
truth, which the paper did not have, says how far the object drifts: absolute error after a similarity.

With --plots: the overlay video of each, three of its frames, the first, the middle and the last, and the
pose over time beside the truth.

Last answer (ATE in % of the path, as shipped / as published): desk .168 / .267, rig .127 / .299, flight .011 /
.024, road .218 / .437.
"""

import warnings
from pathlib import Path

import cv2
import jax
import numpy as np
from contract import parser, report, table
from real_sequences import plot, run_sequence

jax.config.update("jax_enable_x64", True)

from jaxtri.errors import InputError  # noqa: E402
from jaxtri.formats import atomic_path, read_camera  # noqa: E402
from jaxtri.odometry.run import Run  # noqa: E402
from jaxtri.odometry.settings import Base  # noqa: E402
from jaxtri.output.results import precise, write_overlay  # noqa: E402
from jaxtri.vision.video import open_source  # noqa: E402

STANDS_FOR = {
    "ar_chessboard": "laboratory",
    "rig_temple": "laboratory rig",
    "aerial_semisynthetic_a": "stadium",
    "driving_kitti00": "canyon",
}


def overlay(run: Run, folder: Path, out: Path) -> str:
    """The video with a car in it, and a picture of three of its frames; why not, where there is none."""
    video = out / f"{folder.name}.mp4"
    with open_source(folder) as source:
        try:
            write_overlay(run, source, read_camera(folder / "camera.json"), video, 25.0, progress=False)
        except InputError as error:
            return str(error)
    with open_source(video) as source:
        frames = [frame.image for frame in source]
    chosen = [frames[k] for k in (0, len(frames) // 2, len(frames) - 1)]
    size = (480, round(480 * chosen[0].shape[0] / chosen[0].shape[1]))
    small = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in chosen]
    with atomic_path(out / f"{folder.name}_frames.png") as path:
        cv2.imwrite(str(path), np.hstack(small))
    return video.name


def main() -> None:
    args = parser(__doc__.splitlines()[0] if __doc__ else "", data=True).parse_args()
    folders = [args.data / name for name in STANDS_FOR if (args.data / name).is_dir()]
    if not folders:
        raise SystemExit(f"{args.data}: none of the sequences is there; give their folder by --data")
    if args.quick:
        folders = [f for f in folders if f.name == "rig_temple"] or folders[:1]
    figures: dict[str, float] = {}
    rows = []
    for folder in folders:
        for base in (Base.TRACKS, Base.PAPER):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run, errors, _, coverage = run_sequence(folder, base)
            prefix = "" if base is Base.TRACKS else "paper."
            figures |= {
                f"{prefix}{folder.name}.coverage": coverage,
                f"{prefix}{folder.name}.ate_percent": errors.ate_percent,
                f"{prefix}{folder.name}.rotation_rmse_deg": errors.rotation_rmse_deg,
                f"{prefix}{folder.name}.points": float(precise(run).sum()),
            }
            made = "not asked for"
            if args.plots is not None:
                out = args.plots / base.value
                out.mkdir(parents=True, exist_ok=True)
                made = overlay(run, folder, out)
                plot(run, folder, out / f"{folder.name}_pose.png")
            rows.append([folder.name, STANDS_FOR[folder.name], "shipped" if base is Base.TRACKS else "published",
                         len(run.trajectory), f"{coverage:.0%}", f"{errors.ate_percent:.3f}",
                         f"{errors.rotation_rmse_deg:.3f}", int(precise(run).sum()), made])  # fmt: skip
            print(f"  {folder.name}, {base.value}: {errors.ate_percent:.3f} % of the path", flush=True)
    head = ["sequence", "stands for", "as", "frames", "cover", "ATE %", "rotation deg", "points", "overlay"]
    print("\n" + table(head, rows))
    report(args.json, figures)


if __name__ == "__main__":
    main()
