import sys

import numpy as np
import pytest
from tracks import camera

from jaxtri.errors import JaxtriError
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.run import Run
from jaxtri.odometry.structure import Points
from jaxtri.output.viewer import write_recording
from jaxtri.trajectory import Trajectory

FRAMES, POINTS = 7, 11


@pytest.fixture
def run():
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, :3, 3] = rng.normal(size=(FRAMES, 3)).cumsum(axis=0)
    points = Points(np.arange(POINTS), rng.normal(size=(POINTS, 3)), np.tile(np.eye(3), (POINTS, 1, 1)))
    colours = rng.integers(0, 256, (POINTS, 3)).astype(np.uint8)
    return Run(Trajectory(np.arange(FRAMES) / 25, T), points, colours, Odometry(camera()))


def test_a_recording_holds_every_frame_and_every_point(run, tmp_path):
    pytest.importorskip("rerun", reason="the viewer's recordings need rerun: the extra `viewer`")
    chunk = pytest.importorskip("rerun.chunk", reason="this rerun has no reader of recordings")
    path = write_recording(run, camera(), tmp_path / "run.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    found: dict[str, np.ndarray] = {}
    for piece in chunk.RrdReader(str(path)).stream():
        batch = piece.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = column.to_pylist()
            found.setdefault(f"{piece.entity_path} {name}", []).extend(values)
    assert len(found["/world/camera frame"]) == FRAMES
    moved = [x[0] for x in found["/world/camera Transform3D:translation"]]
    order = np.argsort(found["/world/camera frame"])
    np.testing.assert_allclose(np.array(moved)[order], run.trajectory.positions, rtol=1e-6)
    (points,) = found["/world/points Points3D:positions"]
    np.testing.assert_allclose(points, run.points.xyz, rtol=1e-6)
    ((line,),) = found["/world/path LineStrips3D:strips"]
    assert len(line) == FRAMES


def test_without_rerun_the_extra_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(JaxtriError, match=r"jaxtri\[viewer\]"):
        write_recording(run, camera(), tmp_path / "run.rrd")
    assert not list(tmp_path.iterdir())
