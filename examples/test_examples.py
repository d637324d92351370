"""Runs every example and every Python block of the README as a reader would, and looks at what an example prints."""

import ast
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

HERE = Path(__file__).parent
EXAMPLES = sorted(p for p in HERE.glob("*.py") if p != Path(__file__))
BLOCKS = re.findall(r"^```python\n(.*?)^```", (HERE.parent / "README.md").read_text(), re.DOTALL | re.MULTILINE)

# What each prints, and between which numbers what stands in the brackets must lie.
PRINTED = {
    "calibration_gradient": [
        (r"by focal: (\S+), by", 0.02, 0.04),
        (r"by focal: .* differences (\S+)", 0.02, 0.04),
        (r"by k1: (\S+), by", -0.2, -0.1),
        (r"by k1: .* differences (\S+)", -0.2, -0.1),
    ],
    "live": [(r"tracking at .* one sigma (\S+)\n", 0.01, 0.3), (r"(\S+) base lines in 30 frames", 2, 3.5)],
    "own_tracks": [
        (r"ATE (\S+) %", 0.05, 1),
        (r"orientation (\S+) degrees", 0.01, 0.3),
        (r"one sigma (\S+) after", 0.01, 0.1),
        (r"by log sigma: (\S+)", -0.3, 0.3),
    ],
    "pendulum": [(r"filtered: .* (\S+) degrees", 3, 9), (r"smoothed: .* (\S+) degrees", 0.5, 2.5)],
    "range_bearing": [
        (r"(\S+) off, rms", 0.005, 0.05),
        (r"noises \[ *(\S+) ", -0.1, 0.1),
        (r"noises \[ *\S+ +([^\s\]]+) *\]", -0.1, 0.1),
    ],
    "save_load": [(r"(\S+) poses, tracking; the same as without a stop: True", 30, 30), (r"frame (\S+):", 15, 15)],
    "tune": [(r"(\S+) px told", 1, 1), (r"(\S+) px found", 0.09, 0.11)],
    "uncalibrated": [
        (r"focal length (\S+) pixels", 242, 258),
        (r"one sigma (\S+); determined: True", 3.6, 5),
        (r"k1 (\S+), one", -0.17, -0.13),
        (r"(\S+) base lines in 40 frames", 4, 7),
    ],
}


def run(command, folder):
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    if version("jaxlib").startswith("0.10."):  # compiles faster; an unknown flag would end the process
        environment["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"
    done = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_prints_what_it_should(path, tmp_path):
    printed = run([path], tmp_path)
    for pattern, low, high in PRINTED[path.stem]:
        found = re.search(pattern, printed)
        assert found, f"{pattern!r} is not in\n{printed}"
        assert low <= float(found[1]) <= high, printed


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_is_short_and_says_what_it_is(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 40
    assert ast.get_docstring(ast.parse(text))


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_a_block_of_the_readme_runs_as_it_is_printed(block, tmp_path):
    run(["-c", block], tmp_path)
