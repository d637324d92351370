"""What does a gradient of the likelihood cost, over the run itself, in time, memory and compilation?

    OPENBLAS_NUM_THREADS=1 python benchmarks/gradient_cost.py

The paper's experiment, 99 frames of 300 points; the gradient with respect to sigma and both accelerations. `reverse`
and `forward` are modes of differentiation; `block` is the frames between two kept beliefs (`filters.scan`). Times are
medians over interleaved runs, memory is what the compiler sets aside beside arguments and results.

Last answer (2 idle cores, JAX 0.10), over the run, MB and compilation of the gradient:

mode        frames  run     reverse           block 10         forward
default     99      41 ms   5.1  2.2  23 s    5.3  2.0  30 s   4.9  1.0  12 s
default     990     512 ms  5.2  8.6  20 s    5.0  6.3  35 s
consistent  99      522 ms  4.6  25   48 s    5.0  12   73 s   5.7  6.1  35 s

5 times and 20 s are asked. On a machine where the first run takes 25 ms it was 5.2 times, compiled in 18 s.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from contract import in_turns, parser, report, table
from jaxlie import SO3
from jaxtyping import Array

jax.config.update("jax_enable_x64", True)

from jaxtri.estimation.two_view import TwoView, refine  # noqa: E402
from jaxtri.filters import ekf, schmidt  # noqa: E402
from jaxtri.models.trifocal import Trifocal, consistent_start, start  # noqa: E402
from jaxtri.synthetic import paper_experiment  # noqa: E402


class Sequence(NamedTuple):
    """What a run is given."""

    observed: Array  # (t, n, 2)
    view: TwoView


def sequence(seed: int, points: int, frames: int) -> Sequence:
    """The paper's experiment, and its first two frames' relative pose."""
    e = paper_experiment(jax.random.key(seed), n_points=points, n_frames=frames)
    every = jnp.ones(points, bool)
    T, R = e.translations[1], SO3.from_matrix(e.rotations[1])
    return Sequence(e.observed, refine(T, R, e.observed[0], e.observed[1], every, e.sigma))


def loss(mode: str, block: int, noises: Array, data: Sequence) -> Array:
    """Negative log-likelihood at the logarithms of the noises."""
    sigma, acceleration, angular = jnp.exp(noises)
    u, view = data
    pairs, seen = jnp.concatenate([u[0], u[1]], axis=-1), jnp.ones(u[2:].shape[:2], bool)
    sd: dict[str, Any] = {"velocity_sd": 0.02, "angular_velocity_sd": 0.02}
    model = Trifocal(sigma, acceleration, angular, jnp.zeros(()), view.translation)
    if mode == "default":
        says = ekf.filter(model, start(view, **sd), pairs, u[2:], seen, block=block)[1]
    else:
        belief = consistent_start(view, pairs, seen[0], sigma, **sd)
        says = schmidt.filter(model, belief, pairs, u[2:], seen, block=block)[1]
    return -jnp.sum(says.log_likelihood)


class Compiled(NamedTuple):
    """A compiled function, the seconds its compilation took and the megabytes it needs."""

    call: Callable[..., Any]
    compile_s: float
    temp_mb: float


def compiled(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile ahead of time."""
    began = time.perf_counter()
    ready = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    memory = ready.memory_analysis()
    return Compiled(ready, seconds, float("nan") if memory is None else memory.temp_size_in_bytes / 2**20)


def main() -> None:
    options = parser("What does a gradient of the likelihood cost, over the run itself?")
    options.add_argument("--repeats", type=int, default=15)
    args = options.parse_args()
    sizes, repeats = ([99, 990], args.repeats) if not args.quick else ([20], 3)
    points = 30 if args.quick else 300
    figures: dict[str, float] = {}
    rows = []
    for mode in ("default",) if args.quick else ("default", "consistent"):
        for frames in sizes if mode == "default" else sizes[:1]:
            data = sequence(args.seed, points, frames)
            at = jnp.log(jnp.array([1.7e-4, 0.015, 0.02]))
            kinds: dict[str, Callable[..., Any]] = {
                "run": partial(loss, mode, 1),
                "reverse": jax.grad(partial(loss, mode, 1)),
                "reverse, block 10": jax.grad(partial(loss, mode, 10)),
                "forward": jax.jacfwd(partial(loss, mode, 1)),
            }
            if frames > 99 or args.quick:
                del kinds["forward"]
            if args.quick:
                del kinds["reverse, block 10"]
            ready = {k: compiled(f, at, data) for k, f in kinds.items()}
            runs = {k: partial(f.call, at, data) for k, f in ready.items()}
            seconds = {k: np.median(x) for k, x in in_turns(runs, repeats if frames <= 99 else 3).items()}
            for k, f in ready.items():
                ratio = seconds[k] / seconds["run"]
                rows.append(
                    [
                        mode,
                        frames,
                        k,
                        f"{1e3 * seconds[k]:.0f}",
                        f"{ratio:.2f}",
                        f"{f.temp_mb:.2f}",
                        f"{f.compile_s:.1f}",
                    ]
                )
                prefix = "" if (mode, frames) == ("default", sizes[0]) else f"{mode}.t{frames}."
                name = {"reverse": "", "reverse, block 10": "block10.", "forward": "forward."}.get(k)
                if name is not None:
                    figures |= {
                        f"{prefix}{name}gradient_over_forward": ratio,
                        f"{prefix}{name}temp_memory_mb": f.temp_mb,
                        f"{prefix}{name}compile_s": f.compile_s,
                    }
    print(table(["mode", "frames", "", "ms", "over the run", "MB", "compile s"], rows))
    report(args.json, figures)


if __name__ == "__main__":
    main()
