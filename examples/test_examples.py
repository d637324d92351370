"""Runs every example and the README's Python, and looks at what they print."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
# A pattern of the output, and the range that the number in it must lie in.
SAID = {
    "own_tracks": (r"ATE ([\d.]+) %", 0, 0.6),
    "pendulum": (r"smoothed: the angle is ([\d.]+) degrees", 0, 1.5),
    "range_bearing": (r"([\d.]+) off, rms", 0, 0.2),
    "tune": (r"([\d.]+) px found", 0.09, 0.11),
    "calibration_gradient": (r"by focal: (\S+),", -10, 10),
    "save_load": (r"gone on with: (\S+) apart", 0, 0),
    "live": (r"(\d+) points; the unit", 100, 2000),
}


def run(code: list[str], folder: Path) -> str:
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg"}
    done = subprocess.run([sys.executable, *code], capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_every_example_is_tested_and_short():
    files = {p.stem: p for p in HERE.glob("*.py") if p != Path(__file__)}
    assert files.keys() == SAID.keys()
    assert all(len(p.read_text().splitlines()) <= 40 for p in files.values())


@pytest.mark.parametrize("name", sorted(SAID))
def test_an_example_prints_a_good_result(name, tmp_path):
    printed = run([str(HERE / f"{name}.py")], tmp_path)
    pattern, low, high = SAID[name]
    found = re.search(pattern, printed)
    assert found, printed
    assert low <= float(found[1]) <= high, printed


def test_the_gradient_by_the_calibration_is_that_of_differences(tmp_path):
    printed = run([str(HERE / "calibration_gradient.py")], tmp_path)
    for slope, difference in re.findall(r"by \w+: (\S+), by differences (\S+)", printed):
        assert float(slope) == pytest.approx(float(difference), rel=1e-2)


def test_the_readme_runs_as_printed(tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```$", (HERE.parent / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    assert blocks
    for block in blocks:
        printed = run(["-c", block], tmp_path)
        slope = re.search(r"slope by the noise in pixels: (\S+)", printed)
        assert slope, printed
        assert 0.5 < float(slope[1]) < 3, printed
