import dataclasses

import jax
import numpy as np
import pytest
from tracks import CAPACITY, make, sideways

from jaxtri.errors import InitialisationError, InputError
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.refine import refine
from jaxtri.odometry.run import follow_tracks
from jaxtri.odometry.settings import Base, Settings, StartSettings, Status
from jaxtri.odometry.start import Start, step_tracks
from jaxtri.trajectory import Trajectory, evaluate


def errors(tracks, odometry):
    times = np.arange(len(tracks.R), dtype=float)
    return evaluate(odometry.trajectory(), Trajectory(times, tracks.T_world_camera))


@pytest.mark.parametrize("base", [pytest.param(Base.TRACKS, marks=pytest.mark.as_users), Base.INHERIT, Base.PAPER])
def test_every_kind_of_base_recovers_the_trajectory(base):
    tracks = sideways(40)
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, base=base)
    found = errors(tracks, odometry)
    # 0.3 px at 500 px and 4 m deep is 2.4 mm; the path is 1.2 m. Consecutive base frames see 0.4 degrees.
    limit = {Base.TRACKS: 0.6, Base.INHERIT: 0.6, Base.PAPER: 3.0}[base]
    assert found.ate_percent < limit
    assert found.rotation_rmse_deg < limit / 2
    assert [p.status for p in odometry.poses] == [Status.TRACKING] * 40
    assert odometry.starts == 1
    assert odometry.scale_unknown_from is None


@pytest.mark.parametrize("base", list(Base))
def test_points_are_refined_in_every_frame_and_outlive_their_tracks(base):
    tracks = sideways(40)
    settings = Settings.of(tracks.camera, noise_px=0.3)
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, base=base, settings=settings)
    points = odometry.points()
    ended = ~tracks.visible[-1][points.ids]
    assert ended.sum() > 5
    assert (~ended).sum() > 60
    # The scale is the gauge, and its drift the trajectory's affair.
    truth = ((tracks.points - tracks.centres[0]) @ tracks.R[0].T)[points.ids]
    scale = np.median(np.sum(truth * points.xyz, axis=1) / np.sum(points.xyz**2, axis=1))
    error = scale * points.xyz - truth
    # A base pair alone, 0.3 px over some 2 degrees, leaves 1.5 %.
    relative = np.abs(error[:, 2]) / truth[:, 2]
    assert np.median(relative) < 0.004
    # The stated deviations are those of the points on their own, without the drift of the poses.
    stated = scale * np.sqrt(points.covariance[:, 2, 2]) / truth[:, 2]
    assert 0.3 < np.median(relative / stated) / 0.67 < 3


def test_single_pairs_restart_and_keep_the_scale():
    t = np.arange(70)[:, None]
    # Points leave on one side, and every new pair has but what is left: a long way past a long wall.
    tracks = make(t * [0.05, 0.0, 0.0], 0 * t * [0.0, 0.0, 0.0], depth=3.0)
    rng = np.random.default_rng(1)
    pixels, visible = tracks.pixels.copy(), tracks.visible.copy()
    # New tracks are born in the slots of those that left, from points further along the wall.
    fresh_points = rng.uniform([0, -1.2, 2], [5, 1.2, 4.2], (CAPACITY, 3))
    ids = np.tile(np.arange(CAPACITY), (70, 1))
    for n, X in enumerate(fresh_points):
        gone = np.flatnonzero(~visible[:, n])
        x = (X - tracks.centres) / X[2]
        u = np.c_[500 * x[:, 0] + 320, 500 * x[:, 1] + 240]
        inside = (u > 0).all(1) & (u < [640, 480]).all(1)
        again = np.flatnonzero(inside & (np.arange(70) >= (gone[0] if gone.size else 70)))
        pixels[again, n] = u[again] + rng.normal(scale=0.3, size=(again.size, 2))
        visible[again, n] = True
        ids[again, n] += CAPACITY
    for base in (Base.INHERIT, Base.PAPER):
        odometry = Odometry(tracks.camera, base=base)
        for k in range(70):
            odometry.add(pixels[k], visible[k], float(k), ids=ids[k])
        assert odometry.changes >= 1
        assert odometry.starts == 1
        found = errors(tracks, odometry)
        assert found.ate_percent < 3


def test_frames_before_the_first_motion_are_filled_in():
    tracks = make(np.maximum(np.arange(30) - 10, 0)[:, None] * [0.04, 0, 0], np.zeros((30, 3)))
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible)
    assert all(p.status is Status.TRACKING for p in odometry.poses)
    assert errors(tracks, odometry).ate_percent < 0.3


def test_a_plane_starts_with_the_right_one_of_its_two_poses():
    for seed in range(3):
        tracks = sideways(25, plane=True, seed=seed)
        found = errors(tracks, follow_tracks(tracks.camera, tracks.pixels, tracks.visible))
        assert found.rotation_rmse_deg < 0.3
        assert found.ate_percent < 2


@pytest.mark.parametrize("case", ["static", "rotation"])
def test_no_parallax_waits_and_says_so(case):
    t = np.arange(30)[:, None]
    turns = {"static": 0 * t * np.zeros(3), "rotation": t * [0.0, 0.01, 0.003]}[case]
    tracks = make(np.zeros((30, 3)), turns)
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible)
    assert all(p.status is Status.INITIALISING for p in odometry.poses)
    with pytest.raises(InitialisationError, match={"static": "flow", "rotation": "parallax"}[case]):
        odometry.trajectory()


def test_too_few_points_wait():
    tracks = sideways(20)
    visible = tracks.visible.copy()
    visible[:, 6:] = False
    odometry = follow_tracks(tracks.camera, tracks.pixels, visible)
    with pytest.raises(InitialisationError, match=r"features|tracks"):
        odometry.trajectory()


def test_what_stands_in_masked_tracks_changes_nothing():
    tracks = sideways(20)
    visible = tracks.visible & (np.random.default_rng(3).random(tracks.visible.shape[1]) < 0.9)
    clean = follow_tracks(tracks.camera, tracks.pixels, visible).trajectory()
    for value in (np.nan, 1e30):
        dirty = np.where(visible[..., None], tracks.pixels, value)
        found = follow_tracks(tracks.camera, dirty, visible).trajectory()
        np.testing.assert_array_equal(found.T_world_camera, clean.T_world_camera)
        np.testing.assert_array_equal(found.covariance, clean.covariance)
    # A NaN that claims to be visible is as good as unseen.
    claimed = follow_tracks(tracks.camera, np.where(visible[..., None], tracks.pixels, np.nan), visible | True)
    np.testing.assert_array_equal(claimed.trajectory().T_world_camera, clean.T_world_camera)


def covered(**start) -> Odometry:
    """A run whose lens is covered for a while; what comes after it has nothing to do with what was before."""
    first, second = sideways(20), sideways(45, seed=5)
    pixels = np.concatenate([first.pixels, second.pixels])
    visible = np.concatenate([first.visible, second.visible])
    visible[20:24] = False  # the lens is covered for a while
    ids = np.repeat(np.arange(2), [20, 45])[:, None] * CAPACITY + np.arange(CAPACITY)
    odometry = Odometry(first.camera, start=StartSettings.of(Base.TRACKS, **start), record=True)
    for k in range(65):
        odometry.add(pixels[k], visible[k], float(k), ids=ids[k])
    odometry.finish()
    return odometry


def test_a_complete_loss_starts_anew_and_says_that_the_scale_is_unknown():
    odometry = covered()
    status = [p.status for p in odometry.poses]
    assert status[:20] == [Status.TRACKING] * 20
    assert status[20:24] == [Status.LOST] * 4
    assert status[24] is Status.RESTARTED
    assert status[25:] == [Status.TRACKING] * 40
    assert odometry.starts == 2
    assert odometry.scale_unknown_from == 24
    assert np.isfinite(odometry.trajectory().T_world_camera).all()


def fed(odometry, pixels, visible, begin=0):
    """The odometry, once it has taken the tracks of a shot, with numbers of their own, in frames from `begin` on."""
    for k in range(len(pixels)):
        odometry.add(pixels[k], visible[k], float(begin + k), ids=begin * CAPACITY + np.arange(CAPACITY))
    odometry.finish()
    return odometry


def test_a_cut_takes_back_what_lies_between_two_shots_and_each_is_as_it_is_alone():
    first, second = sideways(30), sideways(45, seed=5)
    mixed = first.pixels.copy()
    mixed[20:] += np.linspace(0, 30, 10)[:, None, None]  # what has come of the tracks meanwhile
    one = fed(Odometry(first.camera, record=True), mixed[:20], first.visible[:20])
    other = fed(Odometry(first.camera), second.pixels, second.visible)
    odometry = fed(Odometry(first.camera, record=True), mixed, first.visible)
    assert odometry.status is Status.TRACKING
    odometry.cut(20)
    fed(odometry, second.pixels, second.visible, 30)
    status = [p.status for p in odometry.poses]
    assert status[20:30] == [Status.LOST] * 10
    assert status[30] is Status.RESTARTED
    assert set(status[:20] + status[31:]) == {Status.TRACKING}
    assert (odometry.base_pair, odometry.scale_unknown_from) == (one.base_pair, 30)
    np.testing.assert_array_equal(
        [p.T_camera_world for p in odometry.poses[:20]], [p.T_camera_world for p in one.poses]
    )
    jax.tree.map(np.testing.assert_array_equal, odometry.recording(), one.recording())
    # The second shot in its own world, and in the units that it has when it comes first.
    T = np.stack([p.T_camera_world for p in odometry.poses[30:]])
    T = T @ np.linalg.inv(T[0])
    alone = np.stack([p.T_camera_world for p in other.poses])
    T[:, :3, 3] *= np.linalg.norm(alone[-1, :3, 3]) / np.linalg.norm(T[-1, :3, 3])
    np.testing.assert_allclose(T, alone, atol=1e-3)  # in base lines; what is assumed of the gauge is no ratio
    assert [part["frames"] for part in refine(odometry).statistics["parts"]] == [[0, 19], [30, 74]]


def test_a_cut_takes_back_a_start_that_came_after_it():
    first, second = sideways(30), sideways(45, seed=5)
    odometry = fed(Odometry(first.camera, record=True), first.pixels, first.visible)
    for frame in (-1, 31):
        with pytest.raises(InputError, match=f"frame {frame} of 30"):
            odometry.cut(frame)
    odometry.cut(0)
    assert {p.status for p in odometry.poses} == {Status.INITIALISING}
    assert (odometry.base_pair, odometry.starts, odometry.scale_unknown_from) == (None, 0, None)
    with pytest.raises(InitialisationError, match="dissolves into another"):
        odometry.trajectory()
    fed(odometry, second.pixels, second.visible, 30)
    alone = fed(Odometry(first.camera), second.pixels, second.visible, 30)
    found, right = ([p.T_camera_world for p in poses] for poses in (odometry.poses[30:], alone.poses))
    np.testing.assert_array_equal(found, right)
    assert (odometry.starts, odometry.scale_unknown_from) == (1, None)
    assert len(odometry.recording().pixels) == 45


def test_frames_that_come_while_a_start_is_worked_out_change_nothing():
    at_once = covered(lag=0)
    for lag in (5, 100):
        late = covered(lag=lag)
        assert [p.status for p in late.poses] == [p.status for p in at_once.poses]
        assert (late.base_pair, late.scale_unknown_from) == (at_once.base_pair, at_once.scale_unknown_from)
        results = ((o.trajectory().T_world_camera, o.points(), o.recording()) for o in (at_once, late))
        jax.tree.map(np.testing.assert_array_equal, *results)


def test_an_error_while_a_start_is_worked_out_is_raised(monkeypatch):
    def fail(*_):
        raise MemoryError("no room")

    monkeypatch.setattr("jaxtri.odometry.beginning.find", fail)
    tracks = sideways(20)
    with pytest.raises(MemoryError, match="no room"):
        follow_tracks(tracks.camera, tracks.pixels, tracks.visible)


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype")
def test_a_start_is_worked_out_as_its_caller_has_set_jax(monkeypatch):
    seen = []

    def find(*_):
        seen.append((jax.enable_x64.value, jax.default_device.value))
        return Start(None, "not now")

    monkeypatch.setattr("jaxtri.odometry.beginning.find", find)
    tracks, device = sideways(20), jax.devices("cpu")[0]
    with jax.enable_x64(False), jax.default_device(device):
        follow_tracks(tracks.camera, tracks.pixels, tracks.visible)
    assert seen
    assert set(seen) == {(False, device)}


def test_frames_that_make_no_sense_are_coasted_over():
    tracks = sideways(40)
    pixels = tracks.pixels.copy()
    pixels[25:28] = np.random.default_rng(0).uniform([0, 0], [640, 480], pixels[25:28].shape)
    odometry = follow_tracks(tracks.camera, pixels, tracks.visible)
    status = [p.status for p in odometry.poses]
    assert status[25:28] == [Status.COASTING] * 3
    assert status[:25] + status[28:] == [Status.TRACKING] * 37
    sd = np.sqrt([np.trace(p.covariance) for p in odometry.poses])
    assert sd[27] > 2 * sd[24]
    assert sd[28] < 2 * sd[24]
    assert errors(tracks, odometry).ate_percent < 2


def test_a_skipped_frame_costs_neither_tracks_nor_accuracy():
    """Exact pixels of a camera that turns by 16 degrees and moves by five steps where a frame is missing."""
    t = np.arange(40)[:, None]
    jump = (t >= 20) * 1.0
    tracks = make(t * [0.03, 0.002, 0.004] + jump * [0.15, 0.0, 0.1], jump * [0.0, np.deg2rad(16), 0.0], noise_px=0.0)
    assert tracks.visible[21].sum() > 40
    odometry = Odometry(tracks.camera)
    for k in range(40):
        assert not odometry.add(tracks.pixels[k], tracks.visible[k], float(k)).any()
    odometry.finish()
    assert [p.status for p in odometry.poses] == [Status.TRACKING] * 40
    estimate = odometry.trajectory().rotations
    found = np.einsum("tji,tjk->tik", tracks.R[0] @ np.swapaxes(tracks.R, 1, 2), estimate)
    angles = np.rad2deg(np.arccos(np.clip((np.trace(found, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angles.max() < 0.004


def test_frames_whose_numbers_do_not_hold_together_are_uncertain():
    tracks = sideways(40)
    pixels, visible = tracks.pixels.copy(), tracks.visible.copy()
    rng = np.random.default_rng(0)
    pixels[25] += rng.normal(scale=1.2, size=pixels[25].shape)  # three times the noise that is said
    astray = np.flatnonzero(visible[30])[: int(0.6 * visible[30].sum())]
    pixels[30, astray] = rng.uniform([0, 0], [640, 480], (len(astray), 2))
    odometry = follow_tracks(tracks.camera, pixels, visible)
    found = {k: p for k, p in enumerate(odometry.poses) if p.status is Status.UNCERTAIN}
    assert found.keys() == {25, 30}
    assert "their noise explains" in found[25].doubts[0]
    assert f"{found[30].used} of {found[30].measured} points" in found[30].doubts[0]
    assert all(not p.doubts for p in odometry.poses if p.status is Status.TRACKING)
    good = [p for p in odometry.poses if p.status is Status.TRACKING]
    assert max(p.rotation_sd_deg for p in good) < 1
    assert min(p.parallax_deg for p in good[15:]) > 0.3


def test_a_changing_number_of_features_never_recompiles():
    tracks = sideways(30)
    follow_tracks(tracks.camera, tracks.pixels, tracks.visible)
    compiled = step_tracks._cache_size()
    rng = np.random.default_rng(0)
    visible = np.logical_and.accumulate(tracks.visible & (rng.random(tracks.visible.shape) < 0.97), axis=0)
    follow_tracks(tracks.camera, tracks.pixels, visible)
    assert step_tracks._cache_size() == compiled


def test_a_number_of_tracks_more_compiles_nothing():
    tracks = sideways(30)
    follow_tracks(tracks.camera, tracks.pixels[:, :120], tracks.visible[:, :120])
    compiled = step_tracks._cache_size()
    follow_tracks(tracks.camera, tracks.pixels[:, :121], tracks.visible[:, :121])
    assert step_tracks._cache_size() == compiled


def test_rows_may_come_in_any_order_and_number():
    """A track keeps its slot whatever its row: from its second frame on nothing but the numbers counts."""
    tracks, rng = sideways(30), np.random.default_rng(0)
    columns, rows = (Odometry(tracks.camera, capacity=CAPACITY) for _ in range(2))
    for k, (pixels, visible) in enumerate(zip(tracks.pixels, tracks.visible, strict=True)):
        order = np.arange(CAPACITY) if k == 0 else rng.permutation(CAPACITY)
        # Of those that are not visible some come along, and some do not.
        order = order[visible[order] | (rng.random(CAPACITY) < 0.5)] if k else order
        given_up = columns.add(pixels, visible, float(k)), rows.add(pixels[order], visible[order], float(k), ids=order)
        np.testing.assert_array_equal(given_up[0][order], given_up[1])
    for found, expected in zip(rows.poses, columns.poses, strict=True):
        assert (found.status, found.used) == (expected.status, expected.used)
        np.testing.assert_array_equal(found.T_camera_world, expected.T_camera_world)
        np.testing.assert_array_equal(found.covariance, expected.covariance)
    jax.tree.map(np.testing.assert_array_equal, rows.points(), columns.points())


def test_the_latest_frame_is_the_newest_that_has_been_taken_in():
    tracks, lag = sideways(20), 4
    odometry = Odometry(tracks.camera, start=StartSettings(lag=lag))
    assert odometry.latest is None
    behind, known = [], []
    for k in range(20):
        odometry.add(tracks.pixels[k], tracks.visible[k], float(k))
        behind.append(k - int(odometry.latest.time))
        known.append(odometry.latest.T_camera_world is not None)
    begun = known.index(True)
    assert not any(known[:begun])
    assert all(known[begun:])
    # The frames wait while the start is worked out, then two are taken in for each that comes.
    assert behind[:begun] == [0] * (begun - lag + 1) + list(range(1, lag))
    assert behind[begun:] == [*range(lag - 2, 0, -1), *[0] * (20 - begun - lag + 2)]
    assert odometry.latest is odometry.poses[-1]
    assert odometry.latest.status is Status.TRACKING


def test_the_paper_start_overlaps_as_asked():
    tracks = sideways(30)
    start = dataclasses.replace(StartSettings.of(Base.PAPER), restart=0.97, overlap=3)
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, base=Base.PAPER, start=start)
    assert odometry.changes >= 1
    assert errors(tracks, odometry).ate_percent < 5


def test_wrong_input_is_named():
    tracks = sideways(3)
    with pytest.raises(InputError, match="does not follow"):
        follow_tracks(tracks.camera, tracks.pixels, tracks.visible, np.array([0.0, 1.0, 1.0]))
    with pytest.raises(InputError, match=r"\(t, n, 2\)"):
        follow_tracks(tracks.camera, tracks.pixels[..., 0], tracks.visible)
    with pytest.raises(InputError, match="width"):
        Odometry(dataclasses.replace(tracks.camera, width=None))


def test_the_stated_covariance_is_that_of_the_errors():
    # Drift included, since the keyframes' errors are carried along: the normalised error squared of the six
    # pose components is 6 on average, at the first base pair, in the middle and at the end. The mean over 20
    # runs has a standard deviation of sqrt(12 / 20) = 0.8.
    found = []
    for seed in range(20):
        tracks = sideways(30, seed=seed)
        settings = Settings.of(tracks.camera, noise_px=0.3)
        odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, settings=settings)
        first, second = odometry.base_pair
        scale = np.linalg.norm(tracks.centres[second] - tracks.centres[first])
        estimate = odometry.trajectory()
        for k in (second, 17, 29):
            position = estimate.positions[k] - (tracks.centres[k] - tracks.centres[0]) / scale
            turn = tracks.R[k] @ estimate.rotations[k]
            error = np.append(position, [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            error[3:] /= 2
            # The first base line has no error in length: the covariance there is singular.
            found.append(error @ np.linalg.pinv(estimate.covariance[k], rcond=1e-9) @ error)
    mean = np.array(found).reshape(20, 3).mean(axis=0)
    assert mean[0] == pytest.approx(5, abs=3)
    assert mean[1:] == pytest.approx(6, abs=3)
