"""How long does a fresh process take to its first pose?

    OPENBLAS_NUM_THREADS=1 python benchmarks/cold_start.py

A process imports the library, starts the default filter from a base pair and gives the pose of the next frame, N = 300;
the time is that from its start to its end. `cold` compiles everything, `cached` finds the programs that an earlier
process kept (`jaxtri.compilation.keep_programs`, which the command line calls). Medians; the import alone beside them.

Last answer (2 idle cores, JAX 0.10): import 1.4 s, cold 5.1 s (3 asked), cached 2.4 s (1.5 asked).
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from contract import parser, report, table

FIRST_POSE = """
import jax
jax.config.update("jax_enable_x64", True)
from jaxtri.compilation import keep_programs
if {folder!r}:
    from pathlib import Path
    keep_programs(Path({folder!r}))
import jax.numpy as jnp
import numpy as np
from jaxlie import SO3
from jaxtri import ekf
from jaxtri.models.trifocal import Trifocal, start
from jaxtri.estimation.two_view import TwoView

rng = np.random.default_rng(0)
points = rng.uniform([-1, -1, 3], [1, 1, 5], (300, 3))
views = [(points + [x, 0.0, 0.0])[:, :2] / points[:, 2:] for x in (0.0, 0.1, 0.2)]
u = [v + rng.normal(0, 2e-4, v.shape) for v in views]


@jax.jit
def first_pose(pairs, seen, z):
    view = TwoView(jnp.array([0.1, 0.0, 0.0]), SO3.identity(), 1e-8 * jnp.eye(6), jnp.asarray(0.0), jnp.asarray(True))
    belief = start(view, velocity_sd=0.02, angular_velocity_sd=0.02)
    model = Trifocal(*map(jnp.asarray, (2e-4, 0.02, 0.02, 0.0)), view.translation)
    return ekf.step(model, belief, pairs, z, seen)[0].mean.motion.translation


T = first_pose(np.concatenate(u[:2], axis=1), np.ones(300, bool), u[2])
assert abs(T[0] - 0.2) < 0.01, T
"""


def seconds(code: str, repeats: int) -> float:
    """Median time of a process that runs it."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)
        found.append(time.perf_counter() - began)
    return float(np.median(found))


def main() -> None:
    args = parser("How long does a fresh process take to its first pose?").parse_args()
    repeats = 1 if args.quick else 5
    figures = {"import_s": seconds("import jaxtri", repeats)}
    figures["cold_s"] = seconds(FIRST_POSE.format(folder=""), repeats)
    with tempfile.TemporaryDirectory() as folder:
        code = FIRST_POSE.format(folder=str(Path(folder)))
        seconds(code, 1)
        figures["cached_s"] = seconds(code, repeats)
    print(table(["", "s"], [[k, f"{v:.2f}"] for k, v in figures.items()]))
    report(args.json, figures)


if __name__ == "__main__":
    main()
