"""What every benchmark shares: its options, its JSON file and its way of printing a table.

One file, one question, one command: `--seed`, `--trials` where trials are drawn, `--quick`, `--plots DIR`,
`--json FILE`. Figures are numbers under fixed names; one that could not be had is absent.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from jaxtri.formats import atomic_path, write_json
from jaxtri.output.results import versions


def parser(question: str, *, trials: int | None = None, data: bool = False) -> argparse.ArgumentParser:
    """The options of a benchmark."""
    p = argparse.ArgumentParser(description=question)
    p.add_argument("--seed", type=int, default=0)
    if trials is not None:
        p.add_argument("--trials", type=int, default=trials)
    if data:
        p.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the sequences")
    p.add_argument("--quick", action="store_true", help="under a minute: fewer sequences, frames or trials")
    p.add_argument("--plots", type=Path, metavar="DIR", help="write figures here")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures here")
    return p


def report(path: Path | None, figures: dict[str, float]) -> None:
    """Write the figures, those that are numbers, as the contract has it."""
    if path is not None:
        finite = {k: float(v) for k, v in figures.items() if v is not None and math.isfinite(v)}
        write_json(path, {"command": " ".join(sys.argv), "versions": versions(), "figures": finite})


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Columns aligned: text to the left, numbers to the right."""
    cells = [[str(c) for c in row] for row in [head, *rows]]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    lines = [
        "  ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in cells
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(lines)


def in_turns(runs: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of each in each round, after one that is not timed: noise of the machine meets all alike."""
    for run in runs.values():
        jax.block_until_ready(run())
    seconds = {name: np.empty(rounds) for name in runs}
    for k in range(rounds):
        for name, run in runs.items():
            began = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name][k] = time.perf_counter() - began
    return seconds


def plot_growth(curves: Mapping[str, Mapping[int, float]], label: str, path: Path) -> None:
    """Cost against the number of points, on logarithmic axes; `label` is that of the cost."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure, axis = plt.subplots(figsize=(7.5, 4.5), layout="constrained")
    for name, x in curves.items():
        axis.loglog(list(x), list(x.values()), "o-", label=name)
    axis.set(xlabel="points N", ylabel=label)
    axis.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper")
    with atomic_path(path) as written:
        figure.savefig(written, dpi=120)
    plt.close(figure)
