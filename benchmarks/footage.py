"""What does the tracker say of situations of real footage, and is it true?

    python benchmarks/footage.py

Rendered clips with exact truth (`footage_scenes.py`), 320x240 pixels, followed with the true camera and refined.
A frame that is called tracking or restarted is wrong where its NEES is above what is as rare as five standard
deviations, in the gauge of `honesty.py`. ATE is that of these frames, of the worst piece of one scale. A false cut is
a new start where there is no cut. The drawn rows (highway) are means over `--trials`, and their counts sums.

Last answer (2 cores, OpenCV 5.0, JAX 0.10, float64; ATE in % of the path, median error over the stated one, wrong
frames; refined):
    highway_empty .516 1.5 7; .400 1.6 16        highway_traffic 4.85 2.1 137; 4.75 8.3 129
    highway_light .218 1.7 31; .402 2.2 107      crowd .606 5.9 148; .578 7.4 139
    lead_brakes .482 1.5 13; .139 2.1 50         dissolve .102 .2 0; .089 .5 1
    same_room_cut .132 .3 0; .068 .5 6           other_room_cut .149 .3 0; .071 .6 5
    hand .099 .8 0; .128 .8 0                    room_twice .232 .4 0; .058 .7 0
    there_and_back .225 3.6 336; .069 4.1 300    stop_and_go .060 .5 0; .048 .8 1
    rotation_midway .259 .5 0; .155 .6 1         rolling_shutter 1.18 4.6 111; 1.94 12.6 118
    rolling_told .203 1.0 0; .168 1.9 11
783 of 2739 frames are called tracking and wrong (refined 884). No cut is missed; 1 false one (rotation_midway).
28 places are seen again (hand 3, room_twice 22, there_and_back 3), none falsely. highway_traffic.over_empty 9.4,
hand.scale_error .004 (refined .012), found 2 frames before the hand is gone; room_twice.end_error_percent .49,
refined .01; rolling_told.over_untold .17, refined .09. The rows without places are from before ORB took SIFT's place.
"""

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from contract import parser, report, table
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

import footage_scenes as scenes  # noqa: E402
from honesty import nees  # noqa: E402

from jaxtri.errors import InitialisationError  # noqa: E402
from jaxtri.formats import atomic_path  # noqa: E402
from jaxtri.odometry.poses import FramePose  # noqa: E402
from jaxtri.odometry.run import Run, track  # noqa: E402
from jaxtri.odometry.settings import Status  # noqa: E402
from jaxtri.trajectory import Trajectory, align, evaluate  # noqa: E402
from jaxtri.vision.video import Frame  # noqa: E402

WRONG = 39.49  # chi-square of six degrees of freedom that is as rare as five standard deviations of one
SURE = (Status.TRACKING, Status.RESTARTED, Status.FOUND)
FEWEST = 8  # frames of a piece that has an error
SITUATIONS: dict[str, tuple[Callable[[int, int], scenes.Situation], int]] = {
    "highway_empty": (scenes.highway_empty, 150),
    "highway_traffic": (scenes.highway_traffic, 150),
    "highway_light": (scenes.highway_light, 150),
    "crowd": (scenes.crowd, 150),
    "lead_brakes": (scenes.lead_brakes, 150),
    "dissolve": (scenes.dissolve, 140),
    "same_room_cut": (scenes.same_room_cut, 120),
    "other_room_cut": (scenes.other_room_cut, 120),
    "hand": (scenes.hand, 150),
    "room_twice": (scenes.room_twice, 400),
    "there_and_back": (scenes.there_and_back, 400),
    "stop_and_go": (scenes.stop_and_go, 210),
    "rotation_midway": (scenes.rotation_midway, 150),
    "rolling_shutter": (scenes.rolling_shutter, 120),
    "rolling_told": (scenes.rolling_told, 120),
}
"""How each is made, and its frames."""
DRAWN = ("highway_empty", "highway_traffic", "highway_light")  # several times
QUICK = {"highway_traffic": 60, "other_room_cut": 80}
LONG = 10_000
COUNTS = ("confidently_wrong", "judged", "false_cuts", "missed_cuts", "loops", "false_matches")
HAND = 9  # frames around the middle that show some of the hand
FALSE, COUNTS_FROM = 2.0, 0.25  # degrees by which a place is another one, and weight from which one counts


class Judged(NamedTuple):
    """Poses, the causal or the refined ones, beside the truth.

    Attributes:
        poses: Of all frames.
        ate: Worst of the pieces of one scale, in per cent of the path; NaN where there is none.
        frames: (k,) those called tracking or restarted.
        nees: (k,) theirs; NaN of those that the gauge is made of.
    """

    poses: list[FramePose]
    ate: float
    frames: np.ndarray
    nees: np.ndarray

    @property
    def wrong(self) -> np.ndarray:
        """Frames that are called sure, and are not where they are said to be."""
        return self.frames[self.nees > WRONG]

    @property
    def over_stated(self) -> float:
        """The error in the median over the one that is stated."""
        return float(np.sqrt(np.nanmedian(self.nees) / 6)) if np.isfinite(self.nees).any() else float("nan")


class Said(NamedTuple):
    """What came of a situation.

    Attributes:
        name: Of the situation.
        true: (t, 4, 4) true poses.
        causal: What the filter said.
        refined: What all frames together say.
        figures: Of this run, by name; those that are counts are added up over runs.
        warned: First words of what was warned of.
        shown: A frame.
        seconds: Of rendering, tracking and refinement.
    """

    name: str
    true: np.ndarray
    causal: Judged
    refined: Judged
    figures: dict[str, float]
    warned: list[str]
    shown: np.ndarray
    seconds: float


def pieces(poses: list[FramePose]) -> list[np.ndarray]:
    """Frames with a pose, those of each scale."""
    starts = np.array([-1 if p.T_camera_world is None else p.start for p in poses])
    return [np.flatnonzero(starts == k) for k in np.unique(starts[starts >= 0])]


def world_camera(poses: list[FramePose], frames: np.ndarray) -> np.ndarray:
    """Camera to world (t, 4, 4)."""
    return np.linalg.inv(np.stack([poses[k].T_camera_world for k in frames]))  # pyright: ignore[reportArgumentType, reportCallIssue]


def gauge(run: Run, poses: list[FramePose], kept: np.ndarray, piece: np.ndarray) -> tuple[int, int] | None:
    """The frame whose pose, and the one whose distance from it, the stated covariances are with respect to.

    As in `honesty.py`. Of a start after the first it is not told: there the first is the one whose pose is exact, and
    the second the one whose distance from it is stated to be known best, as a share of it.
    """
    if run.refined is not None and poses is run.refined.poses:
        keys = np.intersect1d(run.refined.keyframes, kept)
        if len(keys) < 2:
            return None
        ways = world_camera(poses, keys)[:, :3, 3] - world_camera(poses, keys[:1])[:, :3, 3]
        return int(keys[0]), int(keys[np.argmax(np.linalg.norm(ways, axis=1))])
    if run.odometry.base_pair is not None and run.odometry.base_pair[0] in piece:
        return run.odometry.base_pair
    exact = [k for k in piece if not np.any(poses[k].covariance)]
    if not exact or exact[0] == piece[-1]:
        return None
    others = piece[piece > exact[0]]
    begin = np.asarray(poses[exact[0]].T_camera_world)
    ways = np.array([(poses[k].T_camera_world @ np.linalg.inv(begin))[:3, 3] for k in others])
    spread = np.array([np.asarray(poses[k].covariance)[:3, :3] for k in others])
    share = np.einsum("ti,tij,tj->t", ways, spread, ways) / (ways**2).sum(axis=1) ** 2
    return int(exact[0]), int(others[np.argmin(share)])


def judge(run: Run, poses: list[FramePose], truth: np.ndarray) -> Judged:
    """What the sure frames of a run are worth, piece by piece."""
    worst, frames, squares = float("nan"), [], []
    sure = np.array([p.status in SURE for p in poses])
    for piece in pieces(poses):
        kept = piece[sure[piece]]
        if len(kept) >= FEWEST:
            found = Trajectory(kept / scenes.FPS, world_camera(poses, kept))
            ate = evaluate(found, Trajectory(found.times, truth[kept])).ate_percent
            worst = float(np.fmax(worst, ate))
        by = gauge(run, poses, kept, piece)
        if by is not None and len(kept):
            frames, squares = [*frames, kept], [*squares, nees(poses, kept, *by, truth)]
    numbers = [np.concatenate(x) if x else np.zeros(0) for x in (frames, squares)]
    return Judged(poses, worst, numbers[0], numbers[1])


def missed(status: list[Status], cuts: tuple[tuple[int, int], ...]) -> int:
    """Cuts that no frame tells of: within three frames of a hard one, or among those that show two shots."""
    ends = ((first, last + 1 if last > first else last + 4) for first, last in cuts)
    return sum(all(s is Status.TRACKING for s in status[first:end]) for first, end in ends)


def scale_step(poses: list[FramePose], middle: int, truth: np.ndarray) -> float:
    """Scale of the second half over that of the first, minus 1, by the frames that are called tracking."""
    sure = np.flatnonzero([p.status is Status.TRACKING for p in poses])
    scales = [
        float(align(jnp.asarray(truth[k][:, :3, 3]), jnp.asarray(world_camera(poses, k)[:, :3, 3])).scale)
        for k in (sure[sure < middle - HAND], sure[sure >= middle + HAND])
    ]
    return scales[1] / scales[0] - 1


def counted(run: Run) -> list[dict]:
    """Places that are seen again and count, as `run.json` has them."""
    assert run.refined is not None
    parts: Any = run.refined.statistics["parts"]
    return [loop for part in parts for loop in part.get("loops", ()) if loop["weight"] > COUNTS_FROM]


def revisited(poses: list[FramePose], truth: np.ndarray, frame: int, place: int) -> float:
    """By how many degrees the turn between two frames is off."""
    found, true = (
        T[1, :3, :3].T @ T[0, :3, :3] for T in (world_camera(poses, np.array([frame, place])), truth[[frame, place]])
    )
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(found.T @ true).as_rotvec())))


def end_error(poses: list[FramePose], truth: np.ndarray) -> float:
    """Error of the last position in the first camera, at the scale of the whole, in per cent of the path."""
    posed = np.flatnonzero([p.T_camera_world is not None for p in poses])
    found, true = world_camera(poses, posed), truth[posed]
    scale = float(align(jnp.asarray(found[:, :3, 3]), jnp.asarray(true[:, :3, 3])).scale)
    ends = [(np.linalg.inv(T[0]) @ T[-1])[:3, 3] for T in (found, true)]
    path = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    return float(100 * np.linalg.norm(scale * ends[0] - ends[1]) / path)


def follow(name: str, situation: scenes.Situation) -> Said:
    """Track a situation, and compare with its truth."""
    camera, images, truth, _, cuts, show = situation
    shown = []

    def frames() -> Iterator[Frame]:
        for k, image in enumerate(images):
            if k == show:
                shown.append(image)
            yield Frame(k, k / scenes.FPS, image)

    begun = time.perf_counter()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run = track(frames(), camera, progress=False, refine=True)
    assert run.refined is not None
    causal, refined = (judge(run, poses, truth) for poses in (run.odometry.poses, run.refined.poses))
    status, unknown = [p.status for p in causal.poses], run.odometry.scale_unknown_from
    found: dict[str, float] = {
        "judged": np.isfinite(causal.nees).sum(),
        "false_cuts": 0 if cuts else max(status.count(Status.RESTARTED), int(unknown is not None)),
        "missed_cuts": missed(status, cuts),
    }
    for kind, x in (("", causal), ("refined_", refined)):
        found |= {
            f"{kind}tracking_share": float(np.mean([p.status is Status.TRACKING for p in x.poses])),
            f"{kind}ate_percent": x.ate,
            f"{kind}confidently_wrong": len(x.wrong),
            f"{kind}error_over_stated": x.over_stated,
        }
        if name == "hand":
            found[f"{kind}scale_error"] = scale_step(x.poses, len(truth) // 2, truth)
        if name == "room_twice":
            found[f"{kind}end_error_percent"] = end_error(x.poses, truth)
    if name == "hand":
        back = [again.frame - len(truth) // 2 - HAND + 1 for again in run.odometry.found]
        found["found_after_frames"] = back[0] if back else float("nan")
    turns = [revisited(refined.poses, truth, loop["frame"], loop["place"]) for loop in counted(run)]
    found |= {"loops": len(turns), "false_matches": sum(turn > FALSE for turn in turns)}
    words = [" ".join(str(w.message).split()[:6]) for w in said]
    return Said(name, truth, causal, refined, found, words, shown[0], time.perf_counter() - begun)


def together(runs: list[Said]) -> dict[str, float]:
    """The figures of a row: counts are added up over its draws, others are means of those that have one."""
    name, found = runs[0].name, {}
    for key in runs[0].figures:
        values = [r.figures[key] for r in runs if np.isfinite(r.figures[key])]
        found[key] = float(np.sum(values) if key.endswith(COUNTS) else np.mean(values) if values else np.nan)
    if len(runs) > 1:
        found["worst_ate_percent"] = max(r.figures["ate_percent"] for r in runs)
    return {f"{name}.{key}": value for key, value in found.items()}


def row(runs: list[Said], figures: dict[str, float], expected: str) -> list[str]:
    """A row of the table."""
    name, frames = runs[0].name, sum(len(r.true) for r in runs)
    count = Counter(p.status.name.lower() for r in runs for p in r.causal.poses)
    cells = [name, f"{frames}", ", ".join(f"{n} {s}" for s, n in count.most_common())]
    for kind in ("", "refined_"):
        ate, over, wrong = (
            figures[f"{name}.{kind}{x}"] for x in ("ate_percent", "error_over_stated", "confidently_wrong")
        )
        cells += [f"{ate:.3f}", f"{over:.1f}", f"{wrong:.0f}"]
    cells += [f"{figures[f'{name}.{kind}_cuts']:.0f}" for kind in ("missed", "false")]
    return [*cells, expected, "; ".join(Counter(w for r in runs for w in r.warned))]


def plot_frames(done: dict[str, list[Said]], path: Path) -> None:
    """A frame of each row."""
    columns = 4
    lines = -(-len(done) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    for axis in axes.flat:
        axis.axis("off")
    for axis, (name, runs) in zip(axes.flat, done.items(), strict=False):
        axis.imshow(runs[0].shown[..., ::-1])
        axis.set_title(name)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def plot_paths(done: dict[str, list[Said]], path: Path) -> None:
    """Paths of the sure frames from above, each piece aligned to the true one; crosses where one is wrong."""
    columns = 4
    lines = -(-len(done) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(3.4 * columns, 3.0 * lines), layout="constrained")
    for axis in axes.flat[len(done) :]:
        axis.axis("off")
    for axis, (name, runs) in zip(axes.flat, done.items(), strict=False):
        said = runs[0]
        axis.plot(*said.true[:, (0, 2), 3].T, "k.", ms=1.5, label="true")
        for kind, x, colour in (("causal", said.causal, "C0"), ("refined", said.refined, "C1")):
            for number, piece in enumerate(np.intersect1d(p, x.frames) for p in pieces(x.poses)):
                if len(piece) < FEWEST:
                    continue
                place = world_camera(x.poses, piece)[:, :3, 3]
                to = align(jnp.asarray(place), jnp.asarray(said.true[piece, :3, 3]))
                place = np.asarray(to(jnp.asarray(place)))
                axis.plot(*place[:, (0, 2)].T, color=colour, lw=1, label=None if number else kind)
                bad = np.isin(piece, x.wrong)
                axis.plot(*place[bad][:, (0, 2)].T, "x", color=colour, ms=4)
        axis.set(title=name, xlabel="x, m", ylabel="z, m")
    axes.flat[0].legend(fontsize=7)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def main() -> None:
    ask = parser("What does the tracker say of situations of real footage, and is it true?", trials=2)
    ask.add_argument("--long", action="store_true", help=f"there_and_back of {LONG} frames")
    ask.add_argument("--only", nargs="+", choices=SITUATIONS, metavar="ROW", help="these rows alone")
    args = ask.parse_args()
    done: dict[str, list[Said]] = {}
    figures: dict[str, float] = {}
    rows = []
    for name in args.only or (QUICK if args.quick else SITUATIONS):
        make, n = SITUATIONS[name]
        n = QUICK.get(name, n) if args.quick else LONG if args.long and name == "there_and_back" else n
        expected = ""
        for trial in range(1 if args.quick or name not in DRAWN else args.trials):
            situation = make(n, args.seed + trial)
            expected = situation.expected
            try:
                done[name] = [*done.get(name, []), follow(name, situation)]
            except InitialisationError as error:
                rows.append([name, f"{n}", "no start", *["-"] * 8, expected, str(error)[:60]])
                print(*rows[-1], sep="  ", flush=True)
        if name in done:
            found = together(done[name])
            rows.append(row(done[name], found, expected))
            print(*rows[-1], f"{sum(r.seconds for r in done[name]):.0f} s", sep="  ", flush=True)
            figures |= found
    for key in (*COUNTS, "refined_confidently_wrong"):
        figures[key] = sum(v for k, v in figures.items() if k.endswith(f".{key}"))
    for one, other, name in (
        ("highway_traffic", "highway_empty", "highway_traffic.over_empty"),
        ("rolling_told", "rolling_shutter", "rolling_told.over_untold"),
    ):
        for kind in ("", "refined_"):
            ates = [figures.get(f"{x}.{kind}ate_percent", np.nan) for x in (one, other)]
            figures[name.replace(".", f".{kind}")] = ates[0] / ates[1]
    numbers = ["ATE %", "error / stated", "wrong"]
    head = ["situation", "frames", "status", *numbers, *(f"refined {x}" for x in numbers), "missed cuts", "false cuts"]
    print("\n" + table([*head, "expected", "warned"], rows))
    asked = (
        "highway_traffic.over_empty",
        "highway_traffic.worst_ate_percent",
        "rolling_told.over_untold",
        "rolling_told.refined_over_untold",
        "hand.scale_error",
        "hand.found_after_frames",
        "room_twice.end_error_percent",
        "room_twice.refined_end_error_percent",
    )
    print("\n" + "\n".join(f"{k} {figures[k]:.3f}" for k in asked if np.isfinite(figures.get(k, np.nan))))
    print(f"places seen again: {figures['loops']:.0f}, of which {figures['false_matches']:.0f} are none")
    print(f"called tracking and wrong: {figures['confidently_wrong']:.0f} of {figures['judged']:.0f} frames")
    if args.plots:
        plot_frames(done, args.plots / "footage_frames.png")
        plot_paths(done, args.plots / "footage_paths.png")
    report(args.json, figures)


if __name__ == "__main__":
    main()
