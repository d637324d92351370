"""The whole pipeline over a generated scene."""

import time
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from footage import clip, dissolving

from jaxtri.errors import CameraError, InputWarning
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.run import track
from jaxtri.odometry.settings import Settings, StartSettings, Status
from jaxtri.output.report import run_text
from jaxtri.trajectory import evaluate
from jaxtri.vision.klt import KLT, KLTSettings
from jaxtri.vision.video import Frame

KLT_SETTINGS = KLTSettings(capacity=128)  # the same everywhere, so that the tracker is compiled once


def test_nothing_is_compiled_once_the_camera_is_followed(compiled):
    """Features come and go, keyframes are made; the first frames that are followed have compiled it all."""
    camera, images, _ = clip()
    jax.clear_caches()  # whatever other tests have compiled
    klt = KLT(KLT_SETTINGS)
    odometry, frames = Odometry(camera, start=StartSettings(lag=0), capacity=klt.settings.capacity), []
    for frame in images:
        tracks = klt.track(frame.image)
        before = len(compiled)
        klt.drop(tracks.ids[odometry.add(tracks.pixels, tracks.visible, frame.time_s, ids=tracks.ids)])
        frames.append((odometry.starts, odometry.keyframes, len(compiled) - before, tracks.fresh.any()))
    starts, keyframes, programs, fresh = map(np.array, zip(*frames, strict=True))
    followed = np.flatnonzero(starts)[2:]
    assert keyframes[-1] > 5
    assert fresh[followed].any()
    assert programs[: followed[0]].sum() > 0
    assert programs[followed].sum() == 0


@pytest.mark.as_users
def test_twenty_frames_are_enough_for_a_trajectory_and_its_points():
    camera, frames, truth = clip()
    run = track(frames, camera, klt=KLT_SETTINGS, progress=False)
    assert set(run.trajectory.status) == {Status.TRACKING}
    found = evaluate(run.trajectory, truth)
    # 0.4 px at 280 px and 1.2 m away is 1.7 mm; the path is half a metre long.
    assert found.ate_percent < 1
    assert found.rotation_rmse_deg < 0.2
    assert len(run.points.ids) > 100
    assert run.colours.shape == run.points.xyz.shape
    assert run.statistics["frames"] == len(frames)
    assert run.statistics["ignored"] == {"share": 0.0, "found": []}


@pytest.mark.parametrize(
    ("size", "remedy"),
    [((320, 240), r"camera\.scaled"), ((480, 640), r"camera\.turned\(90\)"), ((640, 360), "cropped or stretched")],
)
def test_a_camera_of_another_size_is_answered_by_what_makes_it_theirs(size, remedy):
    frames = [Frame(0, 0.0, np.zeros((*size[::-1], 3), np.uint8))]
    with pytest.raises(CameraError, match=remedy):
        track(frames, Camera.from_fov(60, 640, 480), progress=False)


def test_what_is_ignored_of_the_picture_is_said_and_warned_of():
    camera, frames, _ = clip()
    barred = [replace(frame, image=frame.image.copy()) for frame in frames]
    for frame in barred:
        frame.image[:40], frame.image[-40:] = 0, 0
    with pytest.warns(InputWarning, match="3[0-9]% of the picture is ignored.*--no-find-overlays"):
        run = track(barred, camera, klt=KLT_SETTINGS, progress=False)
    ignored = run.statistics["ignored"]
    assert isinstance(ignored, dict)
    assert [part["bottom"] for part in ignored["found"]] == [39, 239]
    text = run_text(run, [])
    assert "% of the picture ignored: bar at x 0 to 319, y 0 to 39, frame 0 to the end; bar at" in text
    plain = KLTSettings(capacity=128, find_overlays=False)
    assert track(barred, camera, klt=plain, progress=False).statistics["ignored"] == {"share": 0.0, "found": []}


def test_a_dissolve_is_taken_back_and_said():
    """The causal poses and the refined ones have none where two shots are one picture, and no track goes over."""
    camera, frames, _ = dissolving(8, 24)
    start = StartSettings(lag=0, flow=0.01)  # what comes before it is short
    with pytest.warns(InputWarning, match=r"frames \d+ to 1\d show two shots at once.*--no-find-dissolves"):
        run = track(frames, camera, klt=KLT_SETTINGS, start=start, refine=True, progress=False)
    (span,) = run.statistics["dissolves"]  # pyright: ignore[reportGeneralTypeIssues]
    first, last = span
    assert 5 < first < 10
    assert 13 < last < 22
    for poses in (run.odometry.poses, run.poses):
        assert {p.status for p in poses[first : last + 1]} <= {Status.LOST, Status.INITIALISING}
        assert {p.T_camera_world is None for p in poses[first : last + 1]} == {True}
    klt = KLTSettings(capacity=128, find_dissolves=False)
    assert track(frames, camera, klt=klt, start=start, progress=False).statistics["dissolves"] == []


def test_the_outcome_is_the_same_whichever_thread_is_slower(monkeypatch):
    """That of one frame after the other, where a frame is followed before the filter has judged the one before it."""
    (camera, images, _), klt = clip(), KLT_SETTINGS
    settings = eqx.tree_at(
        lambda s: s.outlier, Settings.of(camera), jnp.asarray(0.03, float)
    )  # gives up good points, too
    start = StartSettings(lag=4)  # the video is short
    features, odometry = KLT(klt), Odometry(camera, settings, start=start, capacity=klt.capacity)
    outliers = [np.zeros(0, np.int64)] * 2
    for frame in images:
        features.drop(outliers[-2])
        tracks = features.track(frame.image)
        tracks = tracks._replace(visible=tracks.visible & ~np.isin(tracks.ids, outliers[-1]))
        give_up = odometry.add(tracks.pixels, tracks.visible, frame.time_s, ids=tracks.ids)
        outliers.append(tracks.ids[give_up])
    odometry.finish()
    assert sum(map(len, outliers)) > 10
    assert odometry.starts == 1

    for owner, slow in (KLT, KLT.track), (Odometry, Odometry.add):

        def late(self, *arguments, slow=slow, **more):
            time.sleep(0.02)
            return slow(self, *arguments, **more)

        with monkeypatch.context() as patch:
            patch.setattr(owner, slow.__name__, late)
            run = track(images, camera, settings=settings, start=start, klt=klt, progress=False)
        np.testing.assert_array_equal(run.trajectory.T_world_camera, odometry.trajectory().T_world_camera)
