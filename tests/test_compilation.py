import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxtri.compilation import capacity
from jaxtri.formats import read_camera
from jaxtri.odometry.driver import Odometry
from jaxtri.vision.klt import KLT, KLTSettings
from jaxtri.vision.video import open_source

DATA = Path(__file__).parents[2] / "shared" / "data" / "indoor_7scenes_kitchen"


@pytest.mark.parametrize(("count", "size"), [(0, 64), (1, 64), (64, 64), (65, 128), (800, 1024)])
def test_capacities_come_in_a_few_sizes(count, size):
    assert capacity(count) == size


def test_programs_are_kept_for_later_processes(tmp_path):
    """The second process compiles nothing; JAX's own setting goes first."""
    code = (
        "from pathlib import Path; import jax\n"
        "from jaxtri.compilation import keep_programs\n"
        "keep_programs(Path({0!r}))\n"
        "hits = []\n"
        "jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))\n"
        "jax.jit(lambda x: x * 2 + 1)(1.0)\n"
        "print(sum(name.endswith('/cache_hits') for name in hits))\n"
    )
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | {"JAX_PLATFORMS": "cpu"}

    def run(**more):
        command = [sys.executable, "-c", code.format(str(ours))]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment | more)
        return int(done.stdout)

    assert [run(), run() > 0] == [0, True]
    run(JAX_COMPILATION_CACHE_DIR=str(theirs), JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
    assert any(theirs.iterdir())


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real sequence in {DATA}")
def test_nothing_is_compiled_once_the_camera_is_followed():
    """Features come and go, keyframes are made; the first frames that are followed have compiled it all."""
    compiled: list[float] = []

    def listen(name, duration, **_):
        if name.endswith("/backend_compile_duration"):
            compiled.append(duration)

    # A number of features that no other test has compiled for.
    klt, odometry, frames = KLT(KLTSettings(capacity=120)), Odometry(read_camera(DATA / "camera.json")), []
    jax.monitoring.register_event_duration_secs_listener(listen)
    with open_source(DATA) as source:
        for frame, _ in zip(source, range(90), strict=False):
            tracks = klt.track(frame.image)
            before = len(compiled)
            klt.drop(tracks.ids[odometry.add(tracks.pixels, tracks.visible, frame.time_s, ids=tracks.ids)])
            frames.append((odometry.starts, odometry.keyframes, len(compiled) - before, tracks.fresh.any()))
    segments, keyframes, programs, fresh = map(np.array, zip(*frames, strict=True))
    followed = np.flatnonzero(segments)[2:]
    assert keyframes[-1] > 5
    assert fresh[followed].any()
    assert programs[: followed[0]].sum() > 0
    assert programs[followed].sum() == 0
