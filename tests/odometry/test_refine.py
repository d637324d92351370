import numpy as np
import pytest
from tracks import make, sideways

from jaxtri.errors import InitialisationError, InputError
from jaxtri.estimation import batch
from jaxtri.odometry import adjusted, adjustment, stretches
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.refine import refine
from jaxtri.odometry.run import follow_tracks
from jaxtri.odometry.settings import Settings, Status
from jaxtri.trajectory import Trajectory, evaluate


def drifting(frames, *, seed=0, px=0.3):
    """Tracks whose errors are walks, as those of optical flow are, and some of which slip."""
    t = np.arange(frames)[:, None]
    tracks = make(t * [0.04, 0.002, 0.006], t * [0.0, 0.002, 0.001], noise_px=0.0, seed=seed)
    rng = np.random.default_rng(seed)
    pixels = tracks.pixels + np.cumsum(rng.normal(scale=px / 3, size=tracks.pixels.shape), axis=0)
    slips = rng.choice(pixels.shape[1], 12, replace=False)
    pixels[frames // 2 :, slips] += rng.uniform(-15, 15, (12, 2))
    return tracks._replace(pixels=pixels)


def errors(tracks, trajectory):
    truth = Trajectory(np.arange(len(tracks.R), dtype=float), tracks.T_world_camera)
    return evaluate(trajectory, truth)


@pytest.fixture(scope="module")
def run():
    tracks = drifting(40)
    return tracks, follow_tracks(tracks.camera, tracks.pixels, tracks.visible, record=True)


def test_refined_poses_are_nearer_and_the_rest_stays(run):
    tracks, odometry = run
    found = refine(odometry)
    before, after = errors(tracks, odometry.trajectory()), errors(tracks, found.trajectory())
    assert after.rpe_rotation_deg < 0.85 * before.rpe_rotation_deg
    assert after.rpe_translation_percent < before.rpe_translation_percent
    assert after.ate_percent < 0.1
    assert [p.status for p in found.poses] == [p.status for p in odometry.poses]
    assert found.keyframes[0] == odometry.base_pair[0]
    assert found.keyframes[-1] == 39
    assert 3 < len(found.keyframes) < 39
    # The gauge: the first pose, and how far away the farthest keyframe is.
    first = odometry.base_pair[0]
    np.testing.assert_allclose(found.poses[first].T_camera_world, odometry.poses[first].T_camera_world, atol=1e-12)
    lengths = [
        np.linalg.norm(t.positions[39] - t.positions[first]) for t in (odometry.trajectory(), found.trajectory())
    ]
    np.testing.assert_allclose(*lengths, rtol=1e-9)
    # Points: at least as near to where they are as the recursive ones.
    points = found.points
    truth = ((tracks.points - tracks.centres[0]) @ tracks.R[0].T)[points.ids]
    scale = np.median(np.sum(truth * points.xyz, axis=1) / np.sum(points.xyz**2, axis=1))
    assert np.median(np.linalg.norm(scale * points.xyz - truth, axis=1) / truth[:, 2]) < 0.01
    assert len(np.unique(points.ids)) == len(points.ids) > 80
    (part,) = found.statistics["parts"]
    assert part["refined"]
    assert part["converged"]


def test_looks_at_what_moves_by_itself_are_left_out(run):
    _, odometry = run
    first, moved = odometry.base_pair[0], odometry.base_pair[0] + 20
    before, whole = odometry.tracks[moved], stretches.Segment.of(odometry, np.arange(first, 40))
    lone = np.arange(len(before.visible)) % 5 == 0
    odometry.tracks[moved] = before._replace(moving=lone)
    try:
        without = stretches.Segment.of(odometry, np.arange(first, 40))
    finally:
        odometry.tracks[moved] = before
    expected = whole.seen.copy()
    expected[20] &= ~lone
    np.testing.assert_array_equal(without.seen, expected)
    assert (without.seen != whole.seen).sum() > 10


def test_a_keyframe_comes_where_half_of_the_tracks_are_gone(run):
    _, odometry = run
    settings, whole = odometry.settings, stretches.Segment.of(odometry, np.arange(odometry.base_pair[0], 40))
    # All but what hardly moves ends one frame after each third: what is left would make no keyframe for long.
    shift = np.linalg.norm(whole.u[-1] - whole.u[0], axis=1)
    lasting = np.argsort(np.where(whole.seen.all(axis=0), shift, np.inf))[: int(settings.keyframe_common) + 10]
    seen = np.zeros_like(whole.seen)
    seen[:, lasting] = True
    seen[:2] = whole.seen[:2]
    still = whole._replace(u=np.broadcast_to(whole.u[0], whole.u.shape), seen=seen)
    np.testing.assert_array_equal(stretches.keyframes(settings, still), [0, 2, len(seen) - 1])


def test_frames_beside_a_jump_between_two_keyframes():
    """A turn of 16 degrees from one frame to the next, which two fifths of the tracks do not survive."""
    t, rng = np.arange(40)[:, None], np.random.default_rng(0)
    jump = (t >= 21) * np.array([0.15, 0.0, 0.1])
    turn = t * [0.0, 1e-3, 0.0] + (t >= 21) * [0.0, np.deg2rad(16), 0.0]
    tracks = make(t * [0.03, 0.002, 0.004] + jump, turn, noise_px=0.1)
    wrong = np.flatnonzero(rng.random(tracks.pixels.shape[1]) < 0.45)
    tracks.pixels[21:, wrong] += np.array([200.0, -40.0]) + rng.normal(scale=30, size=(len(wrong), 2))
    odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, record=True)
    found = refine(odometry)
    beside = {18, 19, 20} - set(found.keyframes)
    assert beside
    for k in beside:
        assert found.poses[k].status is Status.TRACKING
        assert found.poses[k].used > 0.9 * found.poses[k].measured
    assert errors(tracks, odometry.trajectory()).ate_percent < 0.3
    assert errors(tracks, found.trajectory()).ate_percent < 0.15


@pytest.mark.parametrize("noise_px", [0.05, 0.4])
def test_errors_are_no_larger_than_they_are_said_to_be(noise_px):
    """NEES of the rotation of some frames: the noise is found where it was assumed too small, and never taken back."""
    nees, over = [], []
    for seed in range(6):
        tracks = drifting(40, seed=seed, px=0.1)
        settings = Settings.of(tracks.camera, noise_px=noise_px)
        odometry = follow_tracks(tracks.camera, tracks.pixels, tracks.visible, settings=settings, record=True)
        found = refine(odometry)
        over.append(found.statistics["parts"][0]["noise_over_assumed"])
        for k in (12, 20, 28, 36):
            pose = found.poses[k]
            R = tracks.R[k] @ tracks.R[0].T @ pose.T_camera_world[:3, :3].T
            theta = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
            nees.append(theta @ np.linalg.solve(pose.covariance[3:, 3:], theta))
    assert (np.array(over) > 1).all() if noise_px < 0.1 else (np.array(over) < 0.5).all()
    assert (0.3 if noise_px < 0.1 else 0.01) < np.mean(nees) / 3 < 3


def test_long_sequences_are_cut_into_blocks(run, monkeypatch):
    """The same run in blocks of four keyframes, tracks cut where they reach over more than two: nearly as good."""
    tracks, odometry = run
    whole = refine(odometry)
    monkeypatch.setattr(stretches, "SIZES", (2, 4))
    monkeypatch.setattr(stretches, "PLACES", 128)
    monkeypatch.setattr(stretches, "CHUNKS", 1)
    cut = refine(odometry)
    assert cut.statistics["parts"][0]["tracks"] > whole.statistics["parts"][0]["tracks"]
    assert errors(tracks, cut.trajectory()).ate_percent < 1.5 * errors(tracks, whole.trajectory()).ate_percent + 0.02


def test_another_sequence_compiles_nothing(run):
    """Other frames, keyframes, tracks and looks: what one refinement has compiled serves the next one."""
    programs = batch.normal_equations, batch._stepped, batch._known, adjustment._begun, adjusted._measured
    first = refine(run[1])
    compiled = [program._cache_size() for program in programs]
    assert all(compiled)
    tracks = drifting(30, seed=3, px=0.1)
    second = refine(follow_tracks(tracks.camera, tracks.pixels, tracks.visible, record=True))
    assert len(first.keyframes) != len(second.keyframes)
    assert [program._cache_size() for program in programs] == compiled


def test_each_stretch_is_refined_by_itself_and_hangs_on_the_one_before():
    """The camera is lost, and found again: two parts."""
    tracks = drifting(70, px=0.1)
    pixels, visible = tracks.pixels.copy(), tracks.visible.copy()
    visible[:, 64:] = False
    visible[34:, :64] = False
    again = sideways(36)
    pixels[34:, 64:], visible[34:, 64:] = again.pixels[:, 64:], again.visible[:, 64:]
    odometry = follow_tracks(tracks.camera, pixels, visible, record=True)
    assert odometry.starts == 2
    found = refine(odometry)
    assert [p["refined"] for p in found.statistics["parts"]] == [True, True]
    begun = next(k for k, p in enumerate(odometry.poses) if p.status is Status.RESTARTED)
    # What stood between the two parts stands as it stood.
    end = found.statistics["parts"][0]["frames"][1]
    step = [p[begun].T_camera_world @ np.linalg.inv(p[end].T_camera_world) for p in (odometry.poses, found.poses)]
    np.testing.assert_allclose(*step, atol=1e-9)


def test_what_cannot_be_refined_says_so():
    tracks = sideways(12)
    with pytest.raises(InputError, match="record=True"):
        refine(follow_tracks(tracks.camera, tracks.pixels, tracks.visible))
    still = Odometry(tracks.camera, record=True)
    for k in range(5):
        still.add(tracks.pixels[0], tracks.visible[0], float(k))
    with pytest.raises(InitialisationError, match="the flow since"):
        refine(still)
