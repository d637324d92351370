"""The rounds of a camera that is not known, their parts replaced; whole ones are in `tests/test_cli.py`."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from jaxtri.errors import InitialisationError, InputWarning
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.zoom_curve import ZoomCurve
from jaxtri.odometry import rounds
from jaxtri.odometry.calibrate import Calibration
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.poses import FramePose
from jaxtri.odometry.run import Run
from jaxtri.odometry.settings import Settings, Status
from jaxtri.odometry.structure import no_points
from jaxtri.trajectory import Trajectory

FIRST = Camera.from_fov(60, 640, 480)


def at(focal, sd=0.02, zoom=None):
    camera = replace(FIRST, fx=FIRST.fx * 0 + focal, fy=FIRST.fy * 0 + focal)
    return Calibration(camera, sd, (6.0, 6.0), (0.01, 0.01), 9, zoom)


@pytest.fixture
def parts(monkeypatch):
    """What each round finds, and what it was called with."""
    parts = SimpleNamespace(found=[], cameras=[], zooms=[], shares=[], how=[], interrupted=[], fails=lambda _: False)

    def track(source, camera, *, settings, record, progress, zoom=None, **how):
        assert record
        parts.zooms.append(zoom)
        parts.cameras.append(float(camera.fx))
        parts.how.append(how)
        if parts.fails(float(camera.fx)):
            raise InitialisationError("no motion")
        interrupted = parts.interrupted.pop(0) if parts.interrupted else False
        odometry = Odometry(camera)
        odometry.poses = [FramePose(float(k), Status.TRACKING) for k in range(7)]
        standing = Trajectory(np.arange(7.0), np.tile(np.eye(4), (7, 1, 1)))
        return Run(standing, no_points(), np.zeros((0, 3), np.uint8), odometry, {"interrupted": interrupted})

    monkeypatch.setattr(rounds, "track", track)
    monkeypatch.setattr(rounds, "calibrate", lambda *_, **__: parts.found.pop(0))

    def go(**options):
        def settings(camera, share):
            parts.shares.append(share)
            return Settings.of(camera)

        return rounds.track_uncalibrated(lambda: nullcontext([]), FIRST, settings=settings, refine=False, **options)

    parts.go = go
    return parts


def test_they_end_where_the_camera_stays(parts):
    parts.found = [at(500.0), at(503.0)]
    run = parts.go()
    assert parts.cameras == [pytest.approx(float(FIRST.fx)), 500.0]
    assert parts.shares == [rounds.TOLERATED, 0.02]
    # What it was tracked with is what is said.
    assert float(run.calibration.camera.fx) == 500.0
    assert run.calibration.focal_sd == 0.02
    assert run.statistics["calibration"]["rounds"] == 2
    assert run.statistics["calibration"]["focal_length_px"] == 500.0


def test_what_does_not_settle_is_known_no_better(parts):
    parts.found = [at(500.0), at(560.0), at(650.0)]
    with pytest.warns(InputWarning, match="560 pixels, give or take 1[5-9]%.*does not determine"):
        run = parts.go()
    assert run.calibration.focal_sd > 0.14
    assert not run.statistics["calibration"]["determined"]


def test_a_zoom_is_followed_in_the_next_round_and_has_to_settle(parts):
    curves = [ZoomCurve(np.array([0.0, 6.0]), np.array([1.0, last]), np.full(2, 0.015)) for last in (1.5, 1.7, 1.71)]
    parts.found = [at(500.0, zoom=z) for z in curves]
    run = parts.go()
    assert parts.zooms == [None, *curves[:2]]
    assert run.calibration.zoom is curves[1]
    assert run.statistics["calibration"]["zoom"]["focal_length_px"] == [500.0, 850.0]
    assert run.calibration.shift(run.calibration.camera, curves[0]) == pytest.approx(np.log(1.7 / 1.5))
    # Between two of its times it is geometric, and constant outside.
    np.testing.assert_allclose(np.exp(curves[0].log(np.array([-1.0, 3.0, 9.0]))), [1.0, 1.5**0.5, 1.5])


def test_an_interrupt_ends_the_clip_there(parts):
    parts.found, parts.interrupted = [at(500.0), at(500.0)], [True]
    run = parts.go()
    assert parts.how == [{}, {"max_frames": 7}]
    assert run.statistics["interrupted"]


def test_other_focal_lengths_are_tried_where_there_is_no_motion(parts):
    parts.found, parts.fails = [at(1200.0), at(1200.0)], lambda focal: focal < 1000
    run = parts.go()
    assert len(parts.cameras) == 4
    assert float(run.calibration.camera.fx) == 1200.0
    parts.fails = lambda focal: True
    with pytest.raises(InitialisationError, match="no motion"):
        parts.go()


def test_a_round_that_finds_no_motion_leaves_the_one_before(parts):
    parts.found, parts.fails = [at(900.0)], lambda focal: focal == 900
    with pytest.warns(InputWarning, match="does not determine"):
        run = parts.go()
    assert len(parts.cameras) == 2
    assert float(run.calibration.camera.fx) == pytest.approx(float(FIRST.fx))
    assert run.calibration.focal_sd > np.log(900 / float(FIRST.fx)) - 1e-6
    assert not run.calibration.determined
