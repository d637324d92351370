"""How much faster is a frame than with other filters and optimisers?

    python -m pip install '.[bench]'
    OPENBLAS_NUM_THREADS=1 python benchmarks/peers.py --plots out

91 frames of the paper's experiment after the base pair, float64; all run in turns, ratios are medians over the
rounds. The EKF libraries and the two filters in NumPy do the very update of ours, which is one call for all frames:
one pass of the paper's mode with yaw, pitch and roll, the base pair taken as known, so that all states are plain
vectors and the answers agree to rounding; the largest difference is printed. dynamax, cuthbert and kalman-py run
compiled, as one scan; filterpy steps from Python and is given a measurement and Jacobian written in NumPy.
`numpy_paper` inverts the 2N x 2N innovation, as the paper has it, `numpy_information` the 12 x 12 one in O(N).

GTSAM has points and poses in one problem, so it is compared with the default mode and its structure bank, by the time
of a frame: `gtsam_isam2` one incremental update, `gtsam_batch` one Levenberg-Marquardt over all frames, which who
wants that accuracy at every frame pays for every frame; `gtsam_batch_once` is the same divided by its frames.
Factors are built outside the clock. A peer that is not installed is left out, with a notice.

Last answer (2 idle cores, JAX 0.10; times ours at N = 30 / 100 / 300): dynamax 1.6 / 12 / 60, kalman-py 2.2 / 13 /
88, cuthbert 2.0 / 22 / 147, filterpy 5.9 / 28 / 197, numpy_paper 6.3 / 33 / 280, numpy_information 4.1 / 5.6 / 4.6,
and 9.1 at 10,000; answers apart by 4e-9. Asked at 300: 75 times every library (all but dynamax), 250 and 4.5 for
NumPy (reached), and at 30 2.5 times dynamax: missed, as a frame of ours costs 101 us for few points, 146 for 300.
GTSAM at 300: iSAM2 (its default settings) 375 ms a frame, 463 times (5,000 asked), batch 2.0 s, 2,490 times for a
batch a frame (500 asked), 27 times for one in all; rotation .0052 degrees ours, .066 iSAM2, .0032 batch.
"""

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from contract import in_turns, parser, plot_growth, report, table
from jaxlie import SO3
from paper_filters import Estimate, draw
from paper_filters import run as run_trial
from tqdm import tqdm

jax.config.update("jax_enable_x64", True)

from jaxtri.filters import ekf  # noqa: E402
from jaxtri.geometry.epipolar import homogeneous, perpendicular_line  # noqa: E402
from jaxtri.geometry.pose import rotation_matrix  # noqa: E402
from jaxtri.geometry.trifocal import transfer  # noqa: E402
from jaxtri.models.depth import triangulate  # noqa: E402
from jaxtri.models.motion import Kinematics  # noqa: E402
from jaxtri.models.trifocal import Trifocal, TrifocalState, start  # noqa: E402

SIZES = (30, 100, 300)
LARGE = (1000, 3000, 10000)  # for those without a 2N x 2N matrix
FRAMES = 91
ACCELERATION, ANGULAR = 0.015, 0.02
Run = Callable[[], np.ndarray]  # states of all frames (t, 18)


def state_of(x: jax.Array) -> TrifocalState:
    """Of the vector of its errors' order."""
    T, v, angles, rates, T2, base = jnp.split(x, 6)
    return TrifocalState(Kinematics(T, v, angles, rates), T2, base)


def vector_of(mean: TrifocalState) -> jax.Array:
    """The state as a vector, of one frame or of all."""
    return jnp.concatenate(jax.tree.leaves(mean), axis=-1)


def turn(axis: int, angle: float) -> np.ndarray:
    """Rotation by an angle about a coordinate axis."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R, c, s = np.eye(3), np.cos(angle), np.sin(angle)
    R[j, j], R[j, k], R[k, j], R[k, k] = c, -s, s, c
    return R


def turn_rate(axis: int, angle: float) -> np.ndarray:
    """Its derivative."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R, c, s = np.zeros((3, 3)), np.cos(angle), np.sin(angle)
    R[j, j], R[j, k], R[k, j], R[k, k] = -s, -c, c, -s
    return R


def euler(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R = Rz(roll) Ry(yaw) Rx(pitch), and its derivative (3, 3, 3) by yaw, pitch and roll, foremost."""
    yaw, pitch, roll = angles
    Z, Y, X = turn(2, roll), turn(1, yaw), turn(0, pitch)
    return Z @ Y @ X, np.stack([Z @ turn_rate(1, yaw) @ X, Z @ Y @ turn_rate(0, pitch), turn_rate(2, roll) @ Y @ X])


class Problem:
    """The experiment as a plain vector problem x' = F x + w, z = h(x) + v, and the filters over it."""

    def __init__(self, seed: int, points: int) -> None:
        self.points = points
        self.e, self.view = jax.tree.map(lambda x: x[0], draw(seed, 1, n_points=points, n_frames=FRAMES + 2))
        first, second, self.observed = self.e.observed[0], self.e.observed[1], self.e.observed[2:]
        self.pairs = jnp.concatenate([first, second], axis=-1)
        linear, angular = jnp.asarray(ACCELERATION), jnp.asarray(ANGULAR)
        still, T2 = jnp.zeros(()), self.view.translation
        self.model = Trifocal(self.e.sigma, linear, angular, still, T2, base_noise=False, refine_base=True)
        begun = start(self.view, velocity_sd=0.02, angular_velocity_sd=0.02, euler=True)
        known = jnp.arange(18) >= 12
        P = jnp.where(known[:, None] | known, 0.0, begun.covariance)
        self.belief = ekf.Belief(begun.mean, P)

        # Of a linear motion: positions and angles go on by their rates.
        self.F = np.eye(18)
        for k in (0, 6):
            self.F[k : k + 3, k + 3 : k + 6] = np.eye(3)
        self.Q = np.asarray(self.model.process_noise(begun.mean, jnp.ones(())))
        self.x, self.P = np.asarray(vector_of(begun.mean)), np.asarray(P)
        self.sigma, self.z = float(self.e.sigma), np.asarray(self.observed).reshape(FRAMES, -1)
        self.R = self.sigma**2 * np.eye(2 * points)
        self.rays = np.asarray(homogeneous(first))
        self.lines = np.asarray(jax.vmap(perpendicular_line, (0, None))(second, T2))

    def h(self, x: jax.Array) -> jax.Array:
        """All measurements, for the libraries that differentiate by themselves."""
        state = state_of(x)
        R2, R = rotation_matrix(state.base_rotation), state.motion.R
        T2, T, e2 = state.base_translation, state.motion.translation, self.view.translation
        return jax.vmap(lambda p: transfer(p[:2], p[2:], R2, T2, R, T, e2))(self.pairs).ravel()

    def linearised(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same in NumPy, with its Jacobian (2n, 18) by hand."""
        T, T2, u, line = x[:3], x[12:15], self.rays, self.lines
        (R, dR), (R2, dR2) = euler(x[6:9]), euler(x[15:18])
        along = line @ T2
        inverse = -np.sum(line * (u @ R2.T), axis=1) / along
        X = u @ R.T + inverse[:, None] * T
        y = X[:, :2] / X[:, 2:]
        dX = np.zeros((len(u), 3, 18))
        dX[:, [0, 1, 2], [0, 1, 2]] = inverse[:, None]
        dX[:, :, 6:9] = np.einsum("kab,nb->nak", dR, u)
        by_base = np.empty((len(u), 6))
        by_base[:, :3] = -(inverse / along)[:, None] * line
        by_base[:, 3:] = -np.einsum("na,kab,nb->nk", line, dR2, u, optimize=True) / along[:, None]
        dX[:, :, 12:] = T[:, None] * by_base[:, None]
        H = (dX[:, :2] - y[:, :, None] * dX[:, 2:]) / X[:, 2:, None]
        return y.ravel(), H.reshape(-1, 18)

    def ours(self) -> Run:
        """One call for all frames."""
        seen = jnp.ones(self.observed.shape[:2], bool)
        run = jax.jit(lambda b, z: vector_of(ekf.filter(self.model, b, self.pairs, z, seen, passes=1)[0].mean))
        return lambda: np.asarray(run(self.belief, self.observed))

    def numpy_paper(self) -> np.ndarray:
        """The gain from the inverse of the innovation covariance (Yu et al. 2006, section IV)."""
        x, P, found = self.x, self.P, []
        for z in self.z:
            x, P = self.F @ x, self.F @ P @ self.F.T + self.Q
            y, H = self.linearised(x)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + self.R)
            x, P = x + K @ (z - y), (np.eye(18) - K @ H) @ P
            found.append(x)
        return np.stack(found)

    def numpy_information(self) -> np.ndarray:
        """(I + P A)^-1 P of 18 x 18, A = H' H / sigma^2."""
        x, P, found = self.x, self.P, []
        for z in self.z:
            x, P = self.F @ x, self.F @ P @ self.F.T + self.Q
            y, H = self.linearised(x)
            HW = H.T / self.sigma**2
            P = np.linalg.solve(np.eye(18) + P @ (HW @ H), P)
            P = (P + P.T) / 2
            x = x + P @ (HW @ (z - y))
            found.append(x)
        return np.stack(found)

    def dynamax(self, library: ModuleType) -> Run:
        """Its belief stands at the first frame, before that is seen.

        Measured in standard deviations: it adds 1e-9 to the variances of the innovation, which are 3e-8 otherwise.
        """
        F = jnp.asarray(self.F)
        parameters = library.ParamsNLGSSM(
            initial_mean=jnp.asarray(self.F @ self.x),
            initial_covariance=jnp.asarray(self.F @ self.P @ self.F.T + self.Q),
            dynamics_function=lambda x: F @ x,
            dynamics_covariance=jnp.asarray(self.Q),
            emission_function=lambda x: self.h(x) / self.sigma,
            emission_covariance=jnp.eye(self.z.shape[1]),
        )
        run = jax.jit(lambda z: library.extended_kalman_filter(parameters, z).filtered_means)
        z = jnp.asarray(self.z / self.sigma)
        return lambda: np.asarray(run(z))

    def cuthbert(self, library: ModuleType) -> Run:
        """In square roots."""
        F, root, R = jnp.asarray(self.F), jnp.asarray(factor(self.Q)), self.sigma * jnp.eye(self.z.shape[1])
        gaussian = import_module("cuthbert.gaussian.moments").build_filter(
            jnp.asarray(self.x),
            jnp.asarray(factor(self.P)),
            lambda state, z: (lambda x: (F @ x, root), state.mean),
            lambda state, z: (lambda x: (self.h(x), R), state.mean, z),
        )
        run = jax.jit(lambda z: library.filter(gaussian, z, gaussian.init_prepare()).mean[1:])
        z = jnp.asarray(self.z)
        return lambda: np.asarray(run(z))

    def kalman_py(self, library: ModuleType) -> Run:
        """On its JAX backend, which finds the Jacobians by itself."""
        F = jnp.asarray(self.F)
        ekf_ = library.ExtendedKalmanFilter(lambda x, dt: F @ x, self.h, self.Q, self.R, self.x, self.P)
        return lambda: np.asarray(ekf_.filter(self.z, 1.0, backend="jax").means)

    def filterpy(self, library: ModuleType) -> Run:
        """A loop over frames in Python."""

        def run() -> np.ndarray:
            f = library.ExtendedKalmanFilter(18, self.z.shape[1])
            f.x, f.P, f.F, f.Q, f.R = self.x.copy(), self.P.copy(), self.F, self.Q, self.R
            found = []
            for z in self.z:
                f.predict()
                y, H = self.linearised(f.x)
                f.update(z, lambda x, H=H: H, lambda x, y=y: y)
                found.append(f.x)
            return np.stack(found)

        return run

    def with_structure(self) -> Callable[[], Estimate]:
        """The default mode and its bank, from the two-view estimate on."""
        return partial(jax.jit(partial(run_trial, method="default")), self.e, self.view)


def factor(P: np.ndarray) -> np.ndarray:
    """A square root L of a covariance that may be singular, P = L L'."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0))


LIBRARIES = {
    "dynamax": "dynamax.nonlinear_gaussian_ssm",
    "cuthbert": "cuthbert",
    "kalman_py": "kalman_py",
    "filterpy": "filterpy.kalman",
    "gtsam": "gtsam",
}


def libraries() -> dict[str, ModuleType]:
    """Those installed; a notice for each that is not."""
    found = {}
    for name, module in LIBRARIES.items():
        try:
            found[name] = import_module(module)
        except ImportError as e:
            print(f"{name} is left out: {e} (python -m pip install '.[bench]')")
    return found


class Answer(NamedTuple):
    """Poses of frames 2 to t-1, and what a frame took."""

    R: np.ndarray  # (t, 3, 3) world to camera
    T: np.ndarray  # (t, 3)
    seconds: float


class Graph:
    """The problem as GTSAM has it: poses, points, a projection each, the length of the base line as gauge."""

    def __init__(self, gtsam: Any, problem: Problem, frames: int) -> None:
        self.gtsam, self.problem = gtsam, problem
        self.z = np.asarray(problem.e.observed)[: frames + 2]
        self.sees = gtsam.noiseModel.Isotropic.Sigma(2, problem.sigma)
        self.camera = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)

    def pose(self, k: int) -> int:
        """Key of a frame."""
        return self.gtsam.symbol("x", k)

    def factors(self, k: int) -> Any:
        """What frame k says."""
        g = self.gtsam
        graph = g.NonlinearFactorGraph()
        for j, z in enumerate(self.z[k]):
            graph.add(g.GenericProjectionFactorCal3_S2(z, self.sees, self.pose(k), g.symbol("p", j), self.camera))
        return graph

    def begun(self) -> tuple[Any, Any]:
        """Factors and values of the base pair, with the points triangulated from it."""
        g, view = self.gtsam, self.problem.view
        graph, values = self.factors(0), g.Values()
        graph.push_back(self.factors(1))
        graph.add(g.PriorFactorPose3(self.pose(0), g.Pose3(), g.noiseModel.Isotropic.Sigma(6, 1e-7)))
        R, T = np.asarray(view.rotation.as_matrix()), np.asarray(view.translation)
        length = g.noiseModel.Isotropic.Sigma(1, 1e-7)
        graph.add(g.RangeFactorPose3(self.pose(0), self.pose(1), float(np.linalg.norm(T)), length))
        values.insert(self.pose(0), g.Pose3())
        values.insert(self.pose(1), g.Pose3(g.Rot3(R.T), -R.T @ T))
        inverse = np.asarray(triangulate(view, *self.problem.e.observed[:2])[0])
        for j, X in enumerate(self.problem.rays / np.maximum(inverse, 1e-3)[:, None]):
            values.insert(g.symbol("p", j), X)
        return graph, values

    def answer(self, poses: list[Any], seconds: float) -> Answer:
        """Of GTSAM's camera poses."""
        R = np.stack([p.rotation().matrix().T for p in poses])
        T = np.stack([-r @ p.translation() for r, p in zip(R, poses, strict=True)])
        return Answer(R, T, seconds)

    def isam2(self) -> Answer:
        """The pose of each frame as it is known then."""
        graph, values = self.begun()
        isam = self.gtsam.ISAM2()
        isam.update(graph, values)
        last, poses, seconds = values.atPose3(self.pose(1)), [], []
        for k in tqdm(range(2, len(self.z)), desc="iSAM2", leave=False, disable=None):
            graph, values = self.factors(k), self.gtsam.Values()
            values.insert(self.pose(k), last)
            began = time.perf_counter()
            isam.update(graph, values)
            last = isam.calculateEstimatePose3(self.pose(k))
            seconds.append(time.perf_counter() - began)
            poses.append(last)
        return self.answer(poses, float(np.median(seconds)))

    def batch(self, begun: Answer) -> Answer:
        """All frames at once, from poses that are near already: those of a filter."""
        graph, values = self.begun()
        for k in range(2, len(self.z)):
            graph.push_back(self.factors(k))
            R, T = begun.R[k - 2], begun.T[k - 2]
            values.insert(self.pose(k), self.gtsam.Pose3(self.gtsam.Rot3(R.T), -R.T @ T))
        optimiser = self.gtsam.LevenbergMarquardtOptimizer(graph, values)
        began = time.perf_counter()
        values = optimiser.optimize()
        seconds = time.perf_counter() - began
        return self.answer([values.atPose3(self.pose(k)) for k in range(2, len(self.z))], seconds)


def beside_gtsam(gtsam: ModuleType, problem: Problem, frames: int, rounds: int) -> tuple[dict[str, float], str]:
    """Ratios, and a table of times and accuracies."""
    run = problem.with_structure()
    seconds = float(np.median(in_turns({"ours": run}, rounds)["ours"])) / FRAMES
    estimate = run()
    ours = Answer(np.asarray(estimate.R)[:frames], np.asarray(estimate.T)[:frames], seconds)
    graph = Graph(gtsam, problem, frames)
    isam2, batch = graph.isam2(), graph.batch(ours)
    truth = np.asarray(problem.e.rotations)[2 : frames + 2], np.asarray(problem.e.translations)[2 : frames + 2]
    rows = []
    for name, found in {"jaxtri, default": ours, "iSAM2": isam2, "batch": batch}.items():
        angles = np.linalg.norm(SO3.from_matrix(jnp.asarray(truth[0] @ found.R.swapaxes(1, 2))).log(), axis=-1)
        shift = np.linalg.norm(truth[1] - found.T, axis=-1)
        cells = 1e3 * found.seconds, np.rad2deg(angles).mean(), 1e3 * shift.mean()
        rows.append([name, *(f"{x:.4g}" for x in cells)])
    n = problem.points
    figures = {
        f"gtsam_isam2_over_ours_n{n}": isam2.seconds / seconds,
        f"gtsam_batch_over_ours_n{n}": batch.seconds / seconds,
        f"gtsam_batch_once_over_ours_n{n}": batch.seconds / frames / seconds,
    }
    return figures, table(["structure and motion", "ms", "geodesic [deg]", "translation [mm]"], rows)


def main() -> None:
    args = parser("How much faster is a frame than with other filters and optimisers?").parse_args()
    found = libraries()
    sizes, rounds = ((30,), 3) if args.quick else ((*SIZES, *LARGE), 5)
    figures: dict[str, float] = {}
    micro: dict[str, dict[int, float]] = {}
    worst, extra = 0.0, ""
    for n in tqdm(sizes, leave=False, disable=None):
        problem = Problem(args.seed, n)
        runs: dict[str, Run] = {"ours": problem.ours(), "numpy_information": problem.numpy_information}
        if n in SIZES:
            runs["numpy_paper"] = problem.numpy_paper
            for name in ("dynamax", "cuthbert", "kalman_py", "filterpy"):
                if name in found:
                    runs[name] = getattr(problem, name)(found[name])
        answers = {name: run() for name, run in runs.items()}
        worst = max(worst, *(np.abs(x - answers["ours"]).max() for x in answers.values()))
        seconds = in_turns(runs, rounds)
        for name, x in seconds.items():
            micro.setdefault(name, {})[n] = 1e6 * float(np.median(x)) / FRAMES
            if name != "ours":
                figures[f"{name}_over_ours_n{n}"] = float(np.median(x / seconds["ours"]))
        if "gtsam" in found and n == (30 if args.quick else 300):
            more, extra = beside_gtsam(found["gtsam"], problem, 20 if args.quick else FRAMES, rounds)
            figures |= more
    figures["answer_difference"] = worst

    def cell(name: str, n: int) -> str:
        if n not in micro[name]:
            return ""
        ratio = figures.get(f"{name}_over_ours_n{n}")
        return f"{micro[name][n]:.0f}" + ("" if ratio is None else f" ({ratio:.3g})")

    rows = [[name, *(cell(name, n) for n in sizes)] for name in micro]
    print("\nmicroseconds a frame (times ours)\n" + table(["", *(f"N = {n}" for n in sizes)], rows))
    print(f"\nanswers apart by {worst:.1g}\n\n{extra}")
    print("\n" + table(["", ""], [[k, f"{v:.3g}"] for k, v in figures.items() if k.startswith("gtsam")]))
    if args.plots is not None:
        plot_growth(micro, "a frame [us]", args.plots / "peers.png")
    report(args.json, figures)


if __name__ == "__main__":
    main()
